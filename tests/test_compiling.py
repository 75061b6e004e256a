# SPDX-License-Identifier: Apache-2.0
"""Compiling is shown while it lasts, and only then."""

import io
import logging
import sys

import pytest
import warp as wp

from warpmpc.compiling import compile_kernel


def make(number: float):
    """A kernel in a module of its own; another number is another module."""
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
