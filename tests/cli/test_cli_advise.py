# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run --advise``: what the verdict on a failed run advises is tried, and what helped is told."""

from program import results

SCENE = """
timing = { control_dt = 0.04, timeout = 1.6 }
engine = { name = "mujoco", threads = 1 }
planner = { samples = 16, horizon = 6, dt = 0.04, iterations = 1 }
goal = { frame = "base/centre", position = [0.3, 0.0] }
success = { distance = 0.1 }

[[robot]]
name = "base"
asset = "point_robot.urdf"
ground_contact = false
drive = { damping = 300.0, effort_limit = 200.0, limit = 1.0 }
frames.centre = { link = "base_link" }

[[cost]]
term = "distance"
between = ["base/centre", "goal"]
weight = 10.0

[[cost]]
name = "effort"
term = "control_effort"
weight = 20.0
"""
"""An effort that costs too much to move."""


def test_what_is_advised_is_tried_on_the_same_seed(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    done = command("run", "mine.toml", "--advise", "--seed", "2", "--json", "--episodes", "2")
    first, second = results(done)
    assert done.returncode == 1
    assert "tried" not in second
    assert len(first["tried"]) == 3
    trial = first["tried"][0]
    assert trial["set"] == ["cost.effort.weight=2"]
    assert trial["helped"] is True
    assert trial["outcome"].startswith("the goal is reached at ")
    done = command("run", "mine.toml", "--advise", "--seed", "2")
    assert "  tried: cost.effort.weight=2 helps, the goal is reached at" in done.stdout
    assert "trying --set cost.effort.weight=2\n" in done.stderr


def test_nothing_is_tried_after_a_success_or_with_options_that_it_does_not_go_with(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE.replace("weight = 20.0", "weight = 0.1"))
    (result,) = results(command("run", "mine.toml", "--advise", "--json"))
    assert result["success"]
    assert "tried" not in result
    done = command("run", "mine.toml", "--advise", "--results", "kept.jsonl")
    assert done.returncode == 2
    assert "--advise: not with --results" in done.stderr
