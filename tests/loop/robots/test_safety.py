# SPDX-License-Identifier: Apache-2.0
"""The robot's own safety: which commands act on its drives, and for how long."""

import numpy as np
import pytest
from shared.drive_monitor import DriveMonitor
from small_scenes import DISC, layout_of, make_scene

from warpmpc import State
from warpmpc.loop.robots.safety import COMMANDS_TIMEOUT, TAKEOVER, Command, Safety

TICK = 0.002
GOOD = np.array([0.5, -0.2, 0.1])


class Pushes:
    """A safe command that is none."""

    def release(self) -> None:
        pass

    def __call__(self, *_) -> np.ndarray:
        return np.full(3, 0.2)


class Robot:
    """A robot whose commands are read from a list."""

    def __init__(self):
        scene = make_scene()
        self.safety, self.monitor = Safety(scene, layout_of(scene)), DriveMonitor(scene, layout_of(scene))
        self.state, self.now = State.start(layout_of(scene)), 3.0

    def hear(self, *controls, sender: str = "a", ahead: float = 0.0) -> np.ndarray:
        """A tick later, what the drives are given."""
        self.now += TICK
        commands = [Command(np.asarray(control, dtype=float), self.now + ahead, sender) for control in controls]
        self.monitor.hear(commands, self.now)
        self.safety.take(commands, self.now)
        state = State(self.state.joint_q, self.state.joint_qd, time=self.now)
        control = self.safety.command(state, self.now)
        self.monitor.check(control, state, self.now)
        return control

    def refused(self) -> dict[str, int]:
        return {kind.value: count for kind, count in self.safety.refused.items()}


@pytest.fixture
def robot():
    return Robot()


def test_good_commands_act_and_the_newest_of_a_tick_does(robot):
    np.testing.assert_allclose(robot.hear(GOOD), GOOD)
    np.testing.assert_allclose(robot.hear(GOOD, -GOOD), -GOOD)
    assert (robot.safety.received, robot.refused()) == (3, {})


@pytest.mark.parametrize(
    ("bad", "kind"),
    [
        (GOOD * np.nan, "nan"),
        (GOOD * np.inf, "nan"),
        (GOOD[:2], "size"),
        ([], "size"),
        (3.0 * np.ones(3), "limits"),
    ],
)
def test_bad_commands_are_refused_and_the_last_good_one_acts_until_it_is_old(robot, bad, kind):
    robot.hear(GOOD)
    begin = robot.now
    while robot.hear(bad).any():
        assert robot.now - begin <= COMMANDS_TIMEOUT
    assert robot.safety.safe_state == pytest.approx(robot.now - begin)
    assert robot.now - begin == pytest.approx(COMMANDS_TIMEOUT, abs=1.5 * TICK)
    assert robot.safety.safe_state <= COMMANDS_TIMEOUT
    assert list(robot.refused()) == [kind]
    np.testing.assert_allclose(robot.hear(GOOD), GOOD)
    assert robot.monitor.unsafe == 0


@pytest.mark.parametrize("ahead", [-2.0, -0.11, 0.11, 2.0, np.nan])
def test_commands_of_a_wrong_clock_are_refused(robot, ahead):
    assert not robot.hear(GOOD, ahead=ahead).any()
    assert sum(robot.refused().values()) == 1


def test_a_command_that_was_overtaken_is_refused_and_its_age_counts(robot):
    robot.hear(GOOD, ahead=-0.03)
    robot.hear(-GOOD, ahead=-0.05)
    assert robot.refused() == {"stale": 1}
    begin = robot.now - TICK
    while robot.hear().any():
        pass
    assert robot.now - begin <= COMMANDS_TIMEOUT - 0.03 + TICK


def test_a_second_sender_is_heard_only_long_after_the_first(robot):
    robot.hear(GOOD)
    begin = robot.now
    while not robot.hear(-GOOD, sender="b")[0] < 0.0:
        assert robot.now - begin < 2.0 * TAKEOVER
    assert robot.now - begin == pytest.approx(TAKEOVER, abs=1.5 * TICK)
    robot.hear(GOOD)
    assert robot.refused()["foreign"] > 400
    assert robot.monitor.unsafe == 0


def test_a_state_that_is_no_number_gives_the_drives_no_nan():
    scene = make_scene(robot=[DISC | {"drive": {"mode": "position", "stiffness": 9.0, "damping": 6.0, "limit": 1.0}}])
    layout = layout_of(scene)
    safety, state = Safety(scene, layout), State.start(layout)
    lost = State(state.joint_q * np.nan, state.joint_qd * np.nan, time=1.0)
    assert np.isfinite(safety.command(lost, 1.0)).all()


def test_what_a_wrong_safety_gives_the_drives_is_found(robot, monkeypatch):
    def count(**wrong) -> int:
        """Unsafe ticks of a run in which one part of the safety is wrong, after good commands of one sender."""
        robot.__init__()
        with monkeypatch.context() as patch:
            for name, value in wrong.items():
                patch.setattr(robot.safety, name, value)
            robot.hear(GOOD)
            for tick in range(100):
                robot.hear(GOOD if tick < 20 else -GOOD, sender="a" if tick < 20 else "b")
            robot.hear(GOOD * 0.5, ahead=2.0, sender="a")
            robot.hear(GOOD * np.nan)
        return robot.monitor.unsafe

    assert count() == 0
    assert count(_age=lambda *_: 0.0) > 20  # what is old acts on
    assert count(_refusal=lambda *_: None) > 20  # everybody commands
    assert count(command=lambda *_: np.full(3, np.nan)) == 103
    assert count(command=lambda *_: np.full(3, 1.5)) == 103
    assert count(_safe=Pushes()) > 10


def test_limits_are_kept_to_the_last_bit(robot):
    assert np.abs(robot.hear(np.full(3, 1.0005))).max() <= 1.0
    assert robot.refused() == {}


@pytest.mark.parametrize("times", [[0.0, 0.02, 0.01], [0.0, np.nan, 0.02], [-np.inf, 0.0, np.inf]])
def test_a_trajectory_whose_times_do_not_go_on_is_refused(robot, times):
    times, controls = robot.now + np.array(times), np.tile(GOOD, (3, 1))
    robot.safety.take([Command(GOOD, robot.now, "a", (times, controls))], robot.now)
    assert robot.refused()["times"] == 1
    assert not robot.safety.commanded
    np.testing.assert_allclose(robot.hear(GOOD), GOOD)
