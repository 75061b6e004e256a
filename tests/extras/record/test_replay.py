# SPDX-License-Identifier: Apache-2.0
"""Logged plans are planned again bit for bit; what was changed, or is not as it was, is found."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from needs import need_scene
from small_scenes import DISC, WALL, compiled, make_scene

import warpmpc
from warpmpc import shipped_scenes
from warpmpc.extras.record import replay as module
from warpmpc.scene.load import dump_scene, parse_scene

SCENE = make_scene(
    robot=[DISC],
    obstacle=[{**WALL, "movable": True}],
    cost=[
        {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
        {"term": "control_effort", "name": "thrift", "weight": 0.1},
    ],
    planner={"samples": 16, "horizon": 4},
    plant={"noise": {"position": 0.01}, "delay": 0.04},
)


def logged(scene, *, steps=8, change=lambda n, controller: None, **options) -> warpmpc.RunLog:
    """A run of a few steps; ``change`` is called before each plan."""
    options = {"engine": "mujoco", "device": "cpu", "seed": 5} | options
    controller = warpmpc.Controller(scene, compiled=compiled(scene), **options)
    plant = warpmpc.Plant(scene, seed=7, task=controller.task, compiled=compiled(scene))
    recorder = warpmpc.RunRecorder(plant, controller)
    for n in range(steps):
        change(n, controller)
        control = controller.step(plant.observe())
        plant.apply(control)
        recorder.log(control)
    return recorder.run_log


def steered(n, controller):
    """Somebody moves sliders, the goal, an obstacle and the limits."""
    if n == 3:
        controller.task["thrift"] = 0.7
        controller.task["goal"] = [0.2, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0]
    if n == 5:
        controller.task["wall"] = [0.5, 0.4, 0.2, 0.0, 0.0, 0.0, 1.0]
        controller.set_limits(np.full(3, -0.3), np.full(3, 0.4))


def test_the_same_commands_come_out_though_task_and_limits_were_changed():
    log = logged(SCENE, change=steered)
    found = module.replay(log)
    assert len(log.plans) == 8
    assert found.same
    assert found.commands.agree.tolist() == [True] * 8
    assert (found.first, found.plans, found.differences) == (None, None, ())
    assert np.abs(log.plans.command[6:]).max() <= 0.4  # the limits were in the log


@pytest.mark.parametrize("what", ["seed", "observation", "task", "limits"])
def test_what_the_plans_were_made_from_matters(what):
    log = logged(SCENE, change=steered)
    match what:
        case "seed":
            log.origin["seed"] += 1
        case "observation":
            log.plans.joint_q[2:] += 1e-3
        case "task":
            log.plans.task[:] = log.plans.task[0]
        case "limits":
            log.plans.lower[:], log.plans.upper[:] = log.plans.lower[0], log.plans.upper[0]
    found = module.replay(log)
    assert not found.same
    first = int(np.argmin(found.commands.agree))
    assert first == {"seed": 0, "observation": 2, "task": 3, "limits": 5}[what]
    assert found.first.startswith(f"command {first} at t = {log.plans.time[first]:.3f} s: base/")


def test_an_observation_that_is_not_finite_is_replayed_as_it_was():
    class Blind(warpmpc.Plant):
        def observe(self):
            state = super().observe()
            return replace(state, joint_q=state.joint_q * np.nan) if 2 < self.steps < 5 else state

    controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu")
    plant = Blind(SCENE, task=controller.task, compiled=compiled(SCENE))
    recorder = warpmpc.RunRecorder(plant, controller)
    for _ in range(8):
        control = controller.step(plant.observe())
        plant.apply(control)
        recorder.log(control)
    log = recorder.run_log
    assert np.isnan(log.plans.joint_q).any(axis=1).tolist() == [False] * 3 + [True] * 2 + [False] * 3
    assert (log.plans.command[3:5] == 0.0).all()
    assert module.replay(log).same


def test_files_keep_all_of_it(tmp_path):
    controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu")
    plant = warpmpc.Plant(SCENE, task=controller.task, compiled=compiled(SCENE))
    recorder = warpmpc.RunRecorder(plant, controller)
    plant.apply(controller.step(plant.observe()))
    recorder.log(np.zeros(3))  # something else was sent
    recorder.run_log.save(tmp_path / "run.npz")
    log = warpmpc.RunLog.load(tmp_path / "run.npz")
    assert (log.plans.command != 0.0).any()  # what the controller said
    assert log.origin == recorder.run_log.origin
    assert module.replay(log).same


def test_points_of_a_cloud_are_logged_when_they_are_new(tmp_path):
    scene = make_scene(
        cloud=[{"name": "seen", "voxel": 0.1, "low": (-1.0, -1.0, 0.0), "high": (2.0, 2.0, 1.0)}],
        planner={"samples": 8, "horizon": 3},
    )

    def look(n, controller):
        if n in (1, 4):
            controller.task["seen"] = np.full((5 + n, 3), 0.1 * n)

    log = logged(scene, steps=6, change=look)
    log.save(tmp_path / "run.npz")
    again = warpmpc.RunLog.load(tmp_path / "run.npz")
    seen = again.points()["seen"]
    assert {n: len(points) for n, points in seen.items() if len(points)} == {1: 6, 4: 9}
    np.testing.assert_array_equal(seen[4], np.full((9, 3), 0.4, np.float32))
    assert module.replay(again).same


def test_a_log_that_begins_later_is_refused():
    controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu")
    plant = warpmpc.Plant(SCENE, task=controller.task, compiled=compiled(SCENE))
    plant.apply(controller.step(plant.observe()))
    recorder = warpmpc.RunRecorder(plant, controller)
    plant.apply(controller.step(plant.observe()))
    recorder.log(controller.command)
    with pytest.raises(ValueError, match="does not begin with its controller's first plan"):
        module.replay(recorder.run_log)


def test_what_is_not_as_it_was_is_said():
    log = logged(SCENE, steps=1)
    about = copy.deepcopy(log.origin)
    assert list(module.differences(about)) == []
    about["versions"]["mujoco"], about["hardware"]["gpus"], about["code"] = "1.2.3", ["A GPU"], "0123"
    said = list(module.differences(about))
    assert [text.partition(":")[0] for text in said] == ["mujoco", "gpus", "source of warpmpc"]
    assert said[0].startswith("mujoco: 1.2.3, now ")
    assert said[1] == "gpus: A GPU, now none" or "now " in said[1]


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_scene_is_written_out_and_read_back(name):
    need_scene(name)
    scene = warpmpc.load_scene(name)
    assert parse_scene(dump_scene(scene), path=scene.path) == scene


def test_files_beside_a_scene_of_ones_own_are_found_from_anywhere(tmp_path):
    (tmp_path / "mine.urdf").write_text("<robot name='r'/>")
    scene = make_scene(robot=[{**DISC, "asset": "mine.urdf"}]).model_copy(update={"path": tmp_path / "a.toml"})
    assert parse_scene(dump_scene(scene)).robot[0].asset == str(tmp_path / "mine.urdf")
