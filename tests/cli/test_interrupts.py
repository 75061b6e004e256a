# SPDX-License-Identifier: Apache-2.0
"""A Ctrl-C that a library swallows still ends the run."""

import signal
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Iterator
from typing import Annotated

import pytest
from pydantic import BaseModel, Discriminator, Tag

from warpmpc.cli import run as run_module
from warpmpc.cli.interrupts import Interrupts
from warpmpc.cli.outputs import Outputs
from warpmpc.cli.setup import RunArguments


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_a_swallowed_ctrl_c_is_raised_again():
    with Interrupts() as interrupts:
        interrupts.check()
        with pytest.raises(KeyboardInterrupt):  # this is where a library may drop it
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()


def test_signals_that_come_together_are_one_and_sigterm_is_like_ctrl_c():
    before = signal.getsignal(signal.SIGTERM)  # Ray may have left one
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)  # timeout(1) sends a process its signal and its group another
        assert interrupts.code == 143
    assert signal.getsignal(signal.SIGTERM) is before


def press_and_tag(value: object) -> str:
    signal.raise_signal(signal.SIGINT)
    return "whole" if isinstance(value, int) else "text"


class Goal(BaseModel):
    value: Annotated[Annotated[int, Tag("whole")] | Annotated[str, Tag("text")], Discriminator(press_and_tag)]


def test_ctrl_c_inside_pydantic_is_kept_for_later_and_makes_no_warning():
    goal = Goal.model_construct(value=3)
    with Interrupts() as interrupts, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert goal.model_dump() == {"value": 3}
        assert not said
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()


STUCK = """
import hashlib, os, signal, threading, time
from contextlib import suppress
import warpmpc.cli.interrupts as interrupts
interrupts.PATIENCE = 0.3
signal.signal(signal.SIGINT, signal.default_int_handler)
with interrupts.Interrupts():
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", 10**9)  # minutes in native code, other threads run
"""


AGAIN = """
with suppress(KeyboardInterrupt):
    signal.raise_signal(signal.SIGINT)
    time.sleep(5.0)
time.sleep(0.3)
"""
"""A Ctrl-C that something swallows."""


@pytest.mark.parametrize("before", ["", AGAIN], ids=["first", "after one that was swallowed"])
def test_native_code_that_takes_minutes_is_left(before):
    program = STUCK.replace("    threading.Timer", textwrap.indent(before, "    ") + "    threading.Timer")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "")


def test_ctrl_c_while_a_scene_is_built_ends_the_run(monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "Setup", interrupted)
    arguments = RunArguments(source="omni_push_box", device="cpu")
    quiet = {"jobs": None, "results_file": None, "json_lines": False, "quiet": True}
    assert run_module.run(arguments, seeds=[0], envs=1, outputs=Outputs(), **quiet) == 130
