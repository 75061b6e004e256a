# SPDX-License-Identifier: Apache-2.0
"""What is hardly meant is said in a sentence that names the key; what ships is meant as it is."""

import pytest
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc.extras.doctor.advice import advise
from warpmpc.loop.realtime.pace import slow_plans


def said(**sections) -> list[str]:
    scene = make_scene(**sections)
    return advise(scene, compiled(scene))


TURNED = {"robot": [{**DISC, "joint_q": {"yaw": 90.0}}]}


def planner(**keys) -> dict:
    return {"planner": {"samples": 32, "horizon": 6, **keys}}


def test_nothing_is_said_about_a_scene_as_it_should_be():
    assert said(object=[BOX]) == []
    assert said(**planner(noise={"sigma": {"range": 0.25}, "spread": (0.1, 4.0)}, knots=6)) == []


@pytest.mark.parametrize(
    ("sections", "says"),
    [
        (planner(noise={"sigma": 5.0}), ["planner.noise.sigma is wider than the range", "base/", "-1 to 1"]),
        (planner(noise={"sigma": (0.5, 0.5, 1e-5)}), ["planner.noise.sigma is tiny beside the range of base/yaw"]),
        (planner(knots=9), ["planner.knots = 9", "6 steps"]),
        ({"success": {"distance": 0.1, "hold": 5.0}}, ["success.hold = 5 s", "timing.timeout = 4 s", "no run can"]),
        (TURNED, ["robot.base.joint_q.yaw = 90 rad is 14.3 turns: is it in degrees?"]),
        ({"goal": {"frame": "base/centre", "yaw": -45.0}}, ["goal.yaw = -45 rad is 7.16 turns"]),
        ({"object": [{**BOX, "size": (300.0, 500.0, 200.0)}]}, ["the shape box", "500 m", "in millimetres?"]),
    ],
    ids=["wide", "narrow", "knots", "hold", "start", "goal", "size"],
)
def test_what_is_hardly_meant_is_said(sections, says):
    (sentence,) = said(**sections)
    for part in says:
        assert part in sentence


def test_plans_that_come_too_late_are_told_with_a_cure():
    assert slow_plans(39.0, 0.04) is None
    assert slow_plans(float("nan"), 0.04) is None
    sentence = slow_plans(55.04, 0.04)
    assert sentence.startswith("real time would need a plan every 40 ms of wall time, a plan takes 55.0 ms: lower")
    for part in ("planner.samples", "timing.control_dt", "--real-time --speed 0.65"):
        assert part in sentence
    assert slow_plans(55.04, 0.04, speed=0.65) is None  # the cure cures


def test_at_another_speed_controls_last_as_long_as_they_do_there():
    assert slow_plans(150.0, 0.04, speed=0.25) is None
    sentence = slow_plans(200.0, 0.04, speed=0.25)
    assert sentence.startswith("speed 0.25 would need a plan every 160 ms of wall time, a plan takes 200.0 ms: lower")
    assert sentence.endswith("--speed 0.18")
