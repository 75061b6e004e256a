# SPDX-License-Identifier: Apache-2.0
"""Whatever ends the robot's loop, the last command in force is the safe one."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from drills import MOVE, drill
from small_scenes import DISC

from warpmpc.loop.realtime.loop import NAMES, STOPS

PROGRAM = """
import sys
from pathlib import Path
from drills import drill

loop, robot, planner = drill()
apply, commands = robot.apply, Path(sys.argv[1]).open("w", buffering=1)

def noted(control):
    apply(control)
    print(*control, file=commands)

robot.apply = noted
print("driving", flush=True)
loop.run(lambda: False)
"""


def wait_for(condition) -> None:
    """Wait for a condition, half a minute at most."""
    deadline = time.monotonic() + 30.0
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)


def driving(commands: Path, number: int) -> subprocess.Popen:
    """A program that drives, writes its commands into a file, and handles a signal as the system does."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2] / "helpers")}
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(commands)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    while program.stdout.readline() not in ("driving\n", ""):
        pass
    wait_for(lambda: commands.exists() and commands.read_text().count("\n") > 20)
    return program


ENDS = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]


def test_a_program_that_gets_ctrl_c_sends_the_safe_command_last(tmp_path):
    commands = tmp_path / "commands"
    program = driving(commands, signal.SIGINT)
    program.send_signal(signal.SIGINT)
    _, errors = program.communicate(timeout=30)
    sent = np.loadtxt(commands)
    np.testing.assert_allclose(sent[-2], MOVE)
    assert not sent[-1].any()
    assert program.returncode == -signal.SIGINT
    assert "Traceback" in errors  # Python prints one at Ctrl-C


def test_ctrl_z_stops_the_program_after_the_safe_command_and_it_goes_on_until_it_is_told_to_end(tmp_path):
    commands = tmp_path / "commands"
    program = driving(commands, signal.SIGTSTP)
    program.send_signal(signal.SIGTSTP)
    _, status = os.waitpid(program.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)
    sent = np.loadtxt(commands)
    np.testing.assert_allclose(sent[-2], MOVE)
    assert not sent[-1].any()
    program.send_signal(signal.SIGCONT)
    wait_for(lambda: len(np.loadtxt(commands)) > len(sent) + 20)
    np.testing.assert_allclose(np.loadtxt(commands)[-1], MOVE)
    program.send_signal(signal.SIGTERM)
    _, errors = program.communicate(timeout=30)
    assert not np.loadtxt(commands)[-1].any()
    assert program.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in errors


@pytest.mark.parametrize("number", [*ENDS, signal.SIGRTMIN + 3], ids=str)
def test_every_signal_that_ends_a_program_ends_the_loop(number):
    loop, robot, _ = drill()
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit):
            loop.run(until(10, lambda: signal.raise_signal(number)))
    finally:
        signal.signal(number, before)
    assert not robot.sent[-1][1].any()


def test_no_signal_that_ends_a_program_is_left_out():
    kept = {signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH}
    faults = {signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT, signal.SIGTRAP}
    stops = {getattr(signal, name) for name in STOPS}
    known = {*ENDS, *kept, *faults, *stops, signal.SIGSYS}
    assert [number for number in signal.valid_signals() if number < signal.SIGRTMIN and number not in known] == []


class Enough(Exception):
    """The end, in the words of a program that handles SIGTERM itself."""


@pytest.fixture
def heard():
    """Signals that the program's own handler was told of."""
    numbers = []

    def handle(number, frame):
        numbers.append(number)
        raise Enough

    before = signal.signal(signal.SIGTERM, handle)
    yield numbers
    assert signal.getsignal(signal.SIGTERM) is handle  # as it was
    signal.signal(signal.SIGTERM, before)


def until(count: int, do=lambda: None):
    """True after so many ticks, at which something is done."""
    ticks = []

    def over() -> bool:
        ticks.append(1)
        if len(ticks) == count:
            do()
        return len(ticks) >= count

    return over


def terminate() -> None:
    signal.raise_signal(signal.SIGTERM)


def test_a_program_that_handles_the_signal_itself_hears_it(heard):
    loop, robot, _ = drill()
    with pytest.raises(Enough):
        loop.run(until(10, terminate))
    assert heard == [signal.SIGTERM]
    assert not robot.sent[-1][1].any()


def test_no_further_signal_interrupts_the_safe_command(heard):
    loop, robot, _ = drill(agent={"slew": 20.0})
    apply = robot.apply

    def interrupted(control):
        if heard:
            terminate()
        apply(control)

    robot.apply = interrupted
    with pytest.raises(Enough):
        loop.run(until(10, terminate))
    assert heard == [signal.SIGTERM]
    assert not robot.sent[-1][1].any()


def test_a_signal_in_the_last_tick_is_heard_after_the_safe_command(heard):
    loop, robot, _ = drill(agent={"slew": 20.0})
    apply, over = robot.apply, until(10)

    def interrupted(control):
        if 0.0 < control[0] < 0.3:  # on the way to zero
            terminate()
        apply(control)

    robot.apply = interrupted
    with pytest.raises(Enough):
        loop.run(over)
    assert heard == [signal.SIGTERM]
    assert not robot.sent[-1][1].any()


def test_an_ignored_signal_stays_ignored():
    loop, robot, _ = drill()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        loop.run(until(10, lambda: signal.raise_signal(signal.SIGHUP)))
        loop.run(until(10))
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    np.testing.assert_allclose(robot.sent[-2][1], MOVE)


def test_a_slew_is_kept_on_the_way_to_the_safe_command():
    loop, robot, _ = drill(agent={"slew": 5.0})
    before = len(robot.sent)
    loop.run(until(10))
    last = np.array([control for _, control in robot.sent[before + 9 :]])
    np.testing.assert_allclose(last[0], MOVE)
    assert np.abs(np.diff(last, axis=0)).max() <= 5.0 / loop.scene.agent.rate + 1e-6
    assert not last[-1].any()


def test_brakes_end_with_the_loop():
    drive = {"mode": "acceleration", "damping": 300.0, "limit": 20.0, "speed_limit": 1.0}
    loop, robot, _ = drill(robot=[DISC | {"drive": drive}])
    speed = robot.plant.state.joint_qd[0]
    before = len(robot.sent)
    loop.run(until(1))
    last = np.array([control for _, control in robot.sent[before + 1 :]])
    assert last[0, 0] < -0.9 * speed / loop.scene.timing.control_dt
    assert not last[-1].any()
    for _ in range(250):  # nobody sends anything any more
        robot.plant.apply(last[-1])
    assert abs(robot.plant.state.joint_qd[0]) < speed


def test_a_loop_in_another_thread_runs_and_ends_safely():
    loop, robot, _ = drill()
    thread = threading.Thread(target=loop.run, args=[until(10)])
    thread.start()
    thread.join(30.0)
    assert not thread.is_alive()
    assert not robot.sent[-1][1].any()
