# SPDX-License-Identifier: Apache-2.0
"""The verdict on a failed run names the planted mistake; a run that succeeds has none."""

import pytest
from small_scenes import compiled, make_scene

from warpmpc.run.episode import run_episode
from warpmpc.scene.load import load_scene

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
        ({"temperature": {"initial": 1e9, "eta": None, "ess": None}}, "all samples count alike"),
        ({"temperature": {"initial": 1e-9, "eta": None, "ess": None}}, "one sample alone decides"),
    ],
)
def test_weights_that_are_no_help_are_told(planner, told):
    result = run(planner=planner, goal={"frame": "base/centre", "position": (9.0, 0.0)})
    assert [s for s in result.verdict if told in s], result.verdict


def test_controls_at_their_limits_are_told():
    scene = load_scene("pendulum", overrides=["timing.timeout=1.0"])
    result = run_episode(scene, seed=0, engine="mujoco", device="cpu")
    assert [s for s in result.verdict if s.startswith("control pendulum/torque is at a limit")], result.verdict
