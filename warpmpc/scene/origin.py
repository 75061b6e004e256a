# SPDX-License-Identifier: Apache-2.0
"""Origin of a result: state of the source, versions, hardware."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

PACKAGES = ("newton", "warp-lang", "mujoco", "numpy")
"""Packages whose versions can change the bits of a result."""


@cache
def origin() -> dict[str, Any]:
    """Versions, source and hardware as this program found them, data for JSON; not to be changed."""
    return {"versions": versions(), "code": code_digest(), "revision": revision(), "hardware": hardware()}


def versions() -> dict[str, str]:
    """Version of warpmpc, of Python and of what computes."""
    from .. import __version__

    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"warpmpc": __version__, "python": platform.python_version(), **found}


def hardware() -> dict[str, Any]:
    """Processor, cores that may be used, GPUs, operating system."""
    import warp as wp

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": names[0] if names else platform.processor() or platform.machine(),
        "cores": cores,
        "gpus": [device.name for device in wp.get_cuda_devices()],
        "system": platform.platform(),
    }


def revision() -> str | None:
    """Git revision of the checkout that warpmpc runs from, ``-dirty`` where files differ; None if it is installed."""
    here = Path(__file__).resolve()

    def git(*arguments: str) -> str | None:
        command = ["git", "--no-optional-locks", "-C", str(here.parent), *arguments]  # nothing is written there
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", here.name) is None:  # some other repository lies around it
        return None
    name = git("describe", "--always", "--abbrev=12", "--exclude=*")  # --dirty would lock the index
    return f"{name}-dirty" if name and git("status", "--porcelain", "--untracked-files=no") else name


def code_digest() -> str:
    """Hash of the sources of warpmpc and its kernels, so that results of several states of them can be told apart.

    It is the same wherever the sources lie, in a checkout or installed.
    """
    package = Path(__file__).parents[1]
    kernels = Path(importlib.util.find_spec("warpmpc.kernels").origin).parent
    found = {name: file for name, file in _sources(package) if name.parts[0] != "kernels"}
    found |= {"kernels" / name: file for name, file in _sources(kernels)}
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(name.as_posix().encode() + found[name].read_bytes())
    return digest.hexdigest()[:12]


def _sources(root: Path) -> Iterator[tuple[Path, Path]]:
    """Every source below a folder: its name there, and the file."""
    for folder, _, files in os.walk(root, followlinks=True):
        for file in files:
            if file.endswith((".py", ".h")):
                path = Path(folder) / file
                yield path.relative_to(root), path
