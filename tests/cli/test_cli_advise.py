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


def tried(command, folder, *options: str, scene: str = SCENE) -> tuple[dict[str, dict], str]:
    """Trials on a scene's failed run by what they set, and the table."""
    (folder / "mine.toml").write_text(scene)
    done = command("run", "mine.toml", "--advise", "--json", *options)
    assert done.returncode == 1
    trials = results(done)[0]["tried"]
    return {" ".join(trial["set"]): trial for trial in trials}, done.stderr


def test_what_is_advised_is_tried_on_the_same_seed_and_the_best_of_it_told(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    done = command("run", "mine.toml", "--seed", "2")
    assert "to try what may help: the same command with --seed 2 --advise" in done.stdout
    done = command("run", "mine.toml", "--advise", "--seed", "2", "--episodes", "2")
    assert done.stdout.count("  tried: ") == 8
    assert "  tried: cost.effort.weight=2 helps, the goal is reached at" in done.stdout
    assert "  reached soonest with --set cost.effort.weight=2\n" in done.stdout
    assert "to try what may help" not in done.stdout
    assert "trying 8 changes, " in done.stderr


def test_a_run_that_looks_too_short_ahead_is_told_so(command, tmp_path):
    trials, _ = tried(command, tmp_path, "--set", "cost.effort.weight=6")
    further = trials["planner.lookahead=0.48"]
    assert further["helped"] is True
    assert further["reached_s"] < 1.6
    assert "reached_s" not in trials["planner.noise.sigma.range=0.075"]


def test_noise_that_is_far_too_large_is_told_so(command, tmp_path):
    scene = SCENE.replace("distance = 0.1", "distance = 0.02, hold = 0.4").replace("weight = 20.0", "weight = 0.0")
    noise = "{ sigma = { range = 1.0 }, spread = [1.0, 1.0], constant = 0.0, null_sample = false }"
    scene = scene.replace(
        "samples = 16", f'method = "predictive_sampling", keep_best = false, noise = {noise}, samples = 16'
    )
    trials, _ = tried(command, tmp_path, scene=scene)
    assert "reached_s" in trials["planner.noise.sigma.range=0.3"]
    assert "reached_s" not in trials["planner.noise.sigma.range=3.0"]


def test_where_nothing_helps_that_is_told_and_what_cannot_be_tried_has_a_reason(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE.replace("[0.3, 0.0]", "[30.0, 0.0]"))
    done = command("run", "mine.toml", "--advise", "--set", "planner.method=gradient_descent")
    assert done.stdout.endswith("  none of these helped\n")
    assert "  tried: planner.refine=false cannot be tried, " in done.stdout
    assert 'method = "gradient_descent" has no samples' in done.stdout


def test_nothing_is_tried_after_a_success_or_with_options_that_it_does_not_go_with(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE.replace("weight = 20.0", "weight = 0.1"))
    (result,) = results(command("run", "mine.toml", "--advise", "--json"))
    assert result["success"]
    assert "tried" not in result
    done = command("run", "mine.toml", "--advise", "--results", "kept.jsonl")
    assert done.returncode == 2
    assert "--advise: not with --results" in done.stderr
