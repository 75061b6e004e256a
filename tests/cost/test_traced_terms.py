# SPDX-License-Identifier: Apache-2.0
"""Users' cost terms inside a launch cost what their Warp functions say of the record, whatever they are made of."""

import logging

import pytest
import warp as wp
from fused_costs import assert_costs, expected_totals, planned
from small_scenes import BOX, compiled, make_scene

import warpmpc


@wp.struct
class FrameParams:
    frame: int
    limit: float


@wp.func
def leaning(q: wp.quat) -> float:
    return 1.0 - wp.quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))[2]


@warpmpc.cost_term("upright")
def upright(s: warpmpc.StepView, p: FrameParams) -> float:
    return leaning(warpmpc.frame_rotation(s, p.frame)) + p.limit


@warpmpc.cost_term("branches")
def branches(s: warpmpc.StepView, p: FrameParams) -> float:
    """Returns from inside branches on values, some lanes earlier than others."""
    position = warpmpc.frame_position(s, p.frame)
    if position[0] < p.limit:
        return wp.abs(position[0] - p.limit)
    if position[1] > 0.0 and not position[0] > 2.0 * p.limit:
        return 2.0 + position[1]
    speed = wp.length(warpmpc.frame_velocity(s, p.frame))
    return wp.where(speed > 0.5, speed, 0.25 * speed)


@warpmpc.cost_term("loops")
def loops(s: warpmpc.StepView, p: FrameParams) -> float:
    """Loops with continue and break, and one that goes on until its lane is done."""
    x = warpmpc.frame_position(s, p.frame)[0]
    total = float(0.0)  # noqa: UP018 (a variable that changes)
    for i in range(8):
        if i == 2:
            continue
        total += x * float(i)
        if total > 3.0:
            break
    rest = wp.abs(x) + 1.0
    while rest > 0.4:
        rest *= 0.5
    return wp.abs(total) + rest


@warpmpc.cost_term("quaternions")
def quaternions(s: warpmpc.StepView, p: FrameParams) -> float:
    """Components of quaternions, products of poses, and functions of Warp."""
    pose = warpmpc.frame_pose(s, p.frame)
    q = wp.transform_get_rotation(pose)
    turned = wp.quat(0.0, 0.0, wp.sin(0.3), wp.cos(0.3)) * q
    tip = wp.transform_point(wp.transform_inverse(pose), wp.vec3(p.limit, 0.2, 0.1))
    return (
        q[2] * q[2] + q[3] * q[3] + wp.abs(turned[2] * turned[3]) + wp.exp(-wp.length(tip)) + wp.tanh(tip[1] * tip[1])
    )


@warpmpc.cost_term("jerky")
def jerky(s: warpmpc.StepView, p: FrameParams) -> float:
    """Controls and frames of the step before, and time."""
    before = warpmpc.step_before(s)
    moved = warpmpc.frame_position(s, p.frame) - warpmpc.frame_position(before, p.frame)
    rate = wp.length(moved) / warpmpc.step_length(s)
    return rate + wp.abs(warpmpc.control(s, 0) - s.controls[s.t - 1, s.w, 1]) + 0.1 * warpmpc.step_time(s)


@warpmpc.cost_term("accelerating")
def accelerating(s: warpmpc.StepView, p: FrameParams) -> float:
    """Mean accelerations over the step."""
    linear = wp.length(warpmpc.frame_acceleration(s, p.frame))
    return wp.abs(linear - p.limit) + 0.2 * wp.length(warpmpc.frame_angular_acceleration(s, p.frame))


@warpmpc.cost_term("long")
def data_dependent(s: warpmpc.StepView, p: FrameParams) -> float:
    """A loop whose length depends on the state."""
    total = float(0.0)  # noqa: UP018 (a variable that changes)
    for i in range(int(10.0 * wp.abs(warpmpc.frame_position(s, p.frame)[0]))):
        total += 0.1 * float(i)
    return total


TRACED = (upright, branches, loops, quaternions, jerky, accelerating)


def scene_of(*terms):
    keys = {"frame": "base/centre", "limit": 0.4}
    costs = [{"term": term.name, **keys, "weight": 1.0 + i} for i, term in enumerate(terms)]
    return make_scene(object=[BOX], cost=costs, planner={"samples": 21, "horizon": 6, "dt": 0.08})


@pytest.mark.parametrize("seed", range(3))
def test_users_terms_are_part_of_the_launch_and_cost_what_their_functions_say(seed):
    scene = scene_of(*TRACED)
    mpc = planned(scene, seed=seed, envs=2, speed=1.0, terms=TRACED, compiled=compiled(scene))
    assert mpc.engine._on_record.numpy().tolist() == []
    assert not mpc.engine.records
    expected = expected_totals(mpc)
    assert (expected.max(axis=1) > expected.min(axis=1)).all()  # each tells samples apart
    assert_costs(mpc, expected)


def test_a_term_that_cannot_be_traced_is_evaluated_on_the_record_and_the_log_says_why(caplog):
    scene = scene_of(upright, data_dependent)
    with caplog.at_level(logging.INFO, logger="warpmpc"):
        mpc = planned(scene, terms=(upright, data_dependent), compiled=compiled(scene))
    assert [mpc.costs.labels[i] for i in mpc.engine._on_record.numpy()] == ["long"]
    assert_costs(mpc, expected_totals(mpc))
    (said,) = [r.getMessage() for r in caplog.records if "not in the launch" in r.getMessage()]
    assert said.startswith("cost term 'long' is evaluated on the record, not in the launch: a loop whose length")
