# SPDX-License-Identifier: Apache-2.0
"""Compiled code of the CPU under AddressSanitizer with UBSan, or ThreadSanitizer: a script, in a separate process.

    python tests/helpers/sanitized.py random SEED COUNT      # that many random models
    python tests/helpers/sanitized.py limits                 # more contacts, corners and sides than there is room for
    python tests/helpers/sanitized.py packages PART PARTS    # one part of the small models of installed packages
    python tests/helpers/sanitized.py threads CLASS          # a public class (threaded_use.py), used by several threads
    python tests/helpers/sanitized.py faulty                 # an index out of bounds, which is to be found
    python tests/helpers/sanitized.py racing CLASS           # a race of the worlds, which is to be found

:func:`run` starts it with the sanitizers' libraries. It prints a line for each model; what the sanitizers find is on
standard error, and an AddressSanitizer error ends it.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

CHECKS = (
    "array-bounds,bool,builtin,enum,integer-divide-by-zero,return,shift-base,shift-exponent,signed-integer-overflow,"
    "unreachable,vla-bound"
)
"""UBSan's checks; those of pointers (alignment, null, pointer-overflow) are left to AddressSanitizer: they stand at
every access, and compilers take minutes. Unoptimized, since then it takes seconds."""
LIBRARIES = {"address": ("libasan.so", "libubsan.so"), "thread": ("libtsan.so",)}
OPTIONS = {"ASAN_OPTIONS": "detect_leaks=0:detect_odr_violation=0", "TSAN_OPTIONS": "exitcode=0"}
IGNORED = "fun:*tile_shared_storage*\nfun:*_cpu_forward*dispatch*\nfun:*_cpu_forward\n"
"""Functions of Warp around a kernel: all threads write one address there, which kernels with tiles alone read."""
COPIES = """
#include <string.h>
void *__tsan_memcpy(void *to, const void *from, size_t n) { return memcpy(to, from, n); }
void *__tsan_memmove(void *to, const void *from, size_t n) { return memmove(to, from, n); }
void *__tsan_memset(void *to, int value, size_t n) { return memset(to, value, n); }
"""
"""What Warp's compiler calls and GCC's library lacks: it watches the C library's own."""
SMALL = 16
"""Most degrees of freedom of a package's model, whose source then compiles in seconds."""
WORLDS, STEPS = 21, 12
"""Worlds that fill no register to its end, and steps."""


def libraries(sanitizer: str = "address") -> list[str]:
    """Files of a sanitizer's libraries; none without a compiler that has them."""
    found = []
    for name in LIBRARIES[sanitizer]:
        try:
            told = subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return []
        found.append(told.stdout.strip())
    return found if all(os.path.isabs(path) for path in found) else []


def _flags(sanitizer: str, folder: Path) -> str:
    """Warp's compiler flags; files that they name are in the folder."""
    if sanitizer == "address":
        return f"-fsanitize=address,{CHECKS} -fsanitize-recover={CHECKS} "
    (folder / "ignored").write_text(IGNORED)
    return f"-fsanitize=thread -fsanitize-ignorelist={folder / 'ignored'} "


def _preloaded(sanitizer: str, folder: Path) -> str:
    """Libraries that the process begins with."""
    if sanitizer == "address":
        return " ".join(libraries())
    command = ["gcc", "-shared", "-fPIC", "-fno-builtin", "-xc", "-", "-o", str(folder / "copies.so")]
    subprocess.run(command, input=COPIES, text=True, check=True)
    return " ".join([*libraries(sanitizer), str(folder / "copies.so")])


def run(*arguments: str, timeout: float, sanitizer: str = "address") -> subprocess.CompletedProcess[str]:
    """Run the script with its own cache of kernels."""
    with tempfile.TemporaryDirectory() as folder:
        here = Path(__file__).parent
        paths = [str(here), str(here.parents[1] / "tools"), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {
            **os.environ,
            **OPTIONS,
            "LD_PRELOAD": _preloaded(sanitizer, Path(folder)),
            "PYTHONPATH": os.pathsep.join(paths),
            "SANITIZED_CACHE": folder,
            "SANITIZED_FLAGS": _flags(sanitizer, Path(folder)),
        }
        command = [sys.executable, __file__, *arguments]
        return subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=timeout, check=False, errors="replace"
        )


def reports(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Lines in which the sanitizers tell what they found; the end of the output of a process that ended otherwise."""
    signs = "runtime error:", "ERROR: AddressSanitizer", "WARNING: ThreadSanitizer", "FATAL: ThreadSanitizer"
    blocks = [text for text in done.stderr.split("=" * 18) if not _of_others(text)]
    found = [line for text in blocks for line in text.splitlines() if any(sign in line for sign in signs)]
    return found or (done.stderr.splitlines()[-5:] or ["it died"] if done.returncode else [])


def _of_others(text: str) -> bool:
    """Whether a race is with a thread of MuJoCo's pool or of USD's, whose locks are unseen, and no code of Warp's."""
    alien = "GLOBAL__N_14Pool" in text or "libtbb" in text
    return alien and re.search(r"^ +#\d+ .*(\(0x|warp\.so)", text, re.MULTILINE) is None


def roll(text: str | mujoco.MjModel, lanes: int | None) -> None:
    """Roll out from ordinary states, from far ones and fast, and from some that are no numbers.

    Args:
        text: The model.
        lanes: Worlds in a number; those of the public rollouts if None.
    """
    from fused_models import controls, starts
    from shared.plain_rollout import PlainRollout

    from warpmpc.physics import rollout

    model = mujoco.MjModel.from_xml_string(text) if isinstance(text, str) else text
    control = controls(model, STEPS, WORLDS)
    engine = PlainRollout(model, WORLDS, STEPS, lanes=lanes) if lanes else rollout.Rollout(fall_back=False)
    for case, speed in enumerate((1.0, 30.0, 1.0)):
        q, v = starts(model, WORLDS, seed=case, speed=speed)
        rng = np.random.default_rng(case)
        if case == 1:
            q += 0.2 * rng.normal(size=q.shape)
        if case == 2:
            bad = [np.nan, np.inf, -1e12, 1e30]
            q[::5, -1] = np.resize(bad, len(q[::5]))
            v[2::5, 0] = np.resize(bad, len(v[2::5]))
        if lanes:
            engine(q, v, control)
        else:
            state = np.hstack([np.zeros((WORLDS, 1)), q, v, np.zeros((WORLDS, model.na))])
            engine.rollout(model, mujoco.MjData(model), state, control.swapaxes(0, 1), nstep=STEPS)


def random(seed_: int, count: int) -> None:
    """Random models."""
    from hypothesis import HealthCheck, Phase, given, seed, settings
    from random_models import models

    done = 0

    @seed(seed_)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(models())
    def each(text: str) -> None:
        nonlocal done
        roll(text, (None, 1, 4, 8)[(seed_ + done) % 4])
        done += 1
        print(f"model {done}", flush=True)

    each()


def prism(sides: int) -> str:
    """Corners of a disc of 10 cm radius and height."""
    turns = 2.0 * np.pi * np.arange(sides) / sides
    points = [(0.1 * np.cos(turn), 0.1 * np.sin(turn), z) for z in (-0.05, 0.05) for turn in turns]
    return " ".join(f"{x:.6f}" for x in np.ravel(points))


def _pile(*shapes: str, asset: str = "", ground: str = '<geom type="plane" size="4 4 .1"/>') -> str:
    bodies = "".join(
        f'<body pos="{0.03 * i:.2f} {-0.02 * i:.2f} {0.03 + 0.09 * i:.2f}" euler="{3 * i} {2 * i} {45 * i}">'
        f"<freejoint/><geom {shape}/></body>"
        for i, shape in enumerate(shapes)
    )
    return f'<mujoco><option timestep="0.004"/><asset>{asset}</asset><worldbody>{ground}{bodies}</worldbody></mujoco>'


def limits() -> None:
    """Models that reach what there is room for."""
    from warpmpc.physics import source

    rng = np.random.default_rng(0)
    ball, box, disc = 'type="sphere" size=".1"', 'type="box" size=".1 .08 .05"', 'type="cylinder" size=".1 .05"'
    cloud = " ".join(f"{x:.5f}" for x in 0.1 * rng.normal(size=3 * 400))
    meshes = f'<mesh name="disc" vertex="{prism(256)}"/><mesh name="stone" vertex="{cloud}"/>'
    mesh = ['type="mesh" mesh="disc"', 'type="mesh" mesh="stone"']
    field = '<hfield name="f" nrow="12" ncol="12" size="1 1 .3 .1" elevation="{}"/>'.format(
        " ".join(f"{x:.3f}" for x in rng.uniform(size=144))
    )
    hills = '<geom type="hfield" hfield="f" pos="0 0 -.1"/>'
    cases = {
        "boxes": (_pile(*[box] * 6), 64),
        "more contacts than room": (_pile(*[ball] * 7, *[box] * 3), 6),
        "discs and boxes": (_pile(disc, box, disc, 'type="capsule" size=".05 .1"'), 64),
        "hulls": (_pile(mesh[0], mesh[1], mesh[0], box, asset=meshes), 64),
        "hulls, no room": (_pile(mesh[0], mesh[1], mesh[0], box, disc, asset=meshes), 3),
        "heightfield": (_pile(box, ball, mesh[1], asset=meshes + field, ground=hills), 64),
        "heightfield, no room": (_pile(box, ball, mesh[0], asset=meshes + field, ground=hills), 4),
    }
    for name, (text, room) in cases.items():
        source.MOST_CONTACTS = room
        for lanes in (None, 1):
            roll(text, lanes)
            print(f"{name}, {lanes or 'all'} lanes", flush=True)


def packages(part: int, parts: int) -> None:
    """Small models of installed packages that this physics steps: every so many, in the order of their names."""
    from shared.packages import load_file, package_files

    from warpmpc.physics.sensors import unread_sensors
    from warpmpc.physics.unsupported import missing

    for name in sorted(package_files())[part::parts]:
        try:
            model = load_file(name)
        except (ValueError, OSError):
            continue  # a part of others, or meshes that the package lacks
        if 0 < model.nv <= SMALL and not missing(model) and not unread_sensors(model):
            roll(model, None)
            print(name, flush=True)


def planted(wrong: str) -> None:
    """End every rollout's source with a fault."""
    from warpmpc.physics.source_parts import Parts

    write = Parts.rollouts
    Parts.rollouts = lambda self: write(self) + wrong


def faulty() -> None:
    """A source with an error of each kind."""
    planted("""
    {
        const int n = k.domains + 3;
        float few[4] = {};
        w.q[0] += (float)(1 << (n + 28));  // before the one that ends it
        few[n] = 1.0f;
        w.q[0] += few[n];
    }""")
    roll(_pile('type="box" size=".1 .08 .05"'), 1)


def threads(name: str) -> None:
    """A public class in several threads."""
    from threaded_use import USES

    USES[name]()
    print(name, flush=True)


def racing(name: str) -> None:
    """Worlds that count in one place."""
    planted("{ static int count = 0; count += 1; w.q[0] += 1e-30f * count; }")
    threads(name)


def main() -> None:
    """Run what the command line says."""
    import warp as wp

    wp.config.quiet = True
    wp.config.kernel_cache_dir = os.environ["SANITIZED_CACHE"]
    wp.config.cpu_compiler_flags, wp.config.optimization_level = os.environ["SANITIZED_FLAGS"], 0
    command, *arguments = sys.argv[1:]
    chosen = {f.__name__: f for f in (random, limits, packages, threads, faulty, racing)}[command]
    chosen(*(int(a) if a.isdecimal() else a for a in arguments))


if __name__ == "__main__":
    main()
