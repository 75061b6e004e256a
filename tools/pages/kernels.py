#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write docs/reference/kernels.md: the kernels that a plan launches with each engine.

    python tools/pages/kernels.py              # plans with every engine on the CPU, writes the page
    python tools/pages/kernels.py --check      # writes nothing; exit code 1 when the page is another

The page is read by tests/tools/test_kernels_page.py.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import warp as wp

import warpmpc

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "kernels.md"
SCENE = "omni_push_box"
ENGINES = ("fused", "mujoco", "mujoco_warp", "newton")
OURS = "warpmpc.kernels."
WRITTEN = {"launch_kernel": "written for the model", "evaluate_kernel": "written for the terms"}
HEAD = f"""# Kernels of a plan

What one plan of the scene `{SCENE}` launches on a CPU, in the order of the first launch, engine by engine:
`python tools/pages/kernels.py`. Files are those of `kernels/`. The last two launch MuJoCo Warp's
besides.

"""


def launched(engine: str) -> dict[str, str]:
    """Kernels that a plan launches, each with its file, in the order in which they are launched first.

    Args:
        engine: The engine; its kernels are those of the first plan, which is recorded for all later ones.
    """
    found: dict[str, str] = {}

    def noting(launch: Callable) -> Callable:
        def noted(kernel: wp.Kernel, *args: object, **options: object) -> object:
            found.setdefault(*_named(kernel))
            return launch(kernel, *args, **options)

        return noted

    scene = warpmpc.load_scene(SCENE, overrides=["planner.samples=16", "engine.threads=1"])
    controller = warpmpc.Controller(scene, engine=engine, device="cpu")
    state = warpmpc.State(controller.layout.joint_q, controller.layout.joint_qd)
    with patch.object(wp, "launch", noting(wp.launch)), patch.object(wp, "launch_tiled", noting(wp.launch_tiled)):
        controller.plan(state)
    return found


def _named(kernel: wp.Kernel) -> tuple[str, str]:
    """Name and file of a kernel."""
    module, name = kernel.module.name, kernel.key.rpartition("__locals__")[2].strip("_")
    if module.startswith(OURS):
        return name, f"`{module.removeprefix(OURS).replace('.', '/')}.py`"
    return name, WRITTEN.get(name, "")


def page() -> str:
    """The page's text."""
    engines = {name: launched(name) for name in ENGINES}
    files = {kernel: file for found in engines.values() for kernel, file in found.items() if file}
    lines = ["|kernel|file|" + "|".join(f"`{name}`" for name in ENGINES) + "|", "|---|---|" + "---|" * len(ENGINES)]
    for kernel in _ordered([list(found) for found in engines.values()]):
        if kernel in files:
            marks = "|".join("yes" if kernel in found else "-" for found in engines.values())
            lines.append(f"|`{kernel}`|{files[kernel]}|{marks}|")
    return HEAD + "\n".join(lines) + "\n"


def _ordered(lists: list[list[str]]) -> list[str]:
    """All names, each list's in its own order."""
    out = list(lists[0])
    for names in lists[1:]:
        at = 0
        for name in names:
            if name in out:
                at = out.index(name) + 1
            else:
                out.insert(at, name)
                at += 1
    return out


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, tell whether the page would change")
    args = parser.parse_args(arguments)
    text = page()
    changed = not PAGE.exists() or PAGE.read_text(encoding="utf-8") != text
    if changed and not args.check:
        PAGE.write_text(text, encoding="utf-8")
    if changed:
        print(f"docs/reference/{PAGE.name}: {'is not what plans launch' if args.check else 'written'}")
    return int(args.check and changed)


if __name__ == "__main__":
    sys.exit(main())
