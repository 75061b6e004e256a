# SPDX-License-Identifier: Apache-2.0
"""A planner in a separate process: it steers, dies, and comes back."""

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import PlannerProcess, RobotLoop, SceneError, State, simulated_robot
from warpmpc.loop.realtime import process
from warpmpc.loop.realtime.messages import TimedObservation
from warpmpc.planner.controller.rollout_paths import FAN

SPEED = 0.2
"""The robot's seconds in a second: tests share their cores with others."""


def broken_terms():
    raise ValueError("there is nothing here")


def mortal_terms(folder: Path):
    """The first planner catches fire once it plans, the second does not start, the third lives."""
    lives = len(list(folder.glob("life_*")))
    (folder / f"life_{lives}").touch()
    if lives == 1:
        raise ValueError("there is no fuel")
    if lives == 0:
        threading.Thread(target=burn, args=[folder / "burn"], daemon=True).start()
    return ()


def burn(when: Path) -> None:
    while not when.exists():
        time.sleep(0.01)
    print("smoke", "the planner caught fire", sep="\n", file=sys.stderr, flush=True)
    os._exit(3)


def test_planners_that_die_are_replaced_for_good_and_the_log_says_why(tmp_path, caplog, capfd, monkeypatch):
    monkeypatch.setattr(process, "FIRST_BACKOFF", 0.5)
    timing = {"control_dt": 0.04, "timeout": 60.0}
    near = {"frame": "base/centre", "position": (0.3, 0.15)}  # the rest of the way is slow in wall time
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1}, timing=timing, goal=near)
    options = {"speed": SPEED, "engine": "mujoco", "device": "cpu", "terms": partial(mortal_terms, tmp_path)}
    with PlannerProcess(scene, **options) as planner:
        robot = simulated_robot(scene, task=planner.task, compiled=planner.compiled)
        loop = RobotLoop(scene, robot, planner, speed=SPEED, simulated=True)
        loop.run(lambda: loop.agent.following)
        capfd.readouterr()  # Warp may begin here
        (tmp_path / "burn").touch()
        deadline = time.monotonic() + 120.0
        loop.run(lambda: not loop.agent.following or time.monotonic() > deadline)
        number = planner.newest().number
        loop.run(lambda: loop.agent.following or time.monotonic() > deadline)
        assert planner.newest().number > number  # never taken for one of the planner before
        loop.run(lambda: robot.done)
        report = loop.report()
    assert robot.success
    assert 0.0 < report.latency_ms["p50"] < report.latency_ms["max"]
    died = [line for line in caplog.messages if "the planner's process died" in line]
    assert died == [
        "the planner's process died (exit code 3\n  smoke\n  the planner caught fire); starting another",
        "the planner's process died (it does not start: there is no fuel); starting another in 0.5 s",
    ]
    assert capfd.readouterr().err == ""


def slow_terms(folder: Path):
    """The first planner starts at once, the others take longer than a planner may be silent."""
    if (folder / "lived").exists():
        time.sleep(2.5)
    (folder / "lived").touch()
    return ()


def test_a_planner_that_hangs_is_replaced_and_a_slow_start_is_not_taken_for_it(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(process, "HEARTBEAT_TIMEOUT", 1.0)
    scene = make_scene(
        plant={"randomize": False},
        engine={"threads": 1},
        goal={"frame": "base/centre", "position": (50.0, 0.0)},
        timing={"control_dt": 0.04, "timeout": 60.0},
    )
    options = {"speed": SPEED, "engine": "mujoco", "device": "cpu", "terms": partial(slow_terms, tmp_path)}
    with PlannerProcess(scene, **options) as planner:
        robot = simulated_robot(scene, task=planner.task, compiled=planner.compiled)
        loop = RobotLoop(scene, robot, planner, speed=SPEED, simulated=True)

        def moves() -> bool:
            return loop.agent.following and robot.state.joint_qd[0] > 0.5

        loop.run(moves)
        hung, deadline = planner.pid, time.monotonic() + 60.0
        os.kill(hung, signal.SIGSTOP)
        loop.run(lambda: not loop.agent.following)
        loop.run(lambda: moves() or time.monotonic() > deadline)
        assert time.monotonic() < deadline, "nobody replaced it"
        assert planner.pid != hung
        with pytest.raises(ProcessLookupError):
            os.kill(hung, 0)
    said = [line.partition(" (")[0] for line in caplog.messages if "the planner's process" in line]
    assert said == ["the planner's process hung: no heartbeat for 1.45 s"]


def test_a_planner_that_is_started_again_and_hangs_before_its_first_plan_is_killed():
    planner, killed = PlannerProcess(make_scene()), []
    planner._process = type("Hung", (), {"kill": lambda self: killed.append(1)})()
    planner._ready, _theirs = planner._context.Pipe(duplex=False)
    planner._longest_start = 0.05
    assert planner._await_start() == "it does not start: no plan after 0.05 s"
    assert killed


def test_what_the_task_wants_reaches_the_planner():
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as planner:
        robot = simulated_robot(scene, task=planner.task, compiled=planner.compiled)
        planner.task["goal"] = [-0.2, -0.1, 0.0, 0.0, 0.0, 0.0, 1.0]
        RobotLoop(scene, robot, planner, speed=SPEED, simulated=True).run(lambda: robot.done)
        assert robot.success
        np.testing.assert_allclose(robot.state.joint_q[:2], [-0.2, -0.1], atol=0.11)


def test_what_keeps_the_planner_from_starting_is_raised_here():
    scene = make_scene(engine={"threads": 1})
    with pytest.raises(ValueError, match="there is nothing here"), PlannerProcess(scene, terms=broken_terms):
        pass
    wrong = make_scene(cost=[{"term": "distance", "between": ["base/elbow", "goal"]}])
    with pytest.raises(SceneError, match="elbow"), PlannerProcess(wrong, engine="mujoco"):
        pass


def test_a_planner_is_less_urgent_than_a_loop_of_real_time_priority():
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(10))
    except PermissionError:
        pytest.skip("needs the right to set a real-time priority")
    try:
        process._give_way()
        found = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    assert found == (os.SCHED_RR, 9)


def test_paths_of_rollouts_are_recorded_when_they_are_asked_for():
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as planner:
        start = State.start(planner.layout)
        moved = replace(start, joint_q=start.joint_q + np.float32([0.3, -0.2, 0.0]), time=1.0)

        def plan(number):
            """Observe until so many plans were made since."""
            before = planner.newest().number if planner.newest() else -1
            deadline = time.monotonic() + 60.0
            while (planner.newest().number if planner.newest() else -1) < before + number:
                assert time.monotonic() < deadline
                planner.observe(TimedObservation(moved, np.zeros(3, dtype=np.float32), True))
                time.sleep(0.01)

        plan(3)
        assert planner.paths() is None, "nobody had asked"
        plan(3)
        paths = planner.paths()
        plan(3)
        assert planner.paths() is not None
    assert paths.best.shape[1:] == (scene.planner.horizon + 1, 3)
    assert paths.others.shape[1:] == paths.best.shape
    assert paths.colors.shape == (len(paths.others), 3)
    assert len(paths.others) == min(FAN, scene.planner.samples)
    np.testing.assert_allclose(paths.best[0, 0, :2], moved.joint_q[:2], atol=0.05)
    goal = np.array(scene.goal.position[:2])
    ends = np.linalg.norm(paths.others[:, 0, -1, :2] - goal, axis=-1)
    assert np.linalg.norm(paths.best[0, -1, :2] - goal) <= np.median(ends)
