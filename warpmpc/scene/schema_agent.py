# SPDX-License-Identifier: Apache-2.0
"""The type of what follows plans in real time, at a rate of its own, and when it does not trust them."""

from __future__ import annotations

from enum import StrEnum

from .types import Flag, Positive, Positives, Section


class SafeCommand(StrEnum):
    """Safe command of drives by effort, where nothing can be trusted; other drives stop, or hold where they are."""

    REST = "rest"
    GRAVITY = "gravity"


class Plans(StrEnum):
    """Plans for every control."""

    ONE = "one"
    FIT = "fit"


class AgentSettings(Section):
    """The agent follows the newest plan in real time and sends the safe command where it cannot be trusted."""

    rate: Positive = 500.0
    """How often it observes and commands the robot [Hz]."""
    plan_timeout: Positive = 0.09
    """Age of the observation beyond which a plan made from it is not followed any more [s]; a plan that replaces it is
    made from one observed a latency later and comes after two, so it is more than that."""
    observation_timeout: Positive = 0.05
    """Age beyond which an observation is not believed any more, or time for which a moving robot may show the same
    joint positions [s]."""
    plans: Plans = Plans.ONE
    """Plans for every control where plant and planner go on at once: ``one``, or as many as ``fit``. Then a clock that
    is slowed down buys plans [Alg. 1 of 2212.00541]."""
    slew: Positives | None = None
    """Largest change of the controls per second, one value or one per control [control unit/s]; any when left out.
    Holds whatever the planner says, for the safe command, too."""
    safe: SafeCommand = SafeCommand.REST
    """Safe command of drives by effort: what held the start, none where nothing did (``rest``), or what
    holds the model against gravity where it was last seen (``gravity``)."""
    compensate: Flag = True
    """Whether observations are predicted forward by the time that a plan takes."""
