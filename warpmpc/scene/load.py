# SPDX-License-Identifier: Apache-2.0
"""From a scene file to a validated scene; nothing in the file is ever executed."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import SceneError, file_keys, join_key
from .overrides import expand, leaves, merge, nest, parse_override, split_key, validated, with_values
from .schema import DriveMode, Method, SampleCount, Scene
from .sizes import check_sizes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from .overrides import Key

RESERVED = ("goal", "ground", "world", "obstacles", "objects")
"""Names with a meaning of their own in costs and frames."""


def load_scene(source: str | Path, *, overrides: Sequence[str] = ()) -> Scene:
    """Read, vary and validate a scene.

    Args:
        source: Name of a shipped scene or path of a TOML file; ``:VARIANT`` at its end picks a variant, and
            ``:VARIANT+VARIANT`` several, laid one over the other in that order.
        overrides: Changes ``KEY=VALUE`` with a TOML value, such as ``planner.samples=500`` or
            ``robot.base.joint_q=[0, 0, 0]``; laid over the variant, in order.

    Returns:
        The scene. It makes sense by itself; whether its robots have the links and joints it names shows when its
        physics is built.

    Raises:
        SceneError: If anything is wrong with it.
    """
    path, variant = _find(source)
    try:
        return _load(path, variant, overrides)
    except RecursionError:
        raise SceneError("is nested too deeply", file=path) from None


def _load(path: Path, variant: str | None, overrides: Sequence[str]) -> Scene:
    data = read_toml(path)
    patches = data.pop("variants", {})
    origins: list[tuple[Key, str]] = []
    for name in split_variant(variant) or (None,):
        patch, origin = _pick(patches, name, path), f"{path} [variants.{name}]"
        data = _apply(data, patch, file=origin)
        origins += [(key, origin) for key in leaves(patch)]
    for text in overrides:
        key, value = parse_override(text)
        data = _apply(data, nest(key, value), file=f"--set {text}")
        origins.append((key, f"--set {text}"))
    try:
        for name in {"path", "variant", "variants"} & data.keys():
            raise SceneError("this key cannot be set", key=name, found=name, allowed=file_keys(Scene))
        scene = validated(data).model_copy(update={"path": path, "variant": variant})
        check_scene(scene)
    except SceneError as error:
        error.file = next((origin for key, origin in reversed(origins) if _touches(error.key, key)), path)
        raise
    return scene


def shipped_folder() -> Path:
    """Folder of the shipped scenes: inside an installed package, beside it in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def shipped_scenes() -> dict[str, Path]:
    """Scenes that come with warpmpc: name → file."""
    return {path.stem: path for path in sorted(shipped_folder().glob("*.toml"))}


def variants(source: str | Path) -> tuple[str, ...]:
    """Names of a scene's variants, in the file's order.

    Raises:
        SceneError: If there is no such file or it is not TOML.
    """
    path, _ = _find(source)
    found = read_toml(path).get("variants", {})
    return tuple(found) if isinstance(found, dict) else ()


def split_variant(variant: str | None) -> tuple[str, ...]:
    """Names of the variants that ``VARIANT+VARIANT`` lays one over the other."""
    return tuple(variant.split("+")) if variant is not None else ()


def _find(source: str | Path) -> tuple[Path, str | None]:
    """The file and the variant that a source means."""
    text = str(source)
    path = _file(text)
    if path is not None:
        return path, None
    name, colon, variant = text.rpartition(":")
    if colon and not set(variant) & set("/\\"):
        path = _file(name)
        if path is not None:
            return path, variant
        text = name
    folder = Path(text).parent
    beside = [str(path) for path in folder.glob("*.toml")] if text.endswith(".toml") and folder.is_dir() else []
    found = text if beside else Path(text).stem
    raise SceneError("no such scene file", file=text, found=found, allowed=[*beside, *shipped_scenes()])


def _file(text: str) -> Path | None:
    try:
        path = Path(text).expanduser()
        if path.is_file():
            return path.absolute()
        if path.exists() and text not in shipped_scenes():
            kind = "a folder" if path.is_dir() else "no regular file"
            raise SceneError(f"is {kind}: give a scene file (.toml) or the name of a shipped scene", file=text)
    except (OSError, RuntimeError):
        pass  # a name too long for a file, or a home folder of nobody
    return shipped_scenes().get(text)


def read_toml(path: Path) -> dict:
    """Content of a TOML file.

    Raises:
        SceneError: If it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise SceneError(f"cannot be read: {error.strerror}", file=path) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError("is not UTF-8 text", file=f"{path}:{line}") from error
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).rpartition(" (at ")
        position = re.findall(r"\d+", where)
        line = position[0] if position else path.read_bytes().count(b"\n") + 1
        raise SceneError(f"is not valid TOML: {what[:1].lower()}{what[1:]}", file=f"{path}:{line}") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"is not valid TOML: {error}", file=path) from error


def _pick(patches: object, variant: str | None, path: Path) -> dict:
    if not isinstance(patches, dict):
        raise SceneError("must be tables: write [variants.NAME]", key="variants", file=path, found=patches)
    if variant is None:
        return {}
    if variant not in patches:
        raise SceneError("no such variant", key="variants", file=path, found=variant, allowed=patches)
    if not isinstance(patches[variant], dict):
        raise SceneError("must be a table", key=join_key(("variants", variant)), file=path, found=patches[variant])
    if "variants" in patches[variant]:
        key = join_key(("variants", variant, "variants"))
        raise SceneError("a variant has no variants of its own: write each as [variants.NAME]", key=key, file=path)
    return patches[variant]


def _apply(data: dict, patch: dict, *, file: Path | str | None) -> dict:
    try:
        return merge(data, patch)
    except SceneError as error:
        error.file = file
        raise


def _touches(key: str | None, origin: Key) -> bool:
    """Return whether a change of one key can be behind a mistake at another: one lies at or below the other."""
    try:
        parts = split_key(key or "")
    except SceneError:
        return False
    return bool(parts) and all(b in ("*", a) for a, b in zip(parts, origin, strict=False))


def check_scene(scene: Scene) -> None:
    """Check what the types alone cannot: names, references between sections, drives and draws.

    Raises:
        SceneError: If names clash, a reference leads nowhere or sections contradict each other.
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
        check_sizes,
    )
    for check in checks:
        try:
            check(scene)
        except SceneError as error:
            error.file = error.file or scene.path
            raise


def _names(entries: Iterable) -> list[str]:
    return [entry.name for entry in entries]


def _check_names(scene: Scene) -> None:
    owner: dict[str, str] = {}
    for kind in ("robot", "object", "obstacle"):
        for name in _names(getattr(scene, kind)):
            key = f"{kind}.{name}.name"
            if name in RESERVED:
                raise SceneError(f"this name is reserved, as are {', '.join(RESERVED)}", key=key, found=name)
            if name in owner:
                raise SceneError(f"this name is taken by another {owner[name]}", key=key, found=name)
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
                raise SceneError(f"this name is {what}", key=join_key((kind, name)), found=name)
            taken[name] = kind
    labels = [cost.label for cost in scene.cost]
    for label in labels:
        if labels.count(label) > 1:
            raise SceneError(
                f'{labels.count(label)} cost entries are called this: give each a name of its own, name = "..."',
                key=f"cost.{label}",
                found=label,
            )


def _check_goal(scene: Scene) -> None:
    goal, success = scene.goal, scene.success
    if goal is None:
        if success is not None and success.of_goal:
            raise SceneError("there is no goal to compare with: give [goal], or conditions alone", key="success")
        return
    if goal.object is not None and goal.object not in _names(scene.object):
        raise SceneError("no such object", key="goal.object", found=goal.object, allowed=_names(scene.object))
    if goal.frame is not None:
        _check_frame(scene, goal.frame, "goal.frame")
    if success is None:
        return
    if success.position is not None and len(success.position) not in (1, len(goal.position)):
        raise SceneError(
            f"give one number, or one for each of the goal's {len(goal.position)} axes",
            key="success.position",
            found=list(success.position),
        )
    for name in ("yaw", "rotation"):
        if getattr(success, name) is not None and goal.yaw is None and goal.rotation is None:
            raise SceneError("the goal has no orientation: give goal.yaw or goal.rotation", key=f"success.{name}")


def _check_phases(scene: Scene) -> None:
    known = {"target": _names(scene.target), "scalar": list(scene.scalar), "weight": scene.cost_labels}
    for i, phase in enumerate(scene.phase):
        key = f"phase.{phase.name}"
        if phase.name in _names(scene.phase[:i]):
            raise SceneError("this name is taken by an earlier phase", key=f"{key}.name", found=phase.name)
        if phase.goal is not None and scene.goal is None:
            raise SceneError("the scene has no goal that a phase could move: give [goal]", key=f"{key}.goal")
        for kind, names in known.items():
            for name in getattr(phase, kind):
                if name not in names:
                    what = "cost term" if kind == "weight" else kind
                    raise SceneError(
                        f"no such {what}", key=join_key(("phase", phase.name, kind, name)), found=name, allowed=names
                    )
        if i < len(scene.phase) - 1 and not phase.until and phase.after is None:
            raise SceneError("this phase never ends: give until or after, or put it last", key=key)


def _check_motions(scene: Scene) -> None:
    poses = [*(["goal"] if scene.goal else []), *_names(scene.target), *(o.name for o in scene.obstacle if o.movable)]
    for i, motion in enumerate(scene.motion):
        key = f"motion.{motion.name}.name"
        if motion.name not in poses:
            what = "nothing that can move has this name: the goal, targets and obstacles with movable = true can"
            raise SceneError(what, key=key, found=motion.name, allowed=poses)
        if motion.name in _names(scene.motion[:i]):
            raise SceneError("this moves already", key=key, found=motion.name)


def _check_frame(scene: Scene, frame: str, key: str) -> None:
    robot, slash, place = frame.partition("/")
    known = [f"{r.name}/{name}" for r in scene.robot for name in r.frames]
    if not slash or not place:
        robots = " or ".join(f"{name}/LINK" for name in _names(scene.robot))
        allowed = ", ".join([*known, f"{robots} with a link of the robot's asset"])
        raise SceneError("a robot frame reads robot/frame or robot/link", key=key, found=frame, allowed=allowed)
    if robot not in _names(scene.robot):
        raise SceneError("no such robot", key=key, found=robot, allowed=_names(scene.robot))


def _check_drives(scene: Scene) -> None:
    for robot in scene.robot:
        taken: set[str] = set()
        for i, drive in enumerate(robot.drive):
            key = f"robot.{robot.name}.drive" + f".{i}" * (len(robot.drive) > 1)
            if drive.joints is None:
                if len(robot.drive) > 1 and drive.mode is not DriveMode.MOCAP:
                    raise SceneError("of several drives each must name its joints", key=f"{key}.joints")
                continue
            for joint in drive.joints:
                if joint in taken:
                    raise SceneError("this joint is driven twice", key=f"{key}.joints", found=joint)
                taken.add(joint)
            count = len(drive.joints)
            for name in ("stiffness", "damping", "effort_limit", "limit", "lower", "upper"):
                values = getattr(drive, name)
                if values is not None and len(values) not in (1, count):
                    what = "controls" if drive.mode is DriveMode.DIFF_DRIVE else "joints"
                    allowed = f"1 value, or {count}: one for each of its {what}"
                    raise SceneError("wrong number of values", key=f"{key}.{name}", found=values, allowed=allowed)


def _check_plant(scene: Scene) -> None:
    if scene.timing.timeout < scene.timing.control_dt:
        raise SceneError("is shorter than control_dt", key="timing.timeout", found=scene.timing.timeout)
    samples = scene.planner.samples
    if (
        scene.planner.method in (Method.CEM, Method.TSALLIS)
        and samples is not SampleCount.AUTO
        and scene.planner.elites > samples
    ):
        raise SceneError("there are more elites than samples", key="planner.elites", found=scene.planner.elites)
    movable = _names(scene.robot) + _names(scene.object)
    for i, kick in enumerate(scene.plant.kicks):
        key = "plant.kicks" + f".{i}" * (len(scene.plant.kicks) > 1)
        if kick.target not in movable:
            raise SceneError("no such robot or object", key=f"{key}.target", found=kick.target, allowed=movable)
        if kick.target in _names(scene.object) and len(kick.velocity) != 3:
            raise SceneError("an object's velocity is (x, y, z)", key=f"{key}.velocity", found=kick.velocity)
        if kick.time >= scene.timing.timeout:
            allowed = f"less than timing.timeout = {scene.timing.timeout:g}"
            raise SceneError("comes after the end of the run", key=f"{key}.time", found=kick.time, allowed=allowed)


def _check_randomization(scene: Scene) -> None:
    fixed, robots = _names(scene.obstacle), _names(scene.robot)
    known = robots + _names(scene.object) + fixed
    for name, random in scene.randomize.items():
        key = join_key(("randomize", name))
        if name not in known:
            raise SceneError("no such robot, object or obstacle", key=key, found=name, allowed=known)
        if random.mass is not None and name in fixed:
            raise SceneError("an obstacle has no mass", key=f"{key}.mass")
        if random.size is not None and name in robots:
            raise SceneError("a robot's size is fixed by its asset", key=f"{key}.size")


def _check_draws(scene: Scene) -> None:
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
            raise SceneError(message, key=key, found=error.found, allowed=error.allowed) from None
        if not keys or drawn & set(keys):
            raise SceneError("addresses nothing" if not keys else "addresses a value that is drawn already", key=key)
        drawn.update(keys)
    objects, robots = _names(scene.object), _names(scene.robot)
    for i, rejection in enumerate(scene.randomize_task.reject):
        key = "randomize_task.reject" + f".{i}" * (len(scene.randomize_task.reject) > 1)
        place = rejection.place
        if place == "goal" and scene.goal is None:
            raise SceneError("the scene has no goal", key=f"{key}.place", found=place)
        if "/" in place:
            _check_frame(scene, place, f"{key}.place")
            if rejection.at is None:
                raise SceneError("say where this frame is at the start: at = [x, y, z]", key=f"{key}.at")
        elif place not in ("goal", *objects, *robots):
            raise SceneError("no such place", key=f"{key}.place", found=place, allowed=["goal", *objects, *robots])
