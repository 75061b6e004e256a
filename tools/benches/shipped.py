# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels that all scenes share, and the shipped scenes, for the wheel.

python tools/bench.py shipped                # into warpmpc/physics/runtime/objects, from where a wheel takes them
python tools/bench.py shipped --to FOLDER    # to be used with WARPMPC_KERNELS=FOLDER
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import warp as wp
from warp._src import build

import warpmpc
from warpmpc import kernels
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.episode import draws_bodies
from warpmpc.physics.runtime import kernel_cache
from warpmpc.scene.draw import draw_task
from warpmpc.scene.load import shipped_scenes
from warpmpc.scene.model.compiled import compile_scene, compile_shipped

PACKAGE = "package://"
"""Beginning of names of assets in other packages, which may not be there."""
SCENES = ("panda_reach", "quadruped_walk", "omni_push_box", "point_reach")
"""Scenes whose worlds Newton builds and translates with all of its kernels that any needs."""
NEWTONS = ("newton._src.geometry.inertia", "newton._src.utils.mesh")
"""Modules of Newton's that worlds with meshes need besides."""
_build = build.build_cpu


def _portable(*given: object, extra_flags: str = "", **options: object) -> None:
    """Warp's compiler, for more processors than this one."""
    _build(*given, extra_flags=extra_flags.replace("-march=native", kernel_cache.flags()), **options)


def shared_modules() -> list[str]:
    """Names of all modules in which warpmpc has kernels."""
    names = [found.name for found in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}.")]
    return [name for name in names if importlib.import_module(name) and wp.get_module(name).kernels]


def compile_shared(target: Path, modules: Sequence[str], scenes: Sequence[str]) -> None:
    """Compile modules, and what Newton needs to build scenes, into a folder of object files."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as folder:
        _compile(Path(folder), modules, scenes)
        for code in Path(folder).glob("wp_*/*.o"):
            (meta,) = code.parent.glob("*.meta")
            for file in (code, meta):
                shutil.copy(file, target / f"{code.parent.name}{file.suffix}")


def _compile(folder: Path, modules: Sequence[str], scenes: Sequence[str]) -> None:
    """Compile into a folder of Warp's."""
    before, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(folder)
    kernel_cache.watch()
    build.build_cpu = _portable
    try:
        for name in modules:
            importlib.import_module(name)
            wp.load_module(name, device="cpu", block_dim=1)
        for scene in scenes:
            compile_scene(warpmpc.load_scene(scene), cache=False)
    finally:
        build.build_cpu, wp.config.kernel_cache_dir = _build, before


def main(arguments: list[str]) -> None:
    """Compile, and copy the object files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path(kernel_cache.__file__).with_name("objects"))
    given = parser.parse_args(arguments)
    os.environ["WARPMPC_KERNELS"] = os.devnull  # those that were compiled before count for nothing
    start_warp()
    target, begin = given.to / kernel_cache.target(), time.perf_counter()
    compile_shared(target, [*shared_modules(), *NEWTONS], SCENES)
    own = [scene for scene in map(warpmpc.load_scene, shipped_scenes()) if PACKAGE not in scene.model_dump_json()]
    shutil.rmtree(given.to / "scenes", ignore_errors=True)
    compile_shipped(given.to / "scenes", [*own, *(draw_task(scene, 0)[0] for scene in own if draws_bodies(scene))])
    size, seconds = sum(file.stat().st_size for file in given.to.rglob("*.*")), time.perf_counter() - begin
    print(f"{target}: {len(list(target.glob('*.o')))} modules, {len(own)} scenes, {size / 1e6:.1f} MB, {seconds:.0f} s")
