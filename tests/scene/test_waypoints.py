# SPDX-License-Identifier: Apache-2.0
"""Phases whose goal goes through several poses, and goals whose orientation episodes draw."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from small_scenes import make_scene

from warpmpc import SceneError, Task
from warpmpc.loop.run.batch import Batch
from warpmpc.scene.draw import draw_task
from warpmpc.scene.schema_goal import is_of, runs_of

NEAR = {"frame": "base/centre", "distance": 0.15}
COURSE = {
    "name": "course",
    "through": [{"position": (x, 0.5 * x)} for x in (1.0, 2.0, 3.0)],
    "until": NEAR,
    "hold": 0.2,
}


def test_waypoints_are_phases_one_after_the_other():
    scene = make_scene(phase=[COURSE, {"name": "home", "goal": {"position": (0.0, 0.0)}}])
    assert [phase.name for phase in scene.phase] == ["course_1", "course_2", "course_3", "home"]
    assert all(phase.until and phase.hold == 0.2 for phase in scene.phase[:3])
    task = Task(scene)
    for i, goal in enumerate([(1.0, 0.5), (2.0, 1.0), (3.0, 1.5), (0.0, 0.0)]):
        task.enter_phase(i)
        np.testing.assert_allclose(task["goal"][:2], goal)


def test_the_last_waypoint_of_all_is_the_runs_goal():
    phases = make_scene(phase=[COURSE]).phase
    assert [bool(phase.until) for phase in phases] == [True, True, False]
    assert phases[-1].hold == 0.0


def turning(count: int = 4, **keys):
    turn = {"name": "turn", "goal": {"position": (0.1, 0.2, 0.3)}, "count": count, "draw_rotation": True, **keys}
    return make_scene(phase=[{**turn, "until": {"frame": "base/centre", "rotation": 0.4}}])


def test_goals_are_turned_anew_for_every_one_and_by_the_seed():
    scene = turning(200)
    drawn = [draw_task(scene, seed)[0] for seed in (3, 3, 4)]
    first, again, other = (np.array([phase.goal.rotation for phase in s.phase]) for s in drawn)
    np.testing.assert_array_equal(first, again)
    assert len({tuple(q) for q in np.concatenate([first, other])}) == 400
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0)
    # all orientations alike: every axis goes anywhere
    assert np.abs(Rotation.from_quat(first).as_matrix().mean(axis=0)).max() < 0.2
    task = Task(drawn[0])
    task.enter_phase(7)
    np.testing.assert_allclose(task["goal"], [0.1, 0.2, 0.3, *first[7]], atol=1e-6)


def test_what_else_an_episode_draws_stays_as_it_was():
    draw = {"draw": {"goal.position": {"low": (0.0, 0.0), "high": (1.0, 1.0)}}}
    plain = draw_task(make_scene(randomize_task=draw), 5)[0]
    turned = draw_task(
        turning().model_copy(update={"randomize_task": make_scene(randomize_task=draw).randomize_task}), 5
    )
    assert turned[0].goal.position == plain.goal.position


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"goal": {"position": (0.0, 0.0)}, "through": [{"position": (0.0, 0.0)}]}, "a goal, with a count or without"),
        ({"through": [{"position": (0.0, 0.0)}], "count": 2}, "a goal, with a count or without"),
        ({"count": 2}, "give goal or through"),
        ({"draw_rotation": True}, "give goal or through"),
        ({"goal": {"yaw": 1.0}, "draw_rotation": True}, "takes the place of yaw"),
    ],
)
def test_a_phase_has_one_kind_of_goal(keys, message):
    with pytest.raises(ValidationError, match=message):
        make_scene(phase=[{"name": "odd", **keys}])


def test_drawn_orientations_are_no_batch():
    with pytest.raises(SceneError, match=r"phase\.turn_1\.goal\.rotation.*without --envs"):
        Batch(turning(), [0, 1], envs=2)


def test_goals_of_a_phase_are_of_its_name():
    assert all(is_of(name, "turn") for name in ("turn", "turn_1", "turn_50"))
    assert not any(is_of(name, "turn") for name in ("turn_around", "return_1", "turn_", "turn_1_2"))


def test_goals_that_follow_one_another_are_told_in_one():
    names = [
        phase.name for phase in make_scene(phase=[COURSE, {"name": "home", "goal": {"position": (0.0, 0.0)}}]).phase
    ]
    assert runs_of(names) == [("course_1", "course_3"), ("home", "home")]
    assert runs_of(["a_1", "a_3", "b"]) == [("a_1", "a_1"), ("a_3", "a_3"), ("b", "b")]
