# SPDX-License-Identifier: Apache-2.0
"""Planning again what was logged: the same scene, seed and observations must give the same commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..controller.controller import Controller
from ..origin import origin
from ..scene.dump import parse_scene

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..scene.schema import Scene
    from .plan_log import PlanLog


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What planning again came to."""

    logged: np.ndarray
    """Commands of the log ``[N, nu]``, or numbers of plans."""
    found: np.ndarray
    """The same now ``[N, nu]``."""
    time: np.ndarray
    """Times of their observations ``[N]`` [s]."""
    control_names: tuple[str, ...]
    """Names of the numbers ``[nu]``."""
    differences: tuple[str, ...]
    """What is not as it was: versions, source, hardware. Then the bits may differ."""
    what: str = "command"
    """What a row is."""

    @property
    def agree(self) -> np.ndarray:
        """Whether each row is the logged one, bit for bit ``[N]``."""
        return ~self._differs.any(axis=1)

    @property
    def _differs(self) -> np.ndarray:
        """Whether bits of each number differ ``[N, nu]``."""
        kind = np.dtype(f"u{self.logged.itemsize}")
        return self.logged.view(kind) != self.found.view(kind)

    @property
    def same(self) -> bool:
        """Whether all of them are."""
        return bool(self.agree.all())

    @property
    def first(self) -> str | None:
        """A sentence on the first number that differs, None where none does."""
        if self.same:
            return None
        n = int(np.argmin(self.agree))
        i = int(np.argmax(self._differs[n]))
        logged, found = self.logged[n, i], self.found[n, i]
        name = self.control_names[i]
        return f"{self.what} {n} at t = {self.time[n]:.3f} s: {name} was {logged:.9g}, now it is {found:.9g}"


def replay(log: PlanLog, *, terms: Sequence[UserTerm] = ()) -> Replay:
    """Plan again from logged observations, with a fresh controller.

    What cost terms search beside the plans (the paths of ``push_path`` after the goal was moved) is ready when it is
    ready, which no log can tell: plans in between may differ. So do those after a ``Controller.reset`` in the middle.

    Args:
        log: The log (``History.log``).
        terms: Users' own cost terms and ancillary controllers that the scene names.

    Raises:
        SceneError: If the scene is none of this warpmpc, or its files are not here.
        ValueError: If the log does not begin with the first plan, or the engine or device is not to be had here.
    """
    about = log.origin
    if not about["from_start"]:
        raise ValueError("the log does not begin with its controller's first plan: what that one had learned is lost")
    scene = logged_scene(log)
    controller = Controller(
        scene,
        engine=about["engine"],
        device=about["device"],
        strategy=about["strategy"],
        seed=about["seed"],
        terms=terms,
    )
    found = np.zeros_like(log.command)
    limits: tuple[np.ndarray, np.ndarray] | None = None
    for n in range(len(log)):
        controller.task.follow(log.task[n])
        for name, seen in log.clouds.items():
            if n in seen:
                controller.task.see(name, seen[n])
        if limits is None or not all(map(np.array_equal, limits, (log.lower[n], log.upper[n]))):
            limits = log.lower[n], log.upper[n]
            controller.set_limits(*limits)
        found[n] = controller.step(log.state(n))
    names = tuple(controller.layout.control_name)
    return Replay(
        logged=log.command, found=found, time=log.time, control_names=names, differences=tuple(differences(about))
    )


def logged_scene(log: PlanLog) -> Scene:
    """The scene that a log's plans were made for.

    Raises:
        SceneError: If it is none of this warpmpc.
    """
    return scene_of(log.origin)


def scene_of(about: Mapping[str, Any]) -> Scene:
    """The scene of a log's origin.

    Raises:
        SceneError: If it is none of this warpmpc.
    """
    path = about["file"] and Path(about["file"])
    return parse_scene(about["text"], path=path, variant=about["variant"])


def differences(about: dict[str, Any]) -> Iterator[str]:
    """What of a log's origin is otherwise here, as ``what: then, now``."""
    here = origin()
    for name in ("versions", "hardware"):
        for key, value in here[name].items():
            then = about[name].get(key)
            if then != value:
                yield f"{key}: {_said(then)}, now {_said(value)}"
    if about["code"] != here["code"]:
        then, now = (f"{o['code']} ({o['revision']})" if o["revision"] else o["code"] for o in (about, here))
        yield f"source of warpmpc: {then}, now {now}"


def _said(value: object) -> str:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
