# SPDX-License-Identifier: Apache-2.0
"""Compiling is shown while it lasts, and only then."""

import io
import json
import logging
import os
import pty
import subprocess
import sys

import pytest
import warp as wp

from warpmpc.physics.runtime.compiling import compile_kernel, compile_time


def make(number: float):
    """A kernel in a separate module; another number is another module."""
    constant = wp.constant(number)

    @wp.kernel(module="unique", enable_backward=False)
    def add_kernel(x: wp.array[float]):
        x[wp.tid()] += constant

    return add_kernel


@pytest.fixture
def cache(tmp_path, monkeypatch):
    wp.init()  # it sets the folder
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))


def test_the_log_tells_of_compiling_once(cache, caplog):
    with caplog.at_level(logging.DEBUG, logger="warpmpc"):
        kernel = make(1.25)
        compile_kernel(kernel, "cpu", 32, "a test")
        first = [record.message for record in caplog.records]
        compile_kernel(kernel, "cpu", 32, "a test")  # loaded
        compile_kernel(make(1.25), "cpu", 32, "a test")  # on disk
    assert first[0] == "compiling a test for cpu, once"
    assert first[1].endswith(" s")
    assert [record.message for record in caplog.records] == first
    x = wp.zeros(3, dtype=float, device="cpu")
    wp.launch(kernel, dim=3, inputs=[x], device="cpu")
    assert (x.numpy() == 1.25).all()


def test_a_terminal_shows_a_line_and_is_left_clean(cache, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    kernel = make(2.5)
    compile_kernel(kernel, "cpu", 32, "the physics of a scene")
    shown = screen.getvalue()
    assert "compiling the physics of a scene" in shown
    compile_kernel(kernel, "cpu", 32, "the physics of a scene")
    assert screen.getvalue() == shown


def test_nothing_is_compiled_again_by_the_first_launch(cache, capfd, monkeypatch):
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    kernel = make(3.75)
    compile_kernel(kernel, "cpu", 256, "a test")
    told = capfd.readouterr()
    assert "(compiled)" in told.out + told.err
    wp.launch(kernel, dim=1, inputs=[wp.zeros(1, dtype=float, device="cpu")], device="cpu")
    told = capfd.readouterr()
    assert "load on device" not in told.out + told.err


BESIDE = """
import collections, json, threading
import warp as wp
from warpmpc.physics.runtime import compiling, kernel_cache, launch

wp.init()
built = collections.Counter()
load = kernel_cache._load

def counted(module, *args, **keys):
    built[module.name] += not module.execs  # one that waited has it
    return load(module, *args, **keys)

kernel_cache._load = counted
compiling.PLANNING = {"engine.mujoco": 3.0, "engine.thread_pool": 1.0}
before = compiling.compile_beside()
wp.load_module("warpmpc.kernels.engine.mujoco", device="cpu", block_dim=1)
for thread in threading.enumerate():
    if thread is not threading.main_thread():
        thread.join()
print(json.dumps([before, compiling.compile_beside(), built]))
"""

USED = """
import json
import warp as wp
import warpmpc
from warpmpc.physics.runtime.compiling import PLANNING

scene = warpmpc.load_scene("pendulum", overrides=["timing.timeout=0.1"])
warpmpc.run_episode(scene, device="cpu", engine="fused")
loaded = [name for name, module in wp._src.context.user_modules.items() if module.execs]
kept = "warpmpc.kernels."
print(json.dumps([sorted(PLANNING), sorted(n.removeprefix(kept) for n in loaded if n.startswith(kept))]))
"""


def ran(code: str, folder) -> list:
    """JSON that a program prints, with its own cache of kernels."""
    environment = os.environ | ({"WARP_CACHE_PATH": str(folder)} if folder else {})
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_kernels_are_compiled_beside_other_work_and_never_twice(tmp_path):
    before, after, built = ran(BESIDE, tmp_path)
    assert before >= 4.0 / 3
    assert after == 0.0
    assert built == {"warpmpc.kernels.engine.mujoco": 1, "warpmpc.kernels.engine.thread_pool": 1}


def test_what_is_compiled_beside_is_what_a_plain_scene_uses():
    listed, used = ran(USED, None)
    assert listed == used


def test_tables_hardly_count_for_the_time_to_compile():
    code = "float f(float x) { return x + x; }\n" * 4000
    table = f"static const float mesh[300000] = {{{', '.join(['0.125f'] * 300000)}}};\n"
    assert compile_time(code + table) == pytest.approx(compile_time(code), rel=0.01)
    assert 1.0 < compile_time(code) < 10.0


@pytest.mark.parametrize(("options", "shown"), [((), True), (("--quiet",), False)])
def test_a_terminal_shows_the_scene_at_once(options, shown):
    screen, theirs = pty.openpty()
    command = [sys.executable, "-m", "warpmpc", "run", "pendulum", "--set", "timing.timeout=0.1", *options]
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, stdin=subprocess.DEVNULL) as process:
        os.close(theirs)
        said = b""
        try:
            while piece := os.read(screen, 65536):
                said += piece
        except OSError:  # the other end is closed
            pass
        assert process.wait(timeout=240) == 1
    os.close(screen)
    assert said.startswith(b"pendulum: ") == shown
