# SPDX-License-Identifier: Apache-2.0
"""Kernels that come compiled are used where they fit, and compiled where they do not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
MODULE = "warpmpc.kernels.engine.thread_pool"
MAKE = f"""
import sys
from pathlib import Path
sys.path.insert(0, "tools")
from benches.shipped import compile_shared
from warpmpc.cli.setup import start_warp
from warpmpc.physics.runtime.kernel_cache import target
start_warp()
compile_shared(Path(sys.argv[1]) / target(), ["{MODULE}"], [])
"""
USE = f"""
import sys
import warp as wp
from warpmpc.physics.runtime import kernel_cache, launch
from warpmpc.physics.runtime.compiling import ready
import {MODULE}
wp.config.log_level = wp.LOG_INFO  # says whether a module was compiled
wp.init()
if "old" in sys.argv:
    kernel_cache.LEVELS = {{key: (flags, {{"a part that none has"}}) for key, (flags, _) in
                              kernel_cache.LEVELS.items()}}
if "changed" in sys.argv:
    wp.set_module_options({{"max_unroll": 3}}, module={MODULE})
module = wp.get_module("{MODULE}")
print(ready(module, wp.get_device("cpu"), 1), wp.load_module(module, device="cpu", block_dim=1))
"""


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    done = subprocess.run([sys.executable, "-c", MAKE, folder], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def use(objects, tmp_path):
    """Loads the module in a process; whether it was known to be ready, what Warp said, and what was compiled."""

    def use(*how: str) -> tuple[bool, str, list[Path]]:
        environment = os.environ | {"WARPMPC_KERNELS": str(objects), "WARP_CACHE_PATH": str(tmp_path)}
        command = [sys.executable, "-c", USE, *how]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()[-1].startswith("True"), done.stdout, list(tmp_path.glob("*/wp_*"))

    return use


def test_a_kernel_that_comes_compiled_is_not_compiled(use):
    ready, said, compiled = use()
    assert ready
    assert "(cached)" in said
    assert compiled == []


@pytest.mark.parametrize("why", ["changed", "old"])
def test_a_kernel_that_does_not_fit_is_compiled(use, why):
    ready, said, compiled = use(why)
    assert not ready
    assert "(compiled)" in said
    assert len(compiled) == 1


def test_a_damaged_one_is_compiled(use, objects):
    (code,) = objects.rglob("*.o")
    whole = code.read_bytes()
    code.write_bytes(whole[: len(whole) // 2])
    try:
        _, said, compiled = use()
    finally:
        code.write_bytes(whole)
    assert "(compiled)" in said
    assert len(compiled) == 1
