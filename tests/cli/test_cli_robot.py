# SPDX-License-Identifier: Apache-2.0
"""Robots that a package registers are driven by ``warpmpc run --real-time --robot NAME``.

Slow ones by hand: pytest -m slow tests/cli/test_cli_robot.py
"""

import json

import numpy as np
import pytest
from program import SCENE

from warpmpc import RunLog, State, load_scene
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.registry import ROBOTS

ENDS = 0.3  # [s] on the robot's clock


class Drifting:
    """A robot that goes where it is sent, on its own clock."""

    simulated = True

    def __init__(self, scene, *, compiled, **_):
        self.state, self.tick = State.start(compiled.layout), 1.0 / scene.agent.rate
        self.time, self.sent, self.closed = 7.0, [], False

    @property
    def done(self):
        return self.time > 7.0 + ENDS

    def observe(self):
        return State(self.state.joint_q, self.state.joint_qd, time=self.time)

    def apply(self, control):
        self.sent.append(control.copy())
        self.state.joint_q[: len(control)] += control * self.tick
        self.time += self.tick

    def close(self):
        self.closed = True


@pytest.fixture
def made(monkeypatch):
    """The registered robot's runs."""
    made = []

    def make(*args, **keys):
        made.append(Drifting(*args, **keys))
        return made[-1]

    monkeypatch.setitem(ROBOTS, "drifting", make)
    return made


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "push.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path


SLOW = ["--real-time", "--engine", "mujoco", "--set", "engine.threads=1", "--set", "agent.plan_timeout=0.5"]


def test_a_registered_robot_is_sent_plans_until_it_ends_the_run(scene, command, made):
    done = command("run", str(scene), *SLOW, "--robot", "drifting", "--speed", "0.2", "--json", "--out", "drifted")
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert result["reason"] == "ended by the robot"
    assert result["sim_time_s"] == pytest.approx(ENDS, abs=0.01)
    assert result["plans"] > 3
    (robot,) = made
    assert robot.closed
    assert len(robot.sent) >= result["ticks"]
    assert np.abs(robot.sent).max() > 0.01
    assert not robot.sent[-1].any(), "the last command is the safe one"
    log = RunLog.load("drifted/episode.runlog")
    assert log.states.time[0] == pytest.approx(7.0)
    np.testing.assert_array_equal(log.controls.control, robot.sent[: len(log.controls)])
    layout = compile_scene(load_scene(str(scene))).layout
    base = [log.states.body_q[:, layout.body_name.index("base/base_link"), axis] for axis in (0, 1)]
    np.testing.assert_allclose(base, log.states.joint_q[:, :2].T, atol=1e-6)
    ages = log.controls.age[np.isfinite(log.controls.age)]
    assert 0.0 <= ages.min() < ages.max() < 1.0
    replayed = command("replay", "drifted")
    assert replayed.returncode == 0, replayed.stderr


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        pytest.param(["--set", "timing.timeout=0.1"], "timeout", marks=pytest.mark.slow),
        pytest.param(["--set", "failure=[{name='stuck', after=0.05}]"], "failed: stuck", marks=pytest.mark.slow),
        (["--set", "success={position=5.0}"], "goal reached"),
    ],
)
def test_the_scene_ends_the_run_of_a_robot_as_it_ends_a_plants(scene, command, made, changes, reason):
    done = command("run", str(scene), *SLOW, *changes, "--robot", "drifting", "--json")
    assert json.loads(done.stdout)["reason"] == reason, done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robot", "driftin", "--real-time"], "no robot 'driftin'; there is: simulated, zmq, drifting, ros2"),
        (["--robot", "drifting"], "goes with --real-time"),
        (
            ["--robot", "drifting", "--real-time", "--record", "a.rrd"],
            "--robot drifting: --record shows the simulated one alone: take --out or --npz",
        ),
    ],
)
def test_what_does_not_go_with_a_robot_is_refused(scene, command, made, options, message):
    done = command("run", str(scene), *options)
    assert done.returncode == 2
    assert message in " ".join(done.stderr.replace("│", " ").split())
    assert made == []


def test_a_robot_with_a_clock_of_its_own_is_not_slowed_down(scene, command, made, monkeypatch):
    monkeypatch.setattr(Drifting, "simulated", False)
    done = command("run", str(scene), *SLOW, "--robot", "drifting", "--speed", "0.5")
    assert done.returncode == 2
    assert "the robot 'drifting' is not simulated: its speed is 1, not 0.5" in done.stderr
