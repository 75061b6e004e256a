# SPDX-License-Identifier: Apache-2.0
"""Failures: what ends a run without success, of simulated plants, batches and other robots."""

import numpy as np
import pytest
from small_scenes import BOX, compiled, make_scene

from warpmpc import Monitor, Plant, SceneError, State, Task

FAR = {"joint": "base/x", "above": 0.2}
LOST = {"name": "lost", "conditions": FAR}
AHEAD = np.array([1.0, 0.0, 0.0])


def plant_of(**sections) -> Plant:
    scene = make_scene(plant={"randomize": False}, **sections)
    return Plant(scene, compiled=compiled(scene))


def drive(plant: Plant, steps: int = 50, control=AHEAD) -> None:
    for _ in range(steps):
        if plant.done:
            return
        plant.apply(control)


def at(x: float, time: float) -> State:
    return State(np.array([x, 0.0, 0.0]), np.zeros(3), time)


def test_a_run_that_fails_is_over_at_once_says_why_and_begins_anew():
    plant = plant_of(failure=[LOST])
    drive(plant)
    assert plant.done
    assert (plant.success, plant.reason) == (False, "failed: lost")
    assert 0.2 <= plant.state.joint_q[0] < 0.2 + 0.04 * 1.1  # the control after which it holds is the last
    plant.reset()
    assert not plant.done
    assert plant.reason == "running"


def test_what_comes_after_a_failure_is_no_success():
    success = {"conditions": {"joint": "base/x", "above": 0.4}}
    scene = make_scene(goal=None, success=success, failure=[LOST], cost=[{"term": "control_effort"}])
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    found = [monitor.update(at(x, 0.1 * k)) for k, x in enumerate((0.0, 0.3, 0.5))]
    assert found == [False] * 3
    assert monitor.failure == "lost"
    monitor.reset()
    assert monitor.failure is None
    assert monitor.update(at(0.5, 0.0))  # success and failure at once are success
    assert monitor.failure is None


def test_all_conditions_must_hold_for_as_long_as_is_said():
    both = {"name": "both", "conditions": [FAR, {"joint": "base/x", "below": 0.3}], "hold": 0.2}
    scene = make_scene(failure=[both])
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    for k, (x, failed) in enumerate([(0.25, 0), (0.25, 0), (0.4, 0), (0.25, 0), (0.25, 0), (0.25, 1)]):
        monitor.update(at(x, 0.1 * k))
        assert (monitor.failure == "both") == bool(failed), k


def test_a_phase_may_take_too_long_and_have_failures_of_its_own():
    phases = [
        {"name": "go", "until": {"joint": "base/x", "above": 0.5}},
        {"name": "stay"},
    ]
    rows = [{"name": "slow", "phase": "go", "after": 0.5}, {"name": "left", "phase": "stay", "conditions": FAR}]
    scene = make_scene(phase=phases, failure=rows, goal={"frame": "base/centre", "position": (3.0, 3.0)})
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    start = 1.7e9  # as a robot's clock may say
    for time, x in ((0.0, 0.0), (0.1, 0.3), (0.4, 0.3), (0.45, 0.6)):
        monitor.update(at(x, start + time))
        assert monitor.failure is None
    assert [name for name, _ in monitor.phases] == ["stay"]
    monitor.update(at(0.1, start + 2.0))
    assert monitor.failure is None  # the first phase is over
    monitor.update(at(0.3, start + 2.1))
    assert monitor.failure == "left"
    monitor.reset()
    for time in (0.0, 0.4, 0.6):
        assert monitor.failure is None
        monitor.update(at(0.0, start + time))
    assert monitor.failure == "slow"


def test_each_of_several_goals_may_take_too_long_and_those_that_were_reached_are_counted():
    goals = [{"position": (x, 0.0)} for x in (0.5, 1.0, 1.5)]
    course = {"name": "course", "through": goals, "until": {"frame": "base/centre", "distance": 0.1}}
    scene = make_scene(phase=[course], failure=[{"name": "slow", "phase": "course", "after": 0.5}])
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    for time, x, reached in ((0.0, 0.0, 0), (0.4, 0.5, 1), (0.8, 1.0, 2), (1.2, 1.0, 2)):
        monitor.update(at(x, time))
        assert (monitor.reached, monitor.failure) == (reached, None)
    monitor.update(at(1.0, 1.3))  # the last one, too
    assert (monitor.reached, monitor.failure) == (2, "slow")
    monitor.reset()
    for time, x in ((0.0, 0.5), (0.1, 1.0), (0.2, 1.5)):
        monitor.update(at(x, time))
    assert (monitor.success, monitor.reached) == (True, 3)
    monitor.reset()
    assert monitor.reached == 0


def test_a_phase_that_ends_by_its_time_was_not_reached():
    scene = make_scene(phase=[{"name": "wait", "after": 0.2}, {"name": "go"}])
    monitor = Monitor(scene, task=Task(scene), compiled=compiled(scene))
    for time in (0.0, 0.1, 0.3):
        monitor.update(at(0.0, time))
    assert ([name for name, _ in monitor.phases], monitor.reached) == (["go"], 0)


def test_a_time_after_which_conditions_count_lets_a_run_begin_where_they_hold():
    row = {"name": "stuck", "conditions": {"joint": "base/x", "below": 0.1}, "after": 0.4}
    plant = plant_of(failure=[row])
    drive(plant, control=np.zeros(3))
    assert plant.reason == "failed: stuck"
    assert plant.time == pytest.approx(0.4)


def test_cost_terms_and_objects_are_looked_at_in_the_plant():
    sections = {
        "object": [{**BOX, "position": (3.0, 3.0, 0.6)}],
        "cost": [{"term": "control_effort", "name": "effort"}],
    }
    effort = plant_of(failure=[{"name": "hard", "conditions": {"term": "effort", "above": 0.5}}], **sections)
    drive(effort, control=np.zeros(3), steps=3)
    assert effort.reason == "running"
    drive(effort)
    assert effort.reason == "failed: hard"
    dropped = plant_of(failure=[{"name": "dropped", "conditions": {"frame": "box", "below": 0.3}}], **sections)
    drive(dropped, control=np.zeros(3))
    assert dropped.reason == "failed: dropped"
    assert 0.2 < dropped.time < 0.5


def test_a_plant_of_a_batch_that_fails_stays_where_it_is_and_the_others_go_on():
    scene = make_scene(plant={"randomize": False}, failure=[LOST])
    batch = Plant(scene, envs=2, compiled=compiled(scene))
    for _ in range(20):
        batch.apply(np.stack([AHEAD, np.zeros(3)]))
    assert batch.reasons == ("failed: lost", "running")
    assert batch.plants[0].state.joint_q[0] < 0.25


def test_failures_that_make_no_sense_are_refused_by_their_keys():
    with pytest.raises(ValueError, match="needs conditions, or a time"):
        make_scene(failure=[{"name": "nothing"}])
    with pytest.raises(ValueError, match="'late' is of no phase 'go': the scene has none"):
        make_scene(failure=[{"name": "late", "phase": "go", "after": 1.0}])
    scene = make_scene(failure=[{"name": "lost", "conditions": {"frame": "nobody", "below": 1.0}}])
    with pytest.raises(SceneError, match=r"failure\.lost\.conditions\.frame"):
        Monitor(scene, task=Task(scene), compiled=compiled(scene))
