# SPDX-License-Identifier: Apache-2.0
"""Kernels that all scenes share and that come compiled in the wheel, so that a first run compiles none of them.

They are for one version of Warp and a level of processors that nearly all reach. With any other, in a checkout, and
where their text has changed they are compiled as any other kernel.
"""

from __future__ import annotations

import os
import platform
from functools import cache
from pathlib import Path

import warp as wp
from warp._src import context

LEVELS = {"x86_64": ("-target-cpu x86-64-v3", {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"})}
"""Compiler flags for object files that run on more than this machine, and what a processor must have for them."""


def flags() -> str:
    """Compiler flags of the object files for this kind of machine."""
    return LEVELS.get(platform.machine(), ("", set()))[0]


def home() -> Path:
    """Folder of object files, there or not; the environment variable ``WARPMPC_KERNELS`` moves it."""
    return Path(os.environ.get("WARPMPC_KERNELS") or Path(__file__).with_name("objects"))


def target() -> str:
    """Name of the folder of object files for this version of Warp, its compiler and this kind of machine."""
    return f"{wp.__version__}-{context._get_cpu_target_hash(flags())}"


@cache
def _folder(home: Path) -> Path | None:
    """Folder of object files that this processor can run, None where there is none."""
    needed = LEVELS.get(platform.machine(), ("", set()))[1]
    folder = home / target()
    return folder if folder.is_dir() and needed <= set(context._get_cpu_feature_set() or ()) else None


def shipped(module: wp.Module, block_dim: int) -> tuple[Path, Path] | None:
    """Object file of a module on the CPU and its content as JSON, if it comes compiled as it is now."""
    folder = _folder(home())
    if folder is None:
        return None
    name = module.get_module_identifier(block_dim)
    code, meta = folder / f"{name}.o", folder / f"{name}.meta"
    return (code, meta) if code.is_file() and meta.is_file() else None
