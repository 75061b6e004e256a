# SPDX-License-Identifier: Apache-2.0
"""Random reachable poses: how they are drawn, whether a Panda reaches them, and what it does where it cannot."""

import numpy as np
import pytest
from needs import needs
from studies.reach.arm import Arm
from studies.reach.poses import CLEARANCE, Reachable, draw_pose
from studies.reach.reference import quickest
from studies.reach.runs import planned, pose_miss

import warpmpc
from warpmpc.model.compiled import compile_scene

DOWN = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def arm() -> Arm:
    scene = warpmpc.load_scene("storm_reach")
    return Arm(scene, compile_scene(scene))


def test_poses_are_those_of_postures_that_touch_nothing(arm):
    for seed in range(5):
        target = draw_pose(arm, seed)
        np.testing.assert_array_equal(draw_pose(arm, seed).pose, target.pose)
        assert pose_miss(arm.tool(target.posture), target.pose) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert not arm.touching(target.posture, margin=CLEARANCE)


def test_links_in_each_other_or_in_a_block_are_found(arm):
    assert not arm.touching(arm.start[arm.dofs])
    folded = np.array([0.0, 0.3, 0.0, -3.0, 0.0, 0.2, 0.78])
    assert any("world" not in pair for pair in arm.touching(folded))
    low = np.array([0.0, 1.7, 0.0, -0.3, 0.0, 1.5, 0.0])
    assert any("world" in pair for pair in arm.touching(low))


def test_postures_found_for_a_pose_have_it(arm):
    target = draw_pose(arm, 1)
    found = arm.postures(target.pose, 10, seed=0)
    assert found
    for q in found:
        assert max(pose_miss(arm.tool(q), target.pose)) < 1e-4
        assert not arm.touching(q)


@needs("ruckig")
def test_the_least_time_is_that_of_full_acceleration_and_speed(arm):
    start = arm.start[arm.dofs]
    end = start.copy()
    end[0] += 1.0
    way = quickest(arm, 10.0, start, end, dt=0.02)
    speed = arm.speed[0]
    assert way.duration == pytest.approx(speed / 10.0 + 1.0 / speed, rel=1e-6)
    np.testing.assert_allclose(way.q[-1], end, atol=1e-9)


@pytest.mark.slow
def test_an_arm_reaches_random_poses_and_touches_nothing():
    course, planner = planned("storm_reach", ())
    records = [course.run(planner, draw_pose(course.arm, seed))[0] for seed in range(300, 320)]
    assert sum(record["reached"] for record in records) >= 19
    assert not [record["touched"] for record in records if record["touched"]]
    assert all(record["limits_kept"] for record in records)
    assert np.median([record["time_s"] for record in records if record["reached"]]) < 3.2


def pose_cost(miss: tuple[float, float]) -> float:
    """What the scene's ``pose`` costs, about, of a distance [m] and an angle [rad]."""
    return 100.0 * miss[0] + 15.0 * 2.0 * np.sqrt(2.0) * np.sin(0.5 * miss[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "away", [(1.3, 0.0, 0.5), (0.5, 0.2, 0.15), (0.3, 0.0, 1.45)], ids=["too far", "in a block", "too high"]
)
def test_an_arm_goes_as_near_as_it_can_and_comes_back(away):
    course, planner = planned("storm_reach", ("timing.timeout=5.0",))
    arm, out = course.arm, Reachable(np.array([*away, *DOWN]), course.arm.start[course.arm.dofs])
    record, track = course.run(planner, out)
    drawn = np.random.default_rng(0).uniform(arm.lower, arm.upper, (3000, len(arm.dofs)))
    best = min(pose_cost(pose_miss(arm.tool(q), out.pose)) for q in drawn if not arm.touching(q))
    assert not record["touched"]
    assert record["limits_kept"]
    assert pose_cost(track.miss[-1]) < best
    # the goal comes back: no plan, no distribution is forgotten
    plant, back = course.plant, np.array([0.45, 0.35, 0.4, *DOWN])
    planner.controller.task["goal"] = back
    for _ in range(250):
        plant.apply(planner.step(plant.observe()))
        q = plant.state.joint_q[course.arm.dofs].astype(float)
        assert not course.arm.touching(q)
    assert pose_miss(course.arm.tool(q), back)[0] < 0.005
    assert pose_miss(course.arm.tool(q), back)[1] < 0.05
