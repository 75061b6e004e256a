# SPDX-License-Identifier: Apache-2.0
"""What moves by itself: where it is, where it is seen, and that plant, task and success agree on which is which."""

import numpy as np
import pytest
from small_scenes import WALL, make_scene

from warpmpc import Controller, Plant, SceneError, load_scene
from warpmpc.loop.plant.motion import Motions
from warpmpc.scene.check import check_scene
from warpmpc.scene.overrides import with_values

SQUARE = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)]
ROUND = {"name": "goal", "through": SQUARE, "period": 4.0}
GATE = {**WALL, "name": "gate", "position": (3.0, 0.0, 0.2), "movable": True}
STILL = np.zeros(3)


def moving(*motions, **sections):
    return make_scene(motion=motions, plant={"randomize": False}, **sections)


def test_a_round_passes_its_points_and_begins_again():
    motions = Motions(moving(ROUND), seed=0)
    for time, point in ((0.0, 0), (1.0, 1), (3.0, 3), (4.0, 0), (9.0, 1)):
        np.testing.assert_allclose(motions.at(time)["goal"], SQUARE[point], atol=1e-9)


def test_a_way_with_an_end_waits_before_and_stays_after_without_overshooting():
    way = {"name": "goal", "through": [SQUARE[0], SQUARE[0], SQUARE[1]], "times": [0.0, 1.0, 2.0], "start": 0.5}
    x = [Motions(moving(way), seed=0).at(t)["goal"][0] for t in np.arange(0.0, 4.0, 0.05)]
    assert max(x[:31]) == 0.0
    assert x[-1] == 1.0
    assert (np.diff(x) >= 0.0).all()
    assert max(x) <= 1.0


def test_observations_come_at_their_rate_with_their_noise():
    seen = {"rate": 10.0, "noise": 0.05}
    motions, again = (Motions(moving({**ROUND, "seen": seen}), seed=3) for _ in range(2))
    times = np.arange(0.0, 400.0, 0.04)
    rows = np.array([motions.seen(t)["goal"] for t in times])
    changes = 1 + np.count_nonzero(np.any(np.diff(rows, axis=0) != 0.0, axis=1))
    assert changes == pytest.approx(10 * times[-1], rel=0.001)
    miss = rows - np.array([motions.at(int((t + 1e-6) * 10.0) / 10.0)["goal"] for t in times])
    assert np.std(miss) == pytest.approx(0.05, rel=0.05)
    again.seen(0.0)
    again.reset()
    np.testing.assert_array_equal([again.seen(t)["goal"] for t in times[:50]], rows[:50])


def test_lead_shows_where_it_will_be():
    line = {"name": "goal", "through": [(0.0, 0.0, 0.0), (10.0, 5.0, 0.0)], "times": [0.0, 10.0]}
    noisy = {"rate": 30.0, "noise": 0.005}
    errors = {}
    for lead in (0.0, 0.2):
        motions = Motions(moving({**line, "seen": {**noisy, "lead": lead}}), seed=1)
        times = np.arange(0.0, 8.0, 0.02)
        rows = np.array([motions.seen(t)["goal"] for t in times])
        later = np.array([motions.at(t + 0.2)["goal"] for t in times])
        errors[lead] = np.median(np.linalg.norm(rows - later, axis=1)[50:])
    assert errors[0.2] < 0.02 < 0.1 < errors[0.0]


def test_the_planner_sees_what_was_observed_and_errors_are_about_the_truth():
    scene = moving({**ROUND, "seen": {"rate": 5.0, "noise": 0.02}})
    mpc = Controller(scene, seed=0)
    plant = Plant(scene, seed=1, task=mpc.task)
    for _ in range(24):
        plant.apply(STILL)
    plant.observe()
    np.testing.assert_allclose(plant.goal[:3], Motions(scene, 1).at(plant.time)["goal"], atol=1e-6)
    miss = np.linalg.norm(mpc.task["goal"][:2] - plant.goal[:2])
    assert 0.01 < miss < 0.4  # up to 0.2 s late at 1 m/s and more, besides the noise
    assert plant.error.position == pytest.approx(np.linalg.norm(plant.state.joint_q[:2] - plant.goal[:2]), abs=1e-5)


def test_an_obstacle_on_its_way_blocks_the_plants_way_and_is_the_tasks():
    way = {"name": "gate", "through": [(3.0, 0.0, 0.2), (0.6, 0.0, 0.2)], "times": [0.0, 0.2]}
    plant = Plant(moving(way, obstacle=[GATE]))
    for _ in range(25):
        plant.apply(np.array([1.0, 0.0, 0.0]))
    plant.observe()
    assert plant.task["gate"][0] == pytest.approx(0.6)
    assert plant.state.joint_q[0] < 0.35
    assert plant.contact.forces["base-gate"] > 1.0
    plant.reset()
    plant.observe()
    assert plant.task["gate"][0] == pytest.approx(3.0)


def test_each_plant_of_a_batch_sees_with_its_own_noise():
    plants = Plant(moving({**ROUND, "seen": {"noise": 0.02}}), envs=2)
    plants.observe()
    seen = plants.task["goal"]
    assert np.abs(seen[0] - seen[1]).max() > 1e-3
    single = Plant(plants.scene, seed=1)
    single.observe()
    np.testing.assert_allclose(single.task["goal"], seen[1], atol=1e-6)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"through": SQUARE}, "needs a period, or times"),
        ({"through": SQUARE, "times": [0.0, 1.0]}, "4 points and 2 times"),
        ({"through": SQUARE[:2], "times": [0.5, 1.0]}, "begin with 0"),
        ({"through": SQUARE[:2], "times": [0.0, 1.0], "period": 1.0}, "ends after the last"),
    ],
)
def test_motions_that_make_no_sense(motion, message):
    with pytest.raises(ValueError, match=message):
        moving({"name": "goal", **motion})


def test_only_what_the_task_can_move_moves():
    with pytest.raises(SceneError, match="nothing that can move") as error:
        check_scene(moving({**ROUND, "name": "wall"}, obstacle=[WALL]))
    assert error.value.key == "motion.wall.name"
    with pytest.raises(SceneError, match="moves already"):
        check_scene(moving(ROUND, ROUND))


def test_motions_are_varied_by_their_name():
    scene = with_values(load_scene("storm_track"), {"motion.goal.period": 5.0})
    assert scene.motion[0].period == 5.0
