# SPDX-License-Identifier: Apache-2.0
"""A scene compiled once: Newton world → MuJoCo model and state layout, kept in a cache on disk.

Building the Newton world and translating it takes seconds, most of them imports. The result depends only on the
scene's bodies and on its asset files, so it is stored under a hash of those: a later run of the same scene needs
neither Newton nor its solver to start moving.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import os
import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from .assets import AssetKind, asset_kind, resolve_asset
from .layout import Layout

if TYPE_CHECKING:
    from ..scene.schema import Scene


@dataclass(frozen=True)
class CompiledScene:
    """One world of a scene as the MuJoCo engine needs it."""

    layout: Layout
    mjcf: str
    """The MuJoCo model that ``SolverMuJoCo`` compiles from the Newton model, as XML with meshes inline."""
    body_name: tuple[str, ...]
    """MuJoCo name of each Newton body."""
    geom_name: tuple[str, ...]
    """MuJoCo name of each shape, empty for shapes that do not collide."""
    joint_name: tuple[str, ...]
    """MuJoCo name of each joint dof."""


def compile_scene(scene: Scene, *, cache: bool = True) -> CompiledScene:
    """Compile a scene, or fetch it from the cache.

    Args:
        scene: The scene.
        cache: Whether to read and write the cache on disk; set the environment variable ``WARPMPC_CACHE`` to move it.

    Raises:
        SceneError: If an asset is missing or broken, or lacks a joint or link the scene names.
    """
    key = _cache_key(scene) if cache else None
    folder = cache_folder()
    if key:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return _fetch(folder, key)
    compiled = _compile(scene)
    if key:
        with contextlib.suppress(OSError):
            _store(compiled, folder, key)
    return compiled


def cache_folder() -> Path:
    """Where compiled scenes are kept."""
    return Path(os.environ.get("WARPMPC_CACHE") or platformdirs.user_cache_dir("warpmpc")) / "scenes"


def _compile(scene: Scene) -> CompiledScene:
    import newton
    import warp as wp

    from .builder import build_world

    world = build_world(scene)
    with wp.ScopedDevice("cpu"), tempfile.TemporaryDirectory() as folder:
        model = world.builder.finalize(device="cpu")
        path = Path(folder) / "scene.xml"
        solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, save_to_mjcf=str(path))
        mjcf = path.read_text()
    mj = solver.mj_model
    bodies = [""] * world.layout.nb
    for i, body in enumerate(solver.mjc_body_to_newton.numpy()[0]):
        if body >= 0:
            bodies[body] = mj.body(i).name
    geoms = [""] * len(world.layout.shapes)
    for i, shape in enumerate(solver.mjc_geom_to_newton_shape.numpy()[0]):
        if shape >= 0:
            geoms[shape] = mj.geom(i).name
    joints = [""] * world.layout.nv
    for i, (joint, dof) in enumerate(
        zip(solver.mjc_jnt_to_newton_jnt.numpy()[0], solver.mjc_jnt_to_newton_dof.numpy()[0], strict=True)
    ):
        one_axis = mj.jnt_type[i] in (2, 3)  # slide or hinge; free and ball joints are found by their first dof
        joints[dof if one_axis else world.layout.joint_qd_start[joint]] = mj.joint(i).name
    return CompiledScene(world.layout, mjcf, tuple(bodies), tuple(geoms), tuple(joints))


def _fetch(folder: Path, key: str) -> CompiledScene:
    """Read one cache entry.

    Raises:
        ValueError: If its files do not belong together. A damaged entry may raise otherwise, too.
    """
    entry = json.loads((folder / f"{key}.json").read_text())
    if entry["digest"] != _digest(entry["names"], folder / f"{key}.npz", folder / f"{key}.xml"):
        raise ValueError("a damaged cache entry")
    layout = Layout.load(folder / f"{key}.npz")
    return CompiledScene(layout, (folder / f"{key}.xml").read_text(), *(tuple(names) for names in entry["names"]))


def _digest(names: object, *files: Path) -> str:
    return hashlib.sha256(json.dumps(names).encode() + b"".join(file.read_bytes() for file in files)).hexdigest()


def _store(compiled: CompiledScene, folder: Path, key: str) -> None:
    """Write one cache entry; the file that is read first is moved into place last."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        parts = Path(work)
        compiled.layout.save(parts / "npz.npz")
        (parts / "xml").write_text(compiled.mjcf)
        names = [compiled.body_name, compiled.geom_name, compiled.joint_name]
        entry = {"names": names, "digest": _digest(names, parts / "npz.npz", parts / "xml")}
        (parts / "json").write_text(json.dumps(entry))
        os.replace(parts / "npz.npz", folder / f"{key}.npz")
        os.replace(parts / "xml", folder / f"{key}.xml")
        os.replace(parts / "json", folder / f"{key}.json")


def _cache_key(scene: Scene) -> str | None:
    """Hash of everything the compiled scene depends on, or None when that cannot be told (USD layers)."""
    base = scene.path.parent if scene.path else None
    digest = hashlib.sha256()
    digest.update(scene.model_dump_json(include={"robot", "object", "obstacle", "ground"}).encode())
    for package in ("warpmpc", "newton", "mujoco", "warp-lang"):
        digest.update(importlib.metadata.version(package).encode())
    room = Path(__file__).parent
    sources = [Path(__file__), *(room / f"{name}.py" for name in ("axes", "builder", "controls", "layout"))]
    for source in sources:
        digest.update(source.read_bytes())
    for robot in scene.robot:
        path = resolve_asset(robot.asset, base=base, key=f"robot.{robot.name}.asset", file=scene.path)
        if asset_kind(path) is AssetKind.USD:
            return None
        text = path.read_bytes()
        digest.update(str(path).encode() + text)
        for name in re.findall(rb'file(?:name)?\s*=\s*"([^"]+)"', text):
            _stamp(digest, path, name.decode(errors="replace"))
    for item in (*scene.object, *scene.obstacle):
        if item.mesh:
            path = resolve_asset(item.mesh, base=base, key=f"{item.name}.mesh", file=scene.path)
            digest.update(str(path).encode() + path.read_bytes())
    return digest.hexdigest()[:32]


def _stamp(digest, asset: Path, name: str) -> None:
    """Add the time and size of a file that an asset names, as far as it is found near the asset."""
    tail = re.sub(r"^(package|model|file)://", "", name)
    for parent in asset.parents:
        file = parent / tail
        if file.is_file():
            stat = file.stat()
            digest.update(f"{file} {stat.st_mtime_ns} {stat.st_size}".encode())
            return
