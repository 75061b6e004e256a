# SPDX-License-Identifier: Apache-2.0
"""The examination: every finding about a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .approach import probes, still_findings
from .contacts import contact_findings
from .control import plan_findings, reach_findings
from .effects import effect_findings
from .joints import joint_findings
from .places import place_findings
from .subject import Finding, Subject
from .travel import travel_findings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..controller.controller import Controller
    from ..plant.monitor import Monitor


def examine(controller: Controller, monitor: Monitor) -> list[Finding]:
    """Likely mistakes of a scene, none for one that looks as it should.

    Args:
        controller: It has made a plan from the scene's start.
        monitor: It has seen the start.
    """
    subject = Subject(controller.scene, controller.compiled)
    of_plan = [*plan_findings(subject, controller), *still_findings(subject, probes(controller))]
    return [*examine_model(subject), *_at_once(monitor), *of_plan]


def examine_model(subject: Subject) -> list[Finding]:
    """The findings that need no plan."""
    kinds = (joint_findings, contact_findings, effect_findings, place_findings, reach_findings, travel_findings)
    return [finding for kind in kinds for finding in kind(subject)]


def _at_once(monitor: Monitor) -> Iterator[Finding]:
    """Runs that end as they begin."""
    if monitor.failure is not None:
        yield Finding(
            f"failure.{monitor.failure}",
            "it holds at the start: every run fails at once",
            "change its conditions (above, below, distance), or let it count from a later time (after)",
        )
    if monitor.success:
        yield Finding(
            "success", "it holds at the start: every run ends at once", "ask for more, or start farther from it"
        )
