# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc check`` prints: what an episode is built of, in words and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from ..kernels.geometry.kinematics import BALL, FREE
from ..scene.describe import written
from ..scene.model.control_values import actuator_words, effort_words
from ..scene.model.layout import rotate
from ..scene.schema import Method, ShareOfRange
from ..scene.schema_bodies import SIZES
from ..scene.schema_goal import runs_of
from ..scene.schema_planner import PRESETS
from .report import console_of, make_table, show_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ..loop.run.episode import Episode
    from ..planner.plan import Rollout
    from ..scene.model.layout import Layout
    from ..scene.schema import Condition, Failure, Object, Obstacle, Phase, Planner, Scene

ALIKE = "differ in noise alone, so success over seeds is that of one task: [randomize_task.draw] draws goals and starts"
"""What is said of seeds that draw nothing."""
_UNITS = {
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s²", "rad/s²"),
    "position": ("m", "rad"),
    "effort": ("N", "N·m"),
}
"""Unit of a control by drive mode, along a linear and an angular axis."""
_UNLIMITED = 1e3
"""Width from which a range counts as no limit [m or rad]."""


def print_check(episode: Episode, out: TextIO, *, plan_ms: float | None = None, advice: Sequence[str] = ()) -> None:
    """Print what an episode is built of, and likely mistakes; its controller has made a plan.

    Args:
        episode: The episode.
        out: Where to.
        plan_ms: Wall time of a plan, the median of several [ms]; that of the last if None.
        advice: Sentences about likely mistakes.
    """
    # slow to import, and lists need no physics
    from ..engine.registry import physics_steps
    from ..extras.doctor.places import probes
    from ..scene.model.trajectory import Trajectory, size

    scene, controller = episode.scene, episode.controller
    layout, rollouts = controller.layout, probes(controller)
    console = console_of(out)
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold", no_wrap=True)
    facts.add_column()

    def fact(name: str, text: str) -> None:
        facts.add_row(name, Text(text))

    fact("scene", scene.name + (f", variant {scene.variant}" if scene.variant else ""))
    if scene.title:
        fact("", scene.title)
    if scene.path:
        fact("file", str(scene.path))
    fact(f"drawn, seed {episode.seed}", seed_words(scene, episode.drawn))
    for robot in scene.robot:
        entity = layout.entity(robot.name)
        dofs = sum(int(layout.joint_dof_dim[j].sum()) for j in entity.joints)
        fact("robot", f"{robot.name}: {dofs} DoF, {len(entity.bodies)} links, from {robot.asset}")
    for note in controller.compiled.notes:
        fact("as written", note)
    for line in controller.compiled.repaired:
        fact("repaired", line)
    for item in scene.object:
        fact("object", f"{item.name}: {shape_words(item)}, {item.mass:g} kg")
    for item in scene.obstacle:
        fact("obstacle", f"{item.name}: {shape_words(item)} at {number_words(item.position)}")
    fact("frames", ", ".join(layout.frame_name))
    fact("goal", goal_words(scene))
    for failure in scene.failure:
        fact("failure", failure_words(failure))
    for target in scene.target:
        fact("target", f"{target.name} at {number_words(target.position)} m")
    if scene.scalar:
        fact("scalars", ", ".join(f"{name} = {number_words(value)}" for name, value in scene.scalar.items()))
    weights = {phase.name: words for phase, words in zip(scene.phase, weight_words(scene), strict=True)}
    for name, last in runs_of(phase.name for phase in scene.phase):
        phase = next(phase for phase in scene.phase if phase.name == name)
        fact("phase", (name if last == name else f"{name} to {last}") + phase_words(phase) + weights[name])
    fact("planner", planner_words(scene))
    if scene.planner.method in PRESETS:
        means = preset_words(scene.planner.method)
        fact("preset", f"{scene.planner.method} means {means}, unless the scene says else")
    shape = controller.shape
    substeps = physics_steps(controller.engine.name, scene, controller.compiled, controller.plan_step.grid).count
    steps = shape.worlds * sum(substeps)
    each = str(substeps[0]) if len(set(substeps)) == 1 else f"{min(substeps)} to {max(substeps)}"
    fact("engine", f"{controller.engine.name} on {controller.device}, seed {episode.seed}")
    fact(
        "rollouts", f"{shape.worlds} worlds × {shape.horizon} controls × {each} substeps = {steps} physics steps a plan"
    )
    if controller.plan_step.refiner:
        fact("derivatives", controller.plan_step.refiner.summary)
    ahead = float(controller.plan_step.grid.t[-1])
    fact("time", f"a control lasts {1e3 * scene.timing.control_dt:g} ms, a plan looks {ahead:g} s ahead")
    fact("memory", f"{size(Trajectory.bytes(shape, layout, len(controller.costs.pairs)))} if every rollout is recorded")
    took = f"{controller.info.plan_ms if plan_ms is None else plan_ms:.1f} ms"
    took += ", the median of several along a run" * (plan_ms is not None)
    fact("one plan took", f"{took} on this machine")
    for sentence in advice:
        fact("advice", sentence)
    console.print(facts)
    show_table(console, joint_table(layout))
    show_table(console, _controls(episode))
    show_table(console, _costs(episode))
    if rollouts and (episode.scene.success is not None or episode.scene.phase):
        show_table(console, _conditions(episode, rollouts))


def _controls(episode: Episode) -> Table:
    layout, plant = episode.controller.layout, episode.plant
    table = make_table(
        "control", "drive", "lower", "upper", "unit", "effort limit", right=["lower", "upper", "effort limit"]
    )
    for i, name in enumerate(layout.control_name):
        rows = np.flatnonzero(layout.actuator_matrix[:, i])
        if not len(rows):  # an actuator of an MJCF file
            lower, upper = f"{layout.control_lower[i]:g}", f"{layout.control_upper[i]:g}"
            actuators = np.flatnonzero(plant.world.actuator_matrix[:, i])
            words = (", ".join(f(plant.model, a) for a in actuators) for f in (actuator_words, effort_words))
            table.add_row(name, next(words), lower, upper, "", next(words))
            continue
        mode, linear = layout.actuator_mode[rows[0]], _is_linear(layout, int(layout.actuator_dof[rows[0]]))
        effort = f"{layout.actuator_effort[rows[0]]:g} {_UNITS['effort'][not linear]}"
        if len(rows) > 1:  # speeds of a base with two wheels
            mode, linear = "diff_drive", name.endswith("/v")
        unit = _UNITS["velocity" if mode == "diff_drive" else mode][not linear]
        table.add_row(name, mode, f"{layout.control_lower[i]:g}", f"{layout.control_upper[i]:g}", unit, effort)
    return table


def _is_linear(layout: Layout, dof: int) -> bool:
    """Return whether a velocity coordinate belongs to a linear axis."""
    joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
    return dof - int(layout.joint_qd_start[joint]) < int(layout.joint_dof_dim[joint, 0])


def _costs(episode: Episode) -> Table:
    from ..extras.doctor.control import term_costs, told_apart

    right = ["weight", "best sample", "tells apart"]
    table = make_table("cost", "term", "weight", "best sample", "tells apart", "keys", right=right)
    controller = episode.controller
    costs = term_costs(controller)
    apart = told_apart(costs)
    share = apart / max(apart.sum(), 1e-30)
    for label, cost, part in zip(controller.costs.labels, episode.scene.cost, share, strict=True):
        keys = ", ".join(f"{key} = {number_words(value)}" for key, value in cost.params.items())
        weight, best = f"{float(controller.task[label]):g}", f"{controller.info.terms[label]:.4g}"
        table.add_row(Text(label), Text(cost.term), weight, best, f"{part:.0%}" if part else "same in all", Text(keys))
    table.caption = (
        f"tells apart: share of a term in what the costs of {len(costs)} samples of the first plan differ by"
    )
    if len(costs) > 1 and not share.all():
        table.caption += (
            "\nsame in all: as it should be for contacts and limits that are far away; a term that leads to the goal "
            "needs a longer planner.lookahead, more planner.noise.sigma, or names of what controls move"
        )
    table.caption_justify = "left"
    return table


def _conditions(episode: Episode, rollouts: list[Rollout]) -> Table:
    from ..extras.doctor.places import approaches

    right = ["start", "wanted", "nearest sample"]
    phase = episode.plant.task.phase_of(0) if episode.scene.phase else None
    what = f"phase {phase.name} waits for" if phase else "success waits for"
    table = make_table(what, "start", "wanted", "nearest sample", "", right=right)
    found = approaches(rollouts, episode.plant.monitor)
    if phase and phase.after is not None:
        table.add_row(Text("time in the phase [s]"), "0", f"≥ {phase.after:.4g}", "-", "ends it, whatever holds")
    for item in found:
        start, bound = item.start, f"{'≥' if item.start.above else '≤'} {item.start.bound:.4g}"
        if np.isnan(start.value):
            table.add_row(Text(start.name), "-", bound, "-", "a cost term: known once the plant runs")
            continue
        nearer = "" if item.nearer else "no nearer"
        table.add_row(Text(start.name), f"{start.value:.4g}", bound, f"{item.best.value:.4g}", nearer)
    if not all(item.nearer for item in found):
        table.caption = (
            "no nearer: as it should be where something has to be reached or grasped first; else look further ahead "
            "(planner.lookahead) or raise planner.noise.sigma"
        )
        table.caption_justify = "left"
    return table


def joint_table(layout: Layout, joint_q: np.ndarray | None = None) -> Table:
    """The table of all joints: range and start, of hinges in degrees besides; of free joints where the body is.

    Args:
        layout: State layout.
        joint_q: Joint coordinates ``[nq]`` that are shown in place of the start.
    """
    middle, coordinates = ("start", layout.joint_q) if joint_q is None else ("now", joint_q)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("joint")
    for name in ("lower", middle, "upper"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("unit")
    table.add_column("in degrees")
    for dof, name in enumerate(layout.dof_name):
        if not name:
            continue
        lower, upper, start = layout.dof_lower[dof], layout.dof_upper[dof], coordinates[layout.dof_coord[dof]]
        limited = upper - lower < _UNLIMITED
        numbers = [lower if limited else -np.inf, start, upper if limited else np.inf]
        joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
        hinge = bool(dof - int(layout.joint_qd_start[joint]) >= int(layout.joint_dof_dim[joint, 0]))
        outside = limited and not lower <= start <= upper
        table.add_row(
            name,
            *(f"{number:.4g}" for number in numbers),
            "rad" if hinge else "m",
            (" ".join(f"{np.degrees(number):.0f}" for number in numbers) if hinge else "") + " outside" * bool(outside),
        )
    for joint in np.flatnonzero(np.isin(layout.joint_type, (FREE, BALL))):
        values, free = coordinates[layout.joint_q_start[joint] :], layout.joint_type[joint] == FREE
        position, quaternion = np.split(values[: 7 if free else 4], [3 if free else 0])
        up = np.clip(rotate(quaternion, np.array([0.0, 0.0, 1.0]))[2], -1.0, 1.0)
        turned = f"z axis {np.degrees(np.arccos(up)):.0f}° from up"
        if not free:
            turned = f"turned by {np.degrees(2.0 * np.arccos(np.clip(abs(quaternion[3]), 0.0, 1.0))):.0f}°"
        where = ", ".join(f"{number:.4g}" for number in position)
        told = f"{'free' if free else 'ball'} joint, {turned}"
        table.add_row(layout.joint_name[joint], "", where, "", "m" if free else "", told)
    return table


def seed_words(scene: Scene, drawn: Mapping[str, object]) -> str:
    """What a seed draws of the task, and of the plant's properties; what it means where that is nothing.

    Args:
        scene: The scene.
        drawn: Values of the task by key.
    """
    values = [f"{key} = {number_words(value)}" for key, value in drawn.items()]
    return ", ".join([*values, *properties_drawn(scene)]) or f"nothing: other seeds {ALIKE}"


def properties_drawn(scene: Scene) -> list[str]:
    """Properties of the plant that every seed draws for itself."""
    kinds = ("mass", "friction", "size")
    found = [f"{name}'s {kind}" for name, r in scene.randomize.items() for kind in kinds if getattr(r, kind)]
    return found if scene.plant.randomize else []


def shape_words(item: Object | Obstacle) -> str:
    """Shape of an object or obstacle, and its size."""
    size = f"{SIZES[item.shape]} = {number_words(item.size)} m" if item.size else item.mesh or ""
    return f"{item.shape} {size}".strip()


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


def weight_words(scene: Scene) -> list[str]:
    """Weights in each phase of the terms whose weight a phase changes: a later phase keeps what it does not name."""
    held = {label: cost.weight for label, cost in zip(scene.cost_labels, scene.cost, strict=True)}
    changed = [label for label in held if any(label in phase.weight for phase in scene.phase)]
    found = []
    for phase in scene.phase:
        held |= phase.weight
        found.append("; weights " + ", ".join(f"{label} {held[label]:g}" for label in changed) if changed else "")
    return found


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
