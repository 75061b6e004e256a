# SPDX-License-Identifier: Apache-2.0
"""Ancillary controllers: functions of a user's own whose controls are tried among the samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from ..model.state import State

Propose = Callable[["State", Mapping[str, "np.ndarray | float"], "np.ndarray"], "np.ndarray | None"]
"""``(state, task, times) -> controls``, as :func:`ancillary` says."""


@dataclass(frozen=True)
class AncillaryController:
    """Proposer of samples beside those that are drawn; build one with :func:`ancillary`."""

    name: str
    function: Propose
    samples: int = 1
    """How many samples it proposes."""


def ancillary(name: str, *, samples: int = 1) -> Callable[[Propose], AncillaryController]:
    """Turn a function into an ancillary controller (Trevisan and Alonso-Mora 2024, 2401.09241).

    Before every plan the function is asked for controls to try from the observed state on. They are rolled out and
    weighed as other samples are, so that a bad proposal costs nothing but its place among them. A scene names it with
    ``planner.ancillary = [{ function = "name" }]``.

    It takes the observed :class:`~warpmpc.State`, the poses ``[7]`` and scalars of the task by name, and the times
    ``[T]`` after the observation at which the steps of a rollout begin [s]. It returns controls, one for all of them
    ``[nu]``, one for every step ``[T, nu]`` or knots ``[P, nu]``; with several ``samples`` n an array ``[n, T, nu]`` or
    ``[n, P, nu]``; or None, when there is nothing to propose.

    Args:
        name: What scene files call it.
        samples: How many samples it proposes.

    Raises:
        TypeError: If the name is none, or ``samples`` no number above zero.

    Example:
        >>> @warpmpc.ancillary("straight")
        ... def straight(state, task, times):
        ...     goal = task["goal"]
        ...     return 2.0 * (goal[:2] - state.joint_q[:2])
    """
    if not isinstance(name, str) or not name:
        raise TypeError(f'an ancillary controller has a name, not {name!r}: @warpmpc.ancillary("name")')
    if not isinstance(samples, int) or samples < 1:
        raise TypeError(f"ancillary controller '{name}': samples is 1 or more, not {samples!r}")
    return lambda function: AncillaryController(name, function, samples)
