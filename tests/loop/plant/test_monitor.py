# SPDX-License-Identifier: Apache-2.0
"""Phases and success from observed states: what a robot without a simulated plant goes by."""

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import BOX, chain_scene, compiled, make_scene

import warpmpc
from warpmpc import Monitor, Plant, SceneError, State, Task

COST = [
    {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
    {"term": "distance", "name": "near_box", "between": ["base/centre", "box"], "weight": 0.0},
    {"term": "control_effort", "name": "effort", "weight": 0.01},
]
PHASES = [
    {"name": "out", "goal": {"position": (0.4, 0.3)}, "until": {"frame": "base/centre", "distance": 0.1}, "hold": 0.08},
    {"name": "wait", "after": 0.2},
    {"name": "close", "goal": {"position": (0.5, 0.6)}, "until": {"term": "near_box", "below": 0.5}},
    {"name": "calm", "weight": {"effort": 5.0}, "until": {"term": "effort", "below": 0.05}},
    {"name": "back", "goal": {"position": (0.0, 0.0)}, "weight": {"effort": 0.01}},
]


def test_a_robot_goes_through_the_phases_as_its_simulation_would():
    """The robot is a plant that keeps its task to itself; its control knows of phases by the monitor's task alone."""
    scene = make_scene(
        timing={"control_dt": 0.04, "timeout": 12.0},
        object=[{**BOX, "position": (0.5, 1.0, 0.1)}],
        cost=COST,
        phase=PHASES,
        success={"distance": 0.1, "conditions": {"joint": "base/y", "below": 0.1}, "hold": 0.12},
    )
    task, robot, control = Task(scene), Plant(scene, compiled=compiled(scene)), None
    monitor = Monitor(scene, task=task, compiled=compiled(scene))
    while not monitor.update(robot.observe(), control):
        assert monitor.phases == robot.monitor.phases
        np.testing.assert_allclose(monitor.error.axes, robot.error.axes, atol=1e-6)
        np.testing.assert_array_equal(task["goal"], robot.task["goal"])
        assert not robot.done
        control = np.clip(4.0 * (task["goal"][:3] - robot.state.joint_q[:3]), -1.0, 1.0)
        robot.apply(control)
    assert robot.success
    assert [name for name, _ in monitor.phases] == ["wait", "close", "calm", "back"]
    monitor.reset()
    assert monitor.phases == []
    assert task.phase_of().name == "out"


def at(x: float, time: float | None, *, e: int | None = None) -> State:
    """The disc at a place, in one environment or in row ``e`` of two."""
    q, qd = np.array([x, 0.0, 0.0]), np.zeros(3)
    if e is None:
        return State(q, qd, time)
    rows = np.zeros((2, 3))
    rows[e] = q
    return State(rows, np.zeros((2, 3)), time)


def held(hold: float = 0.3, envs: int = 1):
    """A scene that wants the disc beyond x = 1 for a while, and its task."""
    scene = make_scene(goal=None, success={"conditions": {"joint": "x", "above": 1.0}, "hold": hold}, cost=COST[2:])
    return scene, Task(scene, envs=envs)


def test_what_has_to_last_lasts_by_the_clock_of_the_states():
    scene, task = held()
    monitor = Monitor(scene, task=task, compiled=compiled(scene))
    start = 1.7e9  # as a robot's clock may say
    seen = [(0.0, 2.0), (0.1, 2.0), (0.15, 0.0), (0.2, 2.0), (0.21, 2.0), (0.49, 2.0), (0.51, 2.0), (0.6, 0.5)]
    found = [monitor.update(at(x, start + t)) for t, x in seen]
    assert found == [False] * 6 + [True, False]


def test_states_without_a_time_are_one_control_apart():
    scene, task = held(hold=0.12)
    monitor = Monitor(scene, task=task, compiled=compiled(scene))
    assert [monitor.update(at(2.0, None)) for _ in range(5)] == [False, False, False, True, True]


def test_a_state_that_is_not_finite_holds_nothing():
    scene, task = held(hold=0.08)
    monitor = Monitor(scene, task=task, compiled=compiled(scene))
    x = [2.0, 2.0, np.nan, 2.0, 2.0, 2.0, np.nan]
    assert [monitor.update(at(x, 0.04 * i)) for i, x in enumerate(x)] == [False] * 5 + [True, False]


def test_each_of_two_bounds_of_one_number_keeps_its_own_best():
    scene = make_scene(goal=None, success={"conditions": {"joint": "x", "above": 1.0, "below": 2.0}}, cost=COST[2:])
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    for time, x in enumerate((3.0, 0.0, 2.5)):
        monitor.update(at(x, float(time)))
    above, below = monitor.progress
    assert (above.best.value, above.when, above.last.value) == (3.0, 0.0, 2.5)
    assert (below.best.value, below.when, below.last.value) == (0.0, 1.0, 2.5)


def test_a_phase_of_fixed_length_begins_with_the_first_state():
    scene = make_scene(phase=[{"name": "wait", "after": 0.1}, {"name": "go"}])
    task = Task(scene)
    monitor = Monitor(scene, task=task, compiled=compiled(scene))
    for time in (50.0, 50.09):
        monitor.update(at(0.0, time))
        assert task.phase_of().name == "wait"
    monitor.update(at(0.0, 50.11))
    assert task.phase_of().name == "go"
    assert monitor.phases == [("go", 50.11)]


@pytest.mark.parametrize("e", [0, 1])
def test_every_environment_has_a_monitor_of_its_own(e):
    phases = [{"name": "first", "until": {"joint": "x", "above": 1.0}}, {"name": "last"}]
    scene = make_scene(phase=phases)
    task = Task(scene, envs=2)
    monitors = [Monitor(scene, task=task, e=i, compiled=compiled(scene)) for i in range(2)]
    for monitor in monitors:
        monitor.update(at(2.0, 0.0, e=e))
    assert list(task.phase) == [int(i == e) for i in range(2)]


def test_bodies_follow_from_joints_of_every_kind(tmp_path):
    """The goal's error of a floating chain in motion is that of its simulation."""
    scene = chain_scene(tmp_path)
    plant = Plant(scene, compiled=compiled(scene))
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    for _ in range(5):
        plant.apply(np.full(plant.layout.nu, 0.5, np.float32))
        monitor.update(plant.state)
        np.testing.assert_allclose(monitor.error.axes, plant.error.axes, atol=1e-5)


def test_what_a_state_does_not_tell_is_refused_by_name():
    cost = [*COST[2:], {"term": "contact_force", "name": "touch", "between": ["base", "box"]}]
    success = {"conditions": {"term": "touch", "below": 1.0}}
    scene = make_scene(goal=None, object=[BOX], cost=cost, success=success)
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    with pytest.raises(SceneError, match="contact forces or sensors") as caught:
        monitor.update(replace(State.start(Plant(scene, compiled=compiled(scene)).layout), time=0.0))
    assert caught.value.found == ["touch"]


def test_the_monitor_is_public():
    assert warpmpc.Monitor is Monitor
