# SPDX-License-Identifier: Apache-2.0
"""A scene compiled once: Newton world and MJCF files → MuJoCo model and state layout, kept in a cache on disk.

Building the Newton world and translating it takes seconds, most of them imports. The result depends only on the
scene's bodies and on its asset files, so it is stored under a hash of those: a later run of the same scene needs
neither Newton nor its solver to start moving.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import importlib.metadata
import json
import logging
import os
import re
import tempfile
import threading
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import platformdirs

from ...physics.runtime import kernel_cache
from ...physics.runtime.compiling import shown
from ..errors import SceneError
from ..load import shipped_folder
from .assets import AssetKind, asset_files, asset_kind, resolve_asset
from .compiled_scene import CompiledScene
from .control_values import with_equilibrium
from .layout import Layout
from .mjcf_mocap import with_movable
from .overlaps import validate_layout

if TYPE_CHECKING:
    from ..schema import Scene
    from .builder import World
    from .mjcf import MjcfRobot

logger = logging.getLogger("warpmpc")


def compile_scene(scene: Scene, *, cache: bool = True) -> CompiledScene:
    """Compile a scene, or fetch it from the cache.

    Args:
        scene: The scene.
        cache: Whether to read and write the cache on disk; set the environment variable ``WARPMPC_CACHE`` to move it.

    Raises:
        SceneError: If an asset is missing or broken, or lacks a joint or link the scene names.
    """
    key = None
    with contextlib.suppress(SceneError):  # of a file that is missing: building tells it, and other mistakes
        key = _cache_key(scene) if cache else None
    compiled = _compiled(scene, key)
    if compiled.repaired:
        logger.warning("%s", _warning(compiled.repaired))
    return compiled


def _warning(repaired: Sequence[str]) -> str:
    """One line about what was repaired."""
    more = len(repaired) - 1
    return repaired[0] + (f" (and {more} more repaired: warpmpc check lists all)" if more else "")


def _compiled(scene: Scene, key: str | None) -> CompiledScene:
    """The scene of a cache entry, which is made if there is none."""
    folder = cache_folder()
    for place in (folder, kernel_cache.home() / "scenes") if key else ():
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return _fetch(place, key)
    try:
        with shown(f"building {scene.name}" + (", once" if key else "")):
            compiled = with_equilibrium(_compile(scene))
    except SceneError:
        raise
    except Exception as error:  # of several kinds, from Newton, MuJoCo and readers of meshes
        raise _refusal(scene, error) from error
    if key:
        with contextlib.suppress(OSError):
            _store(compiled, folder, key)
    return compiled


def _refusal(scene: Scene, error: Exception) -> SceneError:
    """The error for what Newton or MuJoCo refuses; the body that it names, if any, is whose."""
    said = " ".join(str(error).split()) or type(error).__name__
    keys = {robot.name: f"robot.{robot.name}.asset" for robot in scene.robot}
    keys |= {item.name: f"object.{item.name}" for item in scene.object}
    keys |= {item.name: f"obstacle.{item.name}" for item in scene.obstacle}
    named = [name for name in keys if re.search(rf"(?<![a-zA-Z0-9]){re.escape(name)}(?![a-zA-Z0-9])", said)]
    assets = {f"robot.{robot.name}.asset": robot.asset for robot in scene.robot}
    key = keys[named[0] if named else scene.robot[0].name]
    return SceneError(f"no physics can be made of this: {said}", key=key, file=scene.path, found=assets.get(key))


def cache_folder() -> Path:
    """Folder of compiled scenes."""
    return Path(os.environ.get("WARPMPC_CACHE") or platformdirs.user_cache_dir("warpmpc")) / "scenes"


def _compile(scene: Scene) -> CompiledScene:
    from .builder import build_world

    world = build_world(scene)
    validate_layout(world.layout, scene)
    if not world.mjcf_robots.robots:
        *found, corrected = _derive(world)
        said = {"notes": tuple(world.mjcf_robots.notes), "repaired": (*world.repaired, *corrected)}
        return CompiledScene(world.layout, *found, world.actuator_name, **said)
    return _compile_mjcf(scene, world)


def _derive(world: World) -> tuple[str, tuple[str, ...], tuple[str, ...], tuple[str, ...], list[str]]:
    """The MuJoCo model of a Newton world, its names of bodies, shapes and joint dofs, and what Newton corrected."""
    import newton

    from ...physics.runtime.launch import default_device

    with default_device("cpu"), tempfile.TemporaryDirectory() as folder, _newton_alone():
        world.builder.validate_inertia_detailed = True  # says of which bodies
        with warnings.catch_warnings(record=True) as caught:
            model = world.builder.finalize(device="cpu")
        corrected = [" ".join(str(warning.message).split()) for warning in caught]
        path = Path(folder) / "scene.xml"
        solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, save_to_mjcf=str(path))
        mjcf = path.read_text()
    mj = solver.mj_model
    bodies = [""] * world.layout.nb
    for i, body in enumerate(solver.mjc_body_to_newton.numpy()[0]):
        if 0 <= body < len(bodies):
            bodies[body] = mj.body(i).name
    geoms = [""] * len(world.layout.shapes)
    for i, shape in enumerate(solver.mjc_geom_to_newton_shape.numpy()[0]):
        if shape >= 0:
            geoms[shape] = mj.geom(i).name
    joints = [""] * world.layout.nv
    for i, (joint, dof) in enumerate(
        zip(solver.mjc_jnt_to_newton_jnt.numpy()[0], solver.mjc_jnt_to_newton_dof.numpy()[0], strict=True)
    ):
        if joint >= len(world.layout.joint_name):
            continue
        one_axis = mj.jnt_type[i] in (2, 3)  # slide or hinge; free and ball joints are found by their first dof
        joints[dof if one_axis else world.layout.joint_qd_start[joint]] = mj.joint(i).name
    return with_movable(mjcf, world.layout, geoms), tuple(bodies), tuple(geoms), tuple(joints), corrected


_TRANSLATION = "newton._src.solvers.mujoco.kernels"


def _load_translation() -> None:
    import warp as wp

    with contextlib.suppress(Exception):  # the solver gets the error
        wp.load_module(_TRANSLATION, device="cpu", block_dim=1)


@contextlib.contextmanager
def _newton_alone() -> Iterator[None]:
    """Newton's solver made for its translation alone: what it says of files and of MuJoCo Warp is about neither.

    Its kernels run once and take 18 s to compile, 3 s without optimization and gradients; a thread
    begins with that while the world is finalized, which compiles others.
    """
    newton = logging.getLogger("newton")
    level = newton.level
    newton.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings(), _unoptimized("newton._src.geometry.bvh"), _unoptimized(_TRANSLATION):
            warnings.filterwarnings("ignore", module="mujoco_warp")
            warnings.filterwarnings("ignore", "MuJoCo dependency version mismatch")  # its extra asks for 3.17 alone
            importlib.import_module(_TRANSLATION)
            beside = threading.Thread(target=_load_translation, name="warpmpc compiling")
            beside.start()
            try:
                yield
            finally:
                beside.join()
    finally:
        newton.setLevel(level)


_SOONEST = {"enable_backward": False, "optimization_level": 0}
"""Options with which a module compiles soonest."""


@contextlib.contextmanager
def _unoptimized(name: str) -> Iterator[None]:
    """Compile a module of kernels without optimization and gradients for a while; later uses have both."""
    import warp as wp

    module = wp.get_module(name)
    before = {option: module.options[option] for option in _SOONEST}
    wp.set_module_options(_SOONEST, module=module)
    module.unload()
    try:
        yield
    finally:
        wp.set_module_options(before, module=module)
        module.unload()


_HELPER = "helper"
"""A body that helps through Newton's translation, which refuses worlds without a joint, and leaves the model again."""


def _without_helper(mjcf: str) -> str:
    import mujoco

    spec = mujoco.MjSpec.from_string(mjcf)
    spec.delete(spec.body(_HELPER))
    spec.compile()
    return spec.to_xml()


def _compile_mjcf(scene: Scene, world: World) -> CompiledScene:
    """A scene with MJCF robots: what else stands in it is derived from its own Newton world."""
    from .builder import build_rest
    from .compiled_scene import differences, needs_implicit, options_that_differ
    from .mjcf import compile_mjcf, read_mjcf

    layout, mjcf_robots = world.layout, tuple(world.mjcf_robots.robots)
    names = {mjcf_robot.robot.name for mjcf_robot in mjcf_robots}
    bodies, joints = list(layout.body_name), [""] * layout.nv
    geoms = [shape.name if shape.collides else "" for shape in layout.shapes]
    mjcf, rest, corrected = "", build_rest(scene, names), ()
    if rest is not None:
        if not rest.builder.joint_count:
            rest.builder.add_body(label=_HELPER, mass=1.0, inertia=np.eye(3))
        mjcf, *found, corrected = _derive(rest)
        if rest.layout.nb < rest.builder.body_count:
            mjcf = _without_helper(mjcf)
        for entity in rest.layout.entities:
            whole = layout.entity(entity.name)
            for own, there in zip(entity.bodies, whole.bodies, strict=True):
                bodies[there] = found[0][own]
            for own, there in zip(entity.shapes, whole.shapes, strict=True):
                geoms[there] = found[1][own]
            for own, there in zip(entity.joints, whole.joints, strict=True):
                first, start = rest.layout.joint_qd_start[own], layout.joint_qd_start[there]
                for k in range(int(layout.joint_dof_dim[there].sum())):
                    joints[start + k] = found[2][first + k]
    notes = list(world.mjcf_robots.notes)
    files = [read_mjcf(mjcf_robot, file=scene.path) for mjcf_robot in mjcf_robots]
    names = (tuple(bodies), tuple(geoms))
    model = CompiledScene(layout, mjcf, *names, (), mjcf_robots=mjcf_robots).spec().compile()
    for mjcf_robot, file in zip(mjcf_robots, files, strict=True):
        name = mjcf_robot.robot.name
        own = compile_mjcf(file, mjcf_robot, file=scene.path)
        for j in range(own.njnt):
            start = layout.joint_qd_start[layout.entity(name).joints[0]] + own.jnt_dofadr[j]
            joints[start] = f"{name}/{own.joint(j).name}"
        notes += differences(own, model, name)
        if differ := options_that_differ(files[0].spec, file.spec):
            notes.append(f"{name}: options of the first MJCF file hold instead of its own: {', '.join(differ)}")
    if needs_implicit(files[0].spec, mjcf_robots):
        notes.append("the servos of drives are integrated by implicitfast, unless engine.integrator says otherwise")
    timestep = float(files[0].spec.option.timestep)
    joints = tuple(joints)
    repaired = (*world.repaired, *corrected)
    return CompiledScene(
        layout, mjcf, *names, joints, world.actuator_name, mjcf_robots, tuple(notes), timestep, repaired
    )


def _fetch(folder: Path, key: str) -> CompiledScene:
    """Read one cache entry.

    Raises:
        ValueError: If its files do not belong together. A damaged entry may raise otherwise, too.
    """
    entry = json.loads((folder / f"{key}.json").read_text())
    if entry["digest"] != _digest(entry["names"], folder / f"{key}.npz", folder / f"{key}.xml"):
        raise ValueError("a damaged cache entry")
    layout, mjcf = Layout.load(folder / f"{key}.npz"), (folder / f"{key}.xml").read_text()
    *names, mjcf_robots, notes, timestep, repaired = entry["names"]
    return CompiledScene(
        layout, mjcf, *map(tuple, names), _mjcf_robots(mjcf_robots), tuple(notes), timestep, tuple(repaired)
    )


def _mjcf_robots(entries: list[dict]) -> tuple[MjcfRobot, ...]:
    """Entries that :func:`_store` wrote about MJCF robots."""
    if not entries:
        return ()
    from ..schema_bodies import Robot
    from .mjcf import MjcfRobot, Servo

    return tuple(
        MjcfRobot(
            str(shipped_folder() / e["path"]),
            Robot.model_validate(e["robot"]),
            tuple(Servo(**s) for s in e["servos"]),
            tuple(e["place"]),
        )
        for e in entries
    )


def _digest(names: object, *files: Path) -> str:
    return hashlib.sha256(json.dumps(names).encode() + b"".join(file.read_bytes() for file in files)).hexdigest()


def _store(compiled: CompiledScene, folder: Path, key: str) -> None:
    """Write one cache entry; the file that is read first is moved into place last."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        parts = Path(work)
        compiled.layout.save(parts / "npz.npz")
        (parts / "xml").write_text(compiled.mjcf)
        names = [compiled.body_name, compiled.geom_name, compiled.joint_name, compiled.actuator_name]
        names += [
            [_entry(mjcf_robot) for mjcf_robot in compiled.mjcf_robots],
            compiled.notes,
            compiled.timestep,
            compiled.repaired,
        ]
        entry = {"names": names, "digest": _digest(names, parts / "npz.npz", parts / "xml")}
        (parts / "json").write_text(json.dumps(entry))
        os.replace(parts / "npz.npz", folder / f"{key}.npz")
        os.replace(parts / "xml", folder / f"{key}.xml")
        os.replace(parts / "json", folder / f"{key}.json")


def _entry(mjcf_robot: MjcfRobot) -> dict:
    servos = [asdict(servo) for servo in mjcf_robot.servos]
    robot = mjcf_robot.robot.model_dump(mode="json")
    return {"path": _kept_path(mjcf_robot.path), "robot": robot, "servos": servos, "place": mjcf_robot.place}


def _cache_key(scene: Scene) -> str | None:
    """Hash of everything the compiled scene depends on, or None when that cannot be told (USD layers)."""
    base = scene.path.parent if scene.path else None
    digest = hashlib.sha256(_maker())
    bodies = dict.fromkeys(("robot", "object", "obstacle", "ground"), True)
    digest.update(scene.model_dump_json(include={**bodies, "engine": {"gravity"}}).encode())
    for robot in scene.robot:
        key = f"robot.{robot.name}.asset"
        path = resolve_asset(robot.asset, base=base, key=key, file=scene.path)
        if asset_kind(path, key=key, file=scene.path) is AssetKind.USD:
            return None
    for file in files_of(scene):
        digest.update(_kept_path(file).encode() + file.read_bytes())
    return digest.hexdigest()[:32]


@functools.cache
def _maker() -> bytes:
    """Versions and source of what compiles scenes."""
    versions = [importlib.metadata.version(name).encode() for name in ("warpmpc", "newton", "mujoco", "warp-lang")]
    return b"".join((*versions, *(source.read_bytes() for source in sorted(Path(__file__).parent.glob("*.py")))))


def _kept_path(file: str | Path) -> str:
    """A path as entries have it: below the shipped scenes it is relative to them, wherever they are installed."""
    folder = shipped_folder().resolve()
    path = Path(file).resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(file)


def compile_shipped(folder: Path, scenes: Sequence[Scene]) -> None:
    """Compile scenes for the wheel, into a folder from which :func:`compile_scene` takes them.

    Raises:
        SceneError: As :func:`compile_scene`.
    """
    for scene in scenes:
        _store(with_equilibrium(_compile(scene)), folder, _cache_key(scene))


def files_of(scene: Scene) -> list[Path]:
    """Files that a scene's robots and meshes are read from; of USD files the first layer alone.

    Raises:
        SceneError: If one cannot be found.
    """
    base, found = (scene.path.parent if scene.path else None), []
    for robot in scene.robot:
        key = f"robot.{robot.name}.asset"
        path = resolve_asset(robot.asset, base=base, key=key, file=scene.path)
        usd = asset_kind(path, key=key, file=scene.path) is AssetKind.USD
        found += [path] if usd else asset_files(path)
    for item in (*scene.object, *scene.obstacle):
        if item.mesh:
            found.append(resolve_asset(item.mesh, base=base, key=f"{item.name}.mesh", file=scene.path))
    return found
