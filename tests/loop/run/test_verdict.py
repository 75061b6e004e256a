# SPDX-License-Identifier: Apache-2.0
"""The verdict on a failed run names the planted mistake; a run that succeeds has none."""

import re

import pytest
from planted import ARM
from small_scenes import DISC, compiled, make_scene

from warpmpc import run_episode

COST = [{"term": "distance", "between": ["base/centre", "goal"], "weight": 5.0}]


def run(**changes):
    """One short episode of a disc that is sent to a place."""
    keys = {
        "timing": {"control_dt": 0.04, "timeout": 2.0},
        "cost": COST,
        "goal": {"frame": "base/centre", "position": (0.6, 0.0)},
        "success": {"distance": 0.1},
    }
    keys.update(changes)
    scene = make_scene(**keys)
    return run_episode(scene, seed=3, engine="mujoco", device="cpu", compiled=compiled(scene))


def test_a_run_that_succeeds_has_no_verdict():
    result = run()
    assert result.success
    assert result.verdict == ()
    assert "verdict" not in result.to_json()


def test_what_is_not_met_is_told_with_its_best():
    result = run(goal={"frame": "base/centre", "position": (9.0, 0.0)}, timing={"control_dt": 0.04, "timeout": 0.4})
    assert not result.success
    first = result.verdict[0]
    assert first.startswith("not met: distance to the goal [m] is ")
    assert first.endswith("wanted at most 0.1")
    assert result.to_json()["verdict"] == list(result.verdict)


def test_a_condition_is_told_with_its_bound_from_below():
    result = run(success={"conditions": {"joint": "base/x", "above": 5.0}})
    assert [s for s in result.verdict if s.startswith("not met: base/x is ") and s.endswith("wanted at least 5")]


def test_a_success_that_does_not_last_is_told():
    result = run(success={"distance": 0.2, "hold": 1.9}, timing={"control_dt": 0.04, "timeout": 2.0})
    assert not result.success
    assert "has not held for 1.9 s" in result.verdict[0]


@pytest.mark.parametrize(
    ("goal", "pull", "told"),
    [
        (0.4, 1.3, "distance to the goal [m] was as wanted and left it again"),
        (1.3, 0.3, "distance to the goal [m] came no nearer after"),
    ],
    ids=["left", "stuck"],
)
def test_a_goal_that_is_passed_or_not_come_nearer_to_is_told(goal, pull, told):
    result = run(
        goal={"frame": "base/centre", "position": (goal, 0.0)},
        target=[{"name": "lure", "position": (pull, 0.0)}],
        cost=[{"term": "distance", "between": ["base/centre", "lure"], "weight": 5.0}],
        success={"distance": 0.2, "hold": 1.0},
        timing={"control_dt": 0.04, "timeout": 4.0},
    )
    assert [s for s in result.verdict if s.startswith(told)], result.verdict
    assert not [s for s in result.verdict if "timing.timeout" in s]


@pytest.mark.parametrize(
    ("planner", "told"),
    [
        ({"samples": 32, "temperature": {"initial": 1e9, "eta": None, "ess": None}}, "all samples count alike"),
        ({"samples": 32, "temperature": {"initial": 1e-9, "eta": None, "ess": None}}, "one sample alone decides"),
    ],
)
def test_weights_that_are_no_help_are_told(planner, told):
    result = run(planner=planner, goal={"frame": "base/centre", "position": (9.0, 0.0)})
    assert [s for s in result.verdict if told in s], result.verdict


def test_controls_at_their_limits_are_told_before_advice_to_look_further_ahead():
    result = run(
        robot=[{**DISC, "drive": {"damping": 300.0, "effort_limit": 200.0, "limit": (0.3, 0.3, 1.0)}}],
        goal={"frame": "base/centre", "position": (-1.0, 0.0)},
        target=[{"name": "lure", "position": (9.0, 9.0)}],
        cost=[{"term": "distance", "between": ["base/centre", "lure"], "weight": 5.0}],
        success={"distance": 0.2},
        timing={"control_dt": 0.04, "timeout": 4.0},
    )
    unmet, limit, *_, ahead = [s for s in result.verdict if re.match("not met|control base|.*look further ahead", s)]
    assert unmet.startswith("not met: ")
    assert limit.startswith("control base/x, base/y is at a limit"), result.verdict
    assert "look further ahead" in ahead


def run_file(tmp_path, asset, *, start=None, frames=None, **sections):
    """One short episode of a robot of an MJCF file."""
    (tmp_path / "r.xml").write_text(asset)
    robot = [{"name": "r", "asset": str(tmp_path / "r.xml"), "frames": frames or {}}]
    robot[0] |= {"position": start} if start else {}
    scene = make_scene(robot=robot, timing={"control_dt": 0.02, "timeout": 2.0}, **sections)
    return run_episode(scene, seed=0, engine="mujoco", device="cpu")


def told(result, start: str) -> str:
    """The sentence of a verdict that begins so."""
    (sentence,) = [s for s in result.verdict if s.startswith(start)]
    return sentence


def tries(result) -> list[list[str]]:
    """Changes of the scene that a verdict guesses."""
    return [guess.overrides for guess in result.shortfall.tries]


def test_a_goal_out_of_reach_is_told_and_neither_time_nor_a_look_ahead_is_advised(tmp_path):
    near = {"term": "distance", "between": ["r/fore", "goal"]}
    goal = {"frame": "r/fore", "position": (8.7, 0.0, 1.0)}
    result = run_file(tmp_path, ARM, goal=goal, cost=[near], ground=None)
    assert "which reaches 0.5 m at most (goal.position): move the place" in told(result, "goal is 8.7 m from")
    assert not [s for s in result.verdict if "timing.timeout" in s or "came no nearer" in s]


def test_what_creeps_towards_a_goal_is_told_with_its_rate():
    slow = {**DISC, "drive": {"damping": 300.0, "effort_limit": 200.0, "limit": (0.02, 0.02, 1.0)}}
    goal = {"frame": "base/centre", "position": (0.6, 0.0)}
    sentence = told(
        run(robot=[slow], goal=goal, planner={"samples": 32}),
        "distance to the goal [m] came nearer by only 0.02 a second",
    )
    assert sentence.endswith("s more: faster drives (wider limits of controls)")
    kicked = {"kicks": [{"target": "base", "time": 1.92, "velocity": (-0.3, 0.0, 0.0)}]}
    told(run(robot=[slow], goal=goal, planner={"samples": 32}, plant=kicked), "distance to the goal [m] came nearer by")
    soon = run(goal=goal, timing={"control_dt": 0.04, "timeout": 0.4})
    assert "to arrive at about" in told(soon, "distance to the goal [m] was still coming nearer")
    (longer,) = [float(c[0].split("=")[1]) for c in tries(soon) if c[0].startswith("timing.timeout")]
    assert 0.6 < longer < 2.0


def test_a_regularizer_that_decides_while_the_goal_stalls_is_told_with_its_share():
    effort = {"term": "control_effort", "weight": 200.0}
    result = run(cost=[*COST, effort], timing={"control_dt": 0.04, "timeout": 2.0})
    assert "does not lead to what is wanted: lower its weight (200 now)" in told(result, "control_effort is ")
    assert tries(result)[0] == ["cost.control_effort.weight=20"]


def test_few_samples_are_told():
    far = {"frame": "base/centre", "position": (9.0, 0.0)}
    result = run(planner={"samples": 8, "horizon": 6}, goal=far)
    assert "more samples (--set planner.samples=128)" in told(result, "8 samples are few for the 18 numbers of a plan")


DRONE = """
<mujoco><default><motor ctrlrange="0 6"/></default><worldbody>
  <body name="frame"><freejoint/><geom type="box" size=".15 .15 .03" mass=".5"/>
    <site name="a" pos=".12 .12 .02"/><site name="b" pos=".12 -.12 .02"/>
    <site name="c" pos="-.12 .12 .02"/><site name="d" pos="-.12 -.12 .02"/></body>
</worldbody><actuator>
  <motor name="a" site="a" gear="0 0 1 0 0 .016"/><motor name="b" site="b" gear="0 0 1 0 0 -.016"/>
  <motor name="c" site="c" gear="0 0 1 0 0 -.016"/><motor name="d" site="d" gear="0 0 1 0 0 .016"/>
</actuator></mujoco>
"""
"""A drone that lifts five times its weight."""


def test_samples_that_tumble_ask_for_less_noise_and_a_failure_says_what_moved_it_there(tmp_path):
    goal = {"frame": "r/frame", "position": (3.0, 0.0, 1.0)}
    result = run_file(
        tmp_path,
        DRONE,
        start=(0.0, 0.0, 1.0),
        goal=goal,
        cost=[{"term": "distance", "between": ["r/frame", "goal"]}],
        planner={"samples": 16, "noise": {"sigma": {"range": [0.25]}}},
        failure=[{"name": "low", "conditions": {"frame": "r/frame", "below": 0.4}}],
        success={"distance": 0.1, "hold": 1.0},
    )
    assert result.reason == "failed: low"
    met = told(result, "failure low was met at ")
    assert "height of r/frame 0." in met
    assert "moved by r/frame" in met
    assert "a smaller planner.noise.sigma (--set planner.noise.sigma.range=0.125)" in "".join(result.verdict)
    assert [s for s in result.verdict if "of the samples tumble that were looked at" in s]


def test_the_control_behind_a_failure_of_a_joint_is_told_also_where_a_scene_has_no_success(tmp_path):
    bent = {"name": "bent", "conditions": {"joint": "r/elbow", "above": 0.3}}
    result = run_file(
        tmp_path,
        ARM,
        frames={"tip": {"link": "fore", "offset": (0.4, 0.0, 0.0)}},
        goal={"frame": "r/tip", "position": (0.0, 0.0, 0.1)},
        cost=[{"term": "distance", "between": ["r/tip", "goal"]}],
        failure=[bent],
        success=None,
        ground=None,
    )
    met = told(result, "failure bent was met at ")
    assert "(above 0.3), from 0 " in met
    assert "moved by r/fore (sent r/elbow " in met


def test_noise_that_is_too_small_is_told():
    noise = {"spread": (0.02, 1.0), "sigma": 0.002}
    result = run(planner={"samples": 64, "horizon": 6, "noise": noise})
    assert "third with the most noise: a larger planner.noise.sigma (--set planner.noise.sigma=0.004)" in told(
        result, "in "
    )
