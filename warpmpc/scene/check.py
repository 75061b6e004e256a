# SPDX-License-Identifier: Apache-2.0
"""What the types of a scene cannot check: names, references between sections, drives and draws.

Sizes that no machine can take, refused before anything is allocated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .errors import SceneError, join_key
from .overrides import expand, split_key, with_values
from .schema import DriveMode, Method, SampleCount, Scene

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from .overrides import Key

PLAN_STEPS = 200_000_000
"""Most physics steps of a plan: a small scene's take minutes on two cores, seconds on the largest GPU."""
PLAN_ROUNDS = 1000
"""Most iterations of a plan: each of them is prepared, however few its samples are."""
RUN_CONTROLS = 100_000_000
"""Most controls of a run."""
SHORTEST = 1e-6
"""Shortest physics step [s]; a run's time in single precision tells no shorter ones apart."""

_USUAL = {"samples": 256, "horizon": 16, "iterations": 1, "domains": 1}
"""Usual factors of a plan's work, to tell which one is out of bounds."""


def _check_sizes(scene: Scene) -> Iterator[SceneError]:
    """Sizes that would take hours or all memory, each by the key that is farthest from what is usual."""
    planner, timing, engine = scene.planner, scene.timing, scene.engine
    controls = timing.timeout / timing.control_dt
    if controls > RUN_CONTROLS:
        key = "timing.control_dt" if timing.control_dt < 1e-4 else "timing.timeout"
        what = f"a run of {timing.timeout:g} s would have {controls:.0g} controls, more than {RUN_CONTROLS:.0g}"
        yield SceneError(what, key=key, found=getattr(timing, key.partition(".")[2]))
    for key, substeps, length in (
        ("engine.substeps", engine.substeps, timing.control_dt if planner.dt is None else _shortest_step(scene)),
        ("plant.substeps", scene.plant.substeps, timing.control_dt),
    ):
        if substeps is not None and length / substeps < SHORTEST:
            what = f"physics steps of {length / substeps:.1g} s are too short: {SHORTEST:g} s at least"
            yield SceneError(what, key=key, found=substeps, allowed=f"at most {max(1, math.floor(length / SHORTEST))}")
    sizes = plan_sizes(scene)
    steps = math.prod(sizes.values()) * (engine.substeps or 1)
    if steps > PLAN_STEPS:
        name = farthest(sizes)
        what = f"a plan would take {steps:.1e} physics steps, more than {PLAN_STEPS:.0e}: lower this"
        yield SceneError(what, key=f"planner.{name}", found=sizes[name])
    if planner.iterations > PLAN_ROUNDS:
        what = f"more than {PLAN_ROUNDS} rounds of a plan take minutes however few their samples: lower this"
        yield SceneError(what, key="planner.iterations", found=planner.iterations)


def plan_sizes(scene: Scene) -> dict[str, int]:
    """Factors of a plan's work, by keys of the planner; the usual where a number is left to the machine."""
    sizes = {name: getattr(scene.planner, name) for name in _USUAL}
    return sizes | {name: _USUAL[name] for name, value in sizes.items() if value is SampleCount.AUTO}


def farthest(sizes: dict[str, int]) -> str:
    """The key of :func:`plan_sizes` that is farthest from what is usual."""
    return max(sizes, key=lambda name: sizes[name] / _USUAL[name])


def _shortest_step(scene: Scene) -> float:
    """Length of the shortest step of a rollout [s]."""
    dt = scene.planner.dt
    return min(dt) if isinstance(dt, tuple) else min(dt.first, dt.last)


RESERVED = ("goal", "ground", "world", "obstacles", "objects")
"""Names that are reserved in costs and frames."""


def check_scene(scene: Scene) -> None:
    """Check what the types alone cannot: names, references between sections, drives and draws.

    Raises:
        SceneError: If names clash, a reference leads nowhere or sections contradict each other; it has all of these.
    """
    checks = (
        _check_names,
        _check_goal,
        _check_phases,
        _check_motions,
        _check_drives,
        _check_plant,
        _check_randomization,
        _check_draws,
        _check_sizes,
    )
    found = [error for check in checks for error in check(scene)]
    for error in found:
        error.file = error.file or scene.path
    if found:
        raise SceneError.of(found)


def _names(entries: Iterable) -> list[str]:
    return [entry.name for entry in entries]


def _check_names(scene: Scene) -> Iterator[SceneError]:
    owner: dict[str, str] = {}
    for kind in ("robot", "object", "obstacle"):
        for name in _names(getattr(scene, kind)):
            key = f"{kind}.{name}.name"
            if name in RESERVED:
                yield SceneError(f"this name is reserved, as are {', '.join(RESERVED)}", key=key, found=name)
            if name in owner:
                yield SceneError(f"this name is taken by another {owner[name]}", key=key, found=name)
            owner[name] = kind
    # targets stand among the frames; targets, movable obstacles, scalars, clouds and weights among the task's values
    movable = [obstacle.name for obstacle in scene.obstacle if obstacle.movable]
    values = {
        "target": _names(scene.target),
        "obstacle": movable,
        "scalar": list(scene.scalar),
        "cloud": _names(scene.cloud),
        "cost": sorted(set(scene.cost_labels)),
    }
    taken: dict[str, str] = {}
    for kind, names in values.items():
        for name in names:
            other = taken.get(name) or (owner.get(name) if kind == "target" else None)
            if other is not None or name in (RESERVED if kind != "cost" else ("goal",)):
                what = f"taken by another {other}" if other else f"reserved, as are {', '.join(RESERVED)}"
                yield SceneError(f"this name is {what}", key=join_key((kind, name)), found=name)
            taken[name] = kind
    labels = [cost.label for cost in scene.cost]
    for label in dict.fromkeys(labels):
        if labels.count(label) > 1:
            yield SceneError(
                f'{labels.count(label)} cost entries are called this: give each another name, name = "..."',
                key=f"cost.{label}",
                found=label,
            )


def _check_goal(scene: Scene) -> Iterator[SceneError]:
    goal, success = scene.goal, scene.success
    if goal is None:
        if success is not None and success.of_goal:
            yield SceneError("there is no goal to compare with: give [goal], or conditions alone", key="success")
        return
    if goal.object is not None and goal.object not in _names(scene.object):
        yield SceneError("no such object", key="goal.object", found=goal.object, allowed=_names(scene.object))
    if goal.frame is not None:
        yield from _check_frame(scene, goal.frame, "goal.frame")
    if success is None:
        return
    if success.position is not None and len(success.position) not in (1, len(goal.position)):
        yield SceneError(
            f"give one number, or one for each of the goal's {len(goal.position)} axes",
            key="success.position",
            found=list(success.position),
        )
    for name in ("yaw", "rotation"):
        if getattr(success, name) is not None and goal.yaw is None and goal.rotation is None:
            yield SceneError("the goal has no orientation: give goal.yaw or goal.rotation", key=f"success.{name}")


def _check_phases(scene: Scene) -> Iterator[SceneError]:
    known = {"target": _names(scene.target), "scalar": list(scene.scalar), "weight": scene.cost_labels}
    for i, phase in enumerate(scene.phase):
        key = f"phase.{phase.name}"
        if phase.name in _names(scene.phase[:i]):
            yield SceneError("this name is taken by an earlier phase", key=f"{key}.name", found=phase.name)
        if phase.goal is not None and scene.goal is None:
            yield SceneError("the scene has no goal that a phase could move: give [goal]", key=f"{key}.goal")
        for kind, names in known.items():
            for name in getattr(phase, kind):
                if name not in names:
                    what = "cost term" if kind == "weight" else kind
                    yield SceneError(
                        f"no such {what}", key=join_key(("phase", phase.name, kind, name)), found=name, allowed=names
                    )
        if i < len(scene.phase) - 1 and not phase.until and phase.after is None:
            yield SceneError("this phase never ends: give until or after, or put it last", key=key)


def _check_motions(scene: Scene) -> Iterator[SceneError]:
    poses = [*(["goal"] if scene.goal else []), *_names(scene.target), *(o.name for o in scene.obstacle if o.movable)]
    for i, motion in enumerate(scene.motion):
        key = f"motion.{motion.name}.name"
        if motion.name not in poses:
            what = "nothing that can move has this name: the goal, targets and obstacles with movable = true can"
            yield SceneError(what, key=key, found=motion.name, allowed=poses)
        if motion.name in _names(scene.motion[:i]):
            yield SceneError("this moves already", key=key, found=motion.name)


def _check_frame(scene: Scene, frame: str, key: str) -> Iterator[SceneError]:
    robot, slash, place = frame.partition("/")
    known = [f"{r.name}/{name}" for r in scene.robot for name in r.frames]
    if not slash or not place:
        robots = " or ".join(f"{name}/LINK" for name in _names(scene.robot))
        allowed = ", ".join([*known, f"{robots} with a link of the robot's asset"])
        yield SceneError("a robot frame reads robot/frame or robot/link", key=key, found=frame, allowed=allowed)
    if robot not in _names(scene.robot):
        yield SceneError("no such robot", key=key, found=robot, allowed=_names(scene.robot))


def _check_drives(scene: Scene) -> Iterator[SceneError]:
    for robot in scene.robot:
        taken: set[str] = set()
        for i, drive in enumerate(robot.drive):
            key = f"robot.{robot.name}.drive" + f".{i}" * (len(robot.drive) > 1)
            if drive.joints is None:
                if len(robot.drive) > 1 and drive.mode is not DriveMode.MOCAP:
                    yield SceneError("of several drives each must name its joints", key=f"{key}.joints")
                continue
            for joint in drive.joints:
                if joint in taken:
                    yield SceneError("this joint is driven twice", key=f"{key}.joints", found=joint)
                taken.add(joint)


def _check_plant(scene: Scene) -> Iterator[SceneError]:
    samples = scene.planner.samples
    if (
        scene.planner.method in (Method.CEM, Method.TSALLIS)
        and samples is not SampleCount.AUTO
        and scene.planner.elites > samples
    ):
        yield SceneError("there are more elites than samples", key="planner.elites", found=scene.planner.elites)
    movable = _names(scene.robot) + _names(scene.object)
    for i, kick in enumerate(scene.plant.kicks):
        key = "plant.kicks" + f".{i}" * (len(scene.plant.kicks) > 1)
        if kick.target not in movable:
            yield SceneError("no such robot or object", key=f"{key}.target", found=kick.target, allowed=movable)
        if kick.target in _names(scene.object) and len(kick.velocity) != 3:
            yield SceneError("an object's velocity is (x, y, z)", key=f"{key}.velocity", found=kick.velocity)
        if kick.time >= scene.timing.timeout:
            allowed = f"less than timing.timeout = {scene.timing.timeout:g}"
            yield SceneError("comes after the end of the run", key=f"{key}.time", found=kick.time, allowed=allowed)


def _check_randomization(scene: Scene) -> Iterator[SceneError]:
    fixed, robots = _names(scene.obstacle), _names(scene.robot)
    known = robots + _names(scene.object) + fixed
    for name, random in scene.randomize.items():
        key = join_key(("randomize", name))
        if name not in known:
            yield SceneError("no such robot, object or obstacle", key=key, found=name, allowed=known)
        if random.mass is not None and name in fixed:
            yield SceneError("an obstacle has no mass", key=f"{key}.mass")
        if random.size is not None and name in robots:
            yield SceneError("a robot's size is fixed by its asset", key=f"{key}.size")


def _check_draws(scene: Scene) -> Iterator[SceneError]:
    data = scene.model_dump(mode="json")
    drawn: set[Key] = set()
    for text, draw in scene.randomize_task.draw.items():
        key = join_key(("randomize_task", "draw", text))
        try:
            keys = list(expand(data, split_key(text)))
            for end in (draw.low, draw.high):
                with_values(scene, {text: end[0] if len(end) == 1 else end})
        except SceneError as error:
            message = f"cannot be drawn: {error.key}: {error.message}"
            yield SceneError(message, key=key, found=error.found, allowed=error.allowed)
            continue
        if not keys or drawn & set(keys):
            yield SceneError("addresses nothing" if not keys else "addresses a value that is drawn already", key=key)
        drawn.update(keys)
    objects, robots = _names(scene.object), _names(scene.robot)
    for i, rejection in enumerate(scene.randomize_task.reject):
        key = "randomize_task.reject" + f".{i}" * (len(scene.randomize_task.reject) > 1)
        place = rejection.place
        if place == "goal" and scene.goal is None:
            yield SceneError("the scene has no goal", key=f"{key}.place", found=place)
        if "/" in place:
            yield from _check_frame(scene, place, f"{key}.place")
            if rejection.at is None:
                yield SceneError("say where this frame is at the start: at = [x, y, z]", key=f"{key}.at")
        elif place not in ("goal", *objects, *robots):
            yield SceneError("no such place", key=f"{key}.place", found=place, allowed=["goal", *objects, *robots])
