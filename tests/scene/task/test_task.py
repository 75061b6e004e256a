# SPDX-License-Identifier: Apache-2.0
"""The task: what may change between plans, who sees it, and phases that follow one another."""

import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, layout_of, make_scene

from warpmpc import Controller, Plant, SceneError, State, Task
from warpmpc.scene.check import check_scene

COST = [
    {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
    {"term": "control_effort", "name": "effort", "weight": 0.5},
]
SECTIONS = {
    "target": [{"name": "gate", "position": (0.5, -0.5, 0.2), "yaw": np.pi / 2}],
    "scalar": {"speed": 0.7, "height": 1.5},
    "cost": COST,
}
POSE = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 2.0])


def make_task(envs: int = 1, **sections) -> Task:
    return Task(make_scene(**{**SECTIONS, **sections}), envs=envs)


def test_a_task_begins_with_what_the_scene_says():
    task = make_task()
    assert list(task) == ["goal", "gate", "speed", "height", "distance", "effort"]
    assert len(task) == 6
    np.testing.assert_allclose(task["goal"], [1.0, 0.5, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(task["gate"], [0.5, -0.5, 0.2, 0, 0, 0.5**0.5, 0.5**0.5], atol=1e-6)
    assert task["speed"] == pytest.approx(0.7)
    assert task["distance"] == 2.0
    assert task.phase_of() is None


def test_what_is_set_is_what_is_got_and_reset_takes_it_back():
    task = make_task()
    before = dict(task.items())
    task["goal"], task["speed"], task["effort"] = POSE, -1.0, 0.0
    np.testing.assert_allclose(task["goal"], [1.0, 2.0, 3.0, 0, 0, 0, 1])  # a unit quaternion
    assert (task["speed"], task["effort"]) == (-1.0, 0.0)
    assert task["height"] == 1.5
    task["goal"][:] = 9.0  # a copy
    assert task["goal"][0] == 1.0
    task.reset()
    for name, value in before.items():
        np.testing.assert_array_equal(task[name], value)


def test_environments_take_values_of_their_own_or_one_for_all():
    task = make_task(3)
    assert task["goal"].shape == (3, 7)
    task["goal"] = POSE
    np.testing.assert_allclose(task["goal"][:, :3], np.tile([1.0, 2.0, 3.0], (3, 1)))
    task["speed"] = [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(task["speed"], [1.0, 2.0, 3.0])
    task["goal"] = np.tile(POSE, (3, 1)) * [[1.0], [2.0], [3.0]]
    np.testing.assert_allclose(task.pose("goal", 2)[:3], [3.0, 6.0, 9.0])
    task["effort"] = 4.0
    np.testing.assert_array_equal(task["effort"], [4.0, 4.0, 4.0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("goal", np.zeros(7)),
        ("goal", np.ones(6)),
        ("goal", np.full(7, np.inf)),
        ("gate", np.ones((2, 7))),
        ("speed", np.nan),
        ("speed", [1.0, 2.0]),
        ("effort", np.inf),
        ("effort", -1.0),
    ],
)
def test_values_that_make_no_sense_are_refused_and_change_nothing(name, value):
    task = make_task()
    before = task.block.copy()
    with pytest.raises(ValueError, match=f"'{name}' is a"):
        task[name] = value
    np.testing.assert_array_equal(task.block, before)


def test_names_that_are_not_there_are_told_with_those_that_are():
    task = make_task()
    with pytest.raises(KeyError, match=r"no such value; found 'sped'; .*Did you mean 'speed'"):
        task["sped"] = 1.0
    with pytest.raises(KeyError, match="gaol"):
        task["gaol"]
    assert "speed" in task
    assert "sped" not in task


@pytest.mark.parametrize(
    ("look", "there"),
    [
        (lambda plant: plant.pose("red"), "base/tip, .*box, gate, goal, wall"),
        (lambda plant: plant.move_mocap("red", POSE), "nothing, there is none"),
        (lambda plant: plant.perturbation.grab("red", np.zeros(3)), "base/base_link, .*box"),
        (lambda plant: plant.layout.entity("red"), "base, box, ground, wall"),
        (lambda plant: plant.layout.group("red"), "base, box, ground, objects, obstacles, robots, wall"),
        (lambda plant: plant.layout.frame("red"), "base/tip, .*box, gate, goal, wall"),
        (lambda plant: plant.layout.joint("red"), "base/x"),
        (lambda plant: plant.layout.sensor("red"), "nothing, there is none"),
        (lambda plant: plant.task["red"], "distance, effort, gate, goal, height, speed, view"),
        (lambda plant: plant.task.pose("red"), "gate, goal"),
        (lambda plant: plant.task.pose("speed"), "gate, goal"),
        (lambda plant: plant.task.move("red", np.zeros(3)), "gate, goal"),
        (lambda plant: plant.task.points("red"), "view"),
        (lambda plant: plant.task.see("red", np.zeros((1, 3))), "view"),
    ],
)
def test_an_unknown_name_is_one_error_that_lists_the_names_there_are(plant, look, there):
    with pytest.raises(SceneError, match=rf"no such .*; found '(red|speed)'; allowed: .*{there}") as caught:
        look(plant)
    assert isinstance(caught.value, KeyError)


@pytest.fixture(scope="module")
def plant() -> Plant:
    scene = make_scene(
        **SECTIONS, object=[BOX], obstacle=[WALL], cloud=[{"name": "view", "low": (0, 0, 0), "high": (1, 1, 1)}]
    )
    return Plant(scene, compiled=compiled(scene))


def test_a_plant_has_the_pose_of_every_frame(plant):
    np.testing.assert_allclose(plant.pose("gate"), plant.task["gate"])
    np.testing.assert_allclose(plant.pose("wall"), [*WALL["position"], 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(plant.pose("box"), [*BOX["position"], 0, 0, 0, 1], atol=1e-6)
    x, y, yaw = plant.state.joint_q[:3]
    np.testing.assert_allclose(plant.pose("base/tip")[:2], [x + 0.2 * np.cos(yaw), y + 0.2 * np.sin(yaw)], atol=1e-5)


def test_listeners_hear_what_changed():
    task, heard = make_task(), []
    task.on_change(heard.append)
    task["speed"] = 2.0
    task["goal"] = POSE
    task.reset()
    assert heard[:2] == [{"speed"}, {"goal"}]
    assert heard[2] == set(task)


def test_take_makes_each_task_the_start_of_an_environment():
    one, two = make_task(), make_task()
    one["goal"], two["speed"] = POSE, 9.0
    both = make_task(2)
    both["effort"] = 7.0
    both.take([one, two])
    np.testing.assert_array_equal(both["goal"], [one["goal"], two["goal"]])
    np.testing.assert_array_equal(both["speed"], [one["speed"], 9.0])
    np.testing.assert_array_equal(both["effort"], [0.5, 0.5])
    both["speed"] = 0.0
    both.reset()
    np.testing.assert_array_equal(both["speed"], [one["speed"], 9.0])


def test_weights_and_targets_change_the_next_plan_without_a_new_controller():
    scene = make_scene(**{**SECTIONS, "planner": {"samples": 16, "horizon": 4}})
    controller = Controller(scene, compiled=compiled(scene))
    state = State.start(controller.layout)
    controller.step(state)
    terms = controller.info.terms
    assert terms["distance"] > 0.0
    controller.task["distance"] = 0.0
    controller.step(state)
    assert controller.info.terms["distance"] == 0.0
    controller.task["distance"] = 4.0
    controller.reset()
    controller.step(state)
    assert controller.info.terms["distance"] == pytest.approx(2.0 * terms["distance"], rel=0.05)


def test_success_is_judged_by_the_goal_that_was_moved():
    """The controller, its plant and its success test share one task."""
    planner = {"samples": 48, "horizon": 8, "temperature": {"initial": 0.1}}
    scene = make_scene(planner=planner, timing={"control_dt": 0.04, "timeout": 3.0})
    controller = Controller(scene, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene), task=controller.task)
    for _ in range(5):
        plant.apply(controller.step(plant.observe()))
    controller.task["goal"] = np.array([-0.6, -0.3, 0.0, 0, 0, 0, 1])
    np.testing.assert_allclose(plant.goal[:2], [-0.6, -0.3])
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
    assert np.hypot(*(plant.state.joint_q[:2] - [-0.6, -0.3])) <= 0.1
    assert plant.error.position <= 0.1


@pytest.mark.parametrize("envs", [1, 3])
def test_a_task_of_another_number_of_environments_is_refused(envs):
    scene = make_scene()
    with pytest.raises(ValueError, match="2 environments"):
        Controller(scene, envs=envs, task=Task(scene, envs=2), compiled=compiled(scene))


# phases

PHASES = [
    {
        "name": "out",
        "goal": {"position": (0.5, 0.0)},
        "weight": {"effort": 0.0},
        "until": {"frame": "base/centre", "distance": 0.1},
    },
    {"name": "wait", "target": {"gate": {"position": (2.0, 0.0, 0.1)}}, "scalar": {"speed": 0.1}, "after": 0.2},
    {"name": "back", "goal": {"position": (0.0, 0.0)}, "weight": {"distance": 5.0}},
]


def test_a_phase_changes_what_it_names_and_the_rest_stays():
    task = make_task(2, phase=PHASES)
    assert [task.phase_of(e).name for e in range(2)] == ["out", "out"]
    np.testing.assert_allclose(task["goal"][:, 0], 0.5)
    np.testing.assert_array_equal(task["effort"], 0.0)
    heard = []
    task.on_change(heard.append)
    task.enter_phase(1, 1)
    assert task.phase_of(1).name == "wait"
    assert heard == [{"gate", "speed"}]
    np.testing.assert_allclose(task["gate"][:, 0], [0.5, 2.0])
    np.testing.assert_allclose(task["speed"], [0.7, 0.1])
    np.testing.assert_allclose(task["goal"][:, 0], 0.5)
    np.testing.assert_array_equal(task["effort"], 0.0)  # as the phase before left it
    task.enter_phase(2, 1)
    np.testing.assert_array_equal(task["distance"], [2.0, 5.0])
    task.reset()
    assert list(task.phase) == [0, 0]
    np.testing.assert_allclose(task["speed"], 0.7)
    with pytest.raises(IndexError, match="3 phases"):
        task.enter_phase(3)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"scalar": {"sped": 1.0}}, r"phase\.first\.scalar\.sped.*no such scalar.*Did you mean 'speed'"),
        ({"target": {"gat": {"position": (0.0, 0.0, 0.0)}}}, r"phase\.first\.target\.gat.*no such target"),
        ({"weight": {"efort": 1.0}}, r"phase\.first\.weight\.efort.*no such cost term"),
        ({"after": None}, r"phase\.first.*never ends: give until or after"),
        ({"name": "last"}, r"phase\.last\.name.*taken by an earlier phase"),
    ],
)
def test_phases_that_cannot_be_are_refused_by_name(entry, message):
    scene = make_scene(**SECTIONS, phase=[{"name": "first", "after": 1.0, **entry}, {"name": "last"}])
    with pytest.raises(SceneError, match=f"(?s){message}"):
        check_scene(scene)


def test_phases_follow_one_another_in_closed_loop():
    planner = {"samples": 48, "horizon": 8, "temperature": {"initial": 0.1}}
    scene = make_scene(**{**SECTIONS, "phase": PHASES, "planner": planner, "success": {"distance": 0.1, "hold": 0.08}})
    controller = Controller(scene, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene), task=controller.task)
    seen = []
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
        seen.append((plant.time, controller.task.phase_of().name, float(plant.state.joint_q[0])))
    assert plant.reason == "goal reached"
    (wait, at), (back, later) = plant.monitor.phases
    assert (wait, back) == ("wait", "back")
    assert later - at == pytest.approx(0.2)
    reached = next(x for time, _, x in seen if time == pytest.approx(at))
    assert abs(reached - 0.5) <= 0.11
    assert abs(seen[-1][2]) <= 0.1
    assert controller.task["distance"] == 5.0
    plant.reset()
    assert plant.monitor.phases == []


@pytest.mark.parametrize("hold", [0.0, 0.12])
def test_a_phase_ends_when_its_conditions_have_held_long_enough(hold):
    phases = [{"name": "far", "until": {"joint": "base/x", "above": 0.3}, "hold": hold}, {"name": "end"}]
    scene = make_scene(phase=phases)
    plant = Plant(scene, compiled=compiled(scene))
    push, first = np.array([1.0, 0.0, 0.0], np.float32), None
    while not plant.monitor.phases:
        plant.apply(push)
        if first is None and plant.state.joint_q[0] >= 0.3:
            first = plant.time
        assert plant.time < 2.0
    assert plant.monitor.phases == [("end", pytest.approx(first + hold))]


# conditions


def looked(success: dict, control, *, steps: int = 1, **sections) -> Plant:
    """A plant after some controls, whose success is what it is."""
    scene = make_scene(**{"goal": None, "success": success, **sections})
    plant = Plant(scene, compiled=compiled(scene))
    for _ in range(steps):
        plant.apply(np.array(control, np.float32))
    return plant


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ({"joint": "base/x", "above": 0.1}, True),
        ({"joint": "x", "above": 0.1, "below": 0.2}, False),
        ({"joint": "base/y", "below": 0.01}, True),
        ({"frame": "box", "above": 0.05}, True),
        ({"frame": "box", "above": 0.15}, False),
        ({"frame": "box", "below": 0.15, "above": 0.05}, True),
        ({"frame": "base/centre", "to": "box", "distance": 1.0}, True),
        ({"frame": "base/centre", "to": "box", "distance": 0.2}, False),
        ({"frame": "base/centre", "to": "gate", "distance": 0.9}, True),
        ({"frame": "box", "to": "gate", "yaw": 0.1}, False),
        ({"frame": "box", "to": "gate", "yaw": 1.7, "rotation": 1.7}, True),
        ({"frame": "box", "to": "gate", "distance": 9.0, "rotation": 1.0}, False),
        ({"term": "effort", "above": 1e-6}, True),
        ({"term": "effort", "below": 1e-6}, False),
        ({"term": "height", "below": 0.11}, True),
    ],
)
def test_conditions_look_at_frames_joints_and_terms(condition, holds):
    sections = {
        "object": [{**BOX, "position": (1.0, 0.6, 0.1)}],
        "target": SECTIONS["target"],
        "cost": [
            {"term": "control_effort", "name": "effort", "weight": 0.0},
            {"term": "height", "of": "box", "target": 0.0, "weight": 9.0},  # conditions see values without weights
        ],
    }
    plant = looked({"conditions": condition}, [1.0, 0.0, 0.0], steps=8, **sections)
    assert plant.state.joint_q[0] > 0.2
    assert plant.success is holds
    assert plant.error is None


def test_all_conditions_must_hold_for_as_long_as_the_test_says():
    success = {"conditions": [{"joint": "x", "above": 0.1}, {"joint": "y", "above": 0.1}], "hold": 0.08}
    assert not looked(success, [1.0, 0.0, 0.0], steps=8).success
    plant = looked(success, [1.0, 1.0, 0.0], steps=0)
    since = None
    while not plant.done:
        plant.apply(np.array([1.0, 1.0, 0.0], np.float32))
        if since is None and (plant.state.joint_q[:2] >= 0.1).all():
            since = plant.time
    assert plant.time == pytest.approx(since + 0.08)


JOINT = {"goal": None, "success": {"conditions": {"joint": "base/yaw", "above": 0.5}, "hold": 0.08}}
TERM = {"goal": None, "success": {"conditions": {"term": "near", "below": 0.15}}}


@pytest.mark.parametrize(
    "sections",
    [
        {**JOINT, "cost": [{"term": "yaw", "of": "base/centre", "to": "turned"}]},
        {**TERM, "cost": [{"term": "distance", "name": "near", "weight": 0.3, "between": ["base/centre", "turned"]}]},
    ],
    ids=["joint", "term"],
)
def test_a_scene_without_a_goal_is_run_until_its_conditions_hold(sections):
    target = [{"name": "turned", "position": (0.6, -0.4, 0.0), "yaw": 1.0}]
    planner = {"samples": 48, "horizon": 8, "temperature": {"initial": 0.05}, "noise": {"sigma": (0.6,)}}
    scene = make_scene(**sections, target=target, planner=planner)
    controller = Controller(scene, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene), task=controller.task)
    assert plant.error is None
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
    assert 0.1 < plant.time < 3.0
    if "term" in sections["success"]["conditions"]:
        assert np.hypot(*(plant.state.joint_q[:2] - [0.6, -0.4])) <= 0.16
    else:
        assert plant.state.joint_q[2] > 0.5


@pytest.mark.parametrize(
    ("condition", "key", "says"),
    [
        ({"frame": "base/center", "to": "gate", "distance": 1.0}, ".frame", "Did you mean 'base/centre'"),
        ({"frame": "base/centre", "to": "gait", "distance": 1.0}, ".to", "Did you mean 'gate'"),
        ({"frame": "base/centre", "distance": 1.0}, ".to", "goal"),
        ({"joint": "base/xx", "above": 1.0}, ".joint", "base/x"),
        ({"term": "efort", "above": 1.0}, ".term", "Did you mean 'effort'"),
    ],
)
@pytest.mark.parametrize("place", ["success", "phase"])
def test_names_that_are_not_there_are_scene_errors_with_their_key(condition, key, says, place):
    sections = {**SECTIONS, "goal": None, "cost": COST[1:]}
    if place == "success":
        scene, at = make_scene(**sections, success={"conditions": condition}), "success.conditions"
    else:
        phases = [{"name": "first", "until": condition}, {"name": "last"}]
        scene = make_scene(**sections, phase=phases, success={"conditions": {"joint": "x", "above": 9.0}})
        at = "phase.first.until"
    with pytest.raises(SceneError, match=says) as caught:
        Plant(scene, compiled=compiled(scene))
    assert caught.value.key == at + key


def test_a_condition_of_a_list_is_told_by_its_number():
    success = {"conditions": [{"joint": "x", "above": 1.0}, {"joint": "z", "above": 1.0}]}
    scene = make_scene(success=success, goal=None, cost=COST[1:])
    with pytest.raises(SceneError) as caught:
        Plant(scene, compiled=compiled(scene))
    assert caught.value.key == "success.conditions.1.joint"


@pytest.mark.parametrize(
    "condition",
    [{"joint": "x"}, {"above": 1.0}, {"joint": "x", "term": "effort", "above": 1.0}, {"joint": "x", "distance": 1.0}],
)
def test_a_condition_is_about_one_thing_and_has_a_bound(condition):
    with pytest.raises(ValueError, match="condition"):
        make_scene(success={"conditions": condition})


def test_targets_are_frames_and_the_goal_is_one_only_where_there_is_one():
    with_goal, without = layout_of(make_scene(**SECTIONS)), layout_of(make_scene(**{**SECTIONS, "goal": None}))
    assert {"goal", "gate"} <= set(with_goal.frame_name)
    assert "gate" in without.frame_name
    assert "goal" not in without.frame_name
