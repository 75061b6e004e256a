# SPDX-License-Identifier: Apache-2.0
"""Parts of a scene in words, for what ``warpmpc check`` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..scene.describe import written
from ..scene.schema import Method, ShareOfRange
from ..scene.schema_planner import PRESETS

if TYPE_CHECKING:
    from ..scene.schema import Condition, Failure, Object, Obstacle, Phase, Planner, Scene


def shape_words(item: Object | Obstacle) -> str:
    """Shape of an object or obstacle, and its size."""
    return f"{item.shape} {number_words(item.size)} m" if item.size else f"{item.shape} {item.mesh or ''}".strip()


def goal_words(scene: Scene) -> str:
    """Goal of a scene, and what success asks for."""
    goal = scene.goal
    if goal is None:
        return "none; " + _success(scene)
    turn = f", yaw {goal.yaw:g} rad" if goal.yaw is not None else ""
    turn = f", rotation {number_words(goal.rotation)}" if goal.rotation is not None else turn
    return f"{goal.target} at {number_words(goal.position)} m{turn}; {_success(scene)}"


def _success(scene: Scene) -> str:
    if scene.success is None:
        return f"the run goes on for {scene.timing.timeout:g} s and has a cost"
    success = scene.success.model_dump(exclude_none=True, exclude={"conditions"})
    within = [
        f"{name} {number_words(value[0] if name == 'position' and len(value) == 1 else value)}"
        for name, value in success.items()
        if name != "hold" or value
    ]
    conditions = [_condition(condition) for condition in scene.success.conditions]
    return f"reached within {', '.join(within + conditions)}"


def phase_words(phase: Phase) -> str:
    """Goal of a phase, and what it waits for."""
    parts = [
        *([f"goal at {number_words(phase.goal.position)} m"] if phase.goal else []),
        *([f"until {', '.join(map(_condition, phase.until))}"] if phase.until else []),
        *([f"for {phase.hold:g} s"] if phase.hold else []),
        *([f"{phase.after:g} s at most"] if phase.after else []),
    ]
    return f": {', '.join(parts)}" if parts else ""


def failure_words(failure: Failure) -> str:
    """Condition that ends a run without success."""
    return " ".join(
        [
            f"{failure.name}:",
            ", ".join(map(_condition, failure.conditions)) or "too long",
            *([f"for {failure.hold:g} s"] if failure.hold else []),
            *([f"in phase {failure.phase}"] if failure.phase else []),
            *([f"after {failure.after:g} s"] if failure.after else []),
        ]
    )


def _condition(condition: Condition) -> str:
    values = condition.model_dump(exclude_none=True, exclude={"frame", "joint", "term", "to"})
    subject = condition.frame or condition.joint or condition.term
    return f"{subject} " + " ".join(f"{name} {number_words(value)}" for name, value in values.items())


def planner_words(scene: Scene) -> str:
    """Settings of the planner, in a line."""
    planner, noise = scene.planner, scene.planner.noise
    knots = f"{planner.knots} {planner.spline} knots" if planner.knot_count else f"{planner.horizon} knots"
    spread = f" × {noise.spread[0]:g} to {noise.spread[1]:g}" if noise.spread != (1.0, 1.0) else ""
    domains = f" × {planner.domains} domains ({planner.risk})" if planner.domains > 1 else ""
    return (
        f"{planner.method}: {planner.samples} samples{domains}, horizon {planner.horizon}, {knots}, "
        f"{noise.source} {noise.shape} noise, σ {_sigma(noise.sigma)}{spread}, discount {planner.discount:g}"
        + _temperature(planner)
        + (f", {planner.iterations} iterations" if planner.iterations > 1 else "")
    )


def preset_words(method: Method) -> str:
    """Keys that a method means by itself."""
    return ", ".join(f"{key} = {written(value)}" for key, value in PRESETS[method].items())


def _sigma(sigma: ShareOfRange | tuple[float, ...]) -> str:
    if isinstance(sigma, ShareOfRange):
        return f"{number_words(sigma.range[0] if len(sigma.range) == 1 else sigma.range)} of each control's range"
    return number_words(sigma)


def _temperature(planner: Planner) -> str:
    if planner.method is not Method.MPPI:
        return ""
    t = planner.temperature
    if t.ess:
        return f", β for an ESS of {t.ess:g}"
    return f", β {t.initial:g}" + (f" for η in {number_words(t.eta)}" if t.eta else ", fixed")


def number_words(value: Any) -> str:
    """A value as a scene file would write it, numbers short."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(number_words(item) for item in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)
