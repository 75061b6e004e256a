# SPDX-License-Identifier: Apache-2.0
"""The DeepMind Control Suite: whose physics and rewards are played, what is planned with, what the table says."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

pytest.importorskip("dm_control")

from dm_tasks.environment import Eyes, load, save_model
from dm_tasks.play import Episode, names, play, scene_of, split
from dm_tasks.table import read, table
from shared import commands, seeds
from studies import dm_suite

from warpmpc.model.compiled import compile_scene

TOOL = Path(__file__).parents[2] / "tools" / "study.py"


def test_rewards_and_physics_are_the_suites_own():
    actions, ways, rewards = [], [], []

    def look(environment, seen):
        actions.append(environment.physics.control().copy())
        ways.append(environment.physics.state().copy())
        rewards.append(seen.reward)

    played = play(Episode(name="pendulum_swingup", seed=5, steps=50, engine="mujoco"), on_step=look)
    own = load("pendulum", "swingup", seed=5)
    own.reset()
    for action, way, reward in zip(actions, ways, rewards, strict=True):
        assert own.step(action).reward == reward
        np.testing.assert_array_equal(own.physics.state(), way)
    assert played["steps"] == 50
    assert played["reward"] == sum(rewards)
    assert np.ptp(actions) > 0.1  # and something was done


@pytest.mark.parametrize("name", ["finger_turn_hard", "fish_swim", "reacher_hard"])
def test_targets_are_where_the_episode_puts_them(name):
    domain, task = split(name)
    compiled = compile_scene(scene_of(name))
    places = []
    for seed in (1, 2):
        environment = load(domain, task, seed=seed)
        environment.reset()
        named = environment.physics.named.data
        kind = named.site_xpos if domain == "finger" else named.geom_xpos
        places.append(Eyes(compiled, environment).place("target"))
        np.testing.assert_array_equal(places[-1][:3], kind["target"])
    assert np.linalg.norm(places[0] - places[1]) > 0.01


@pytest.mark.parametrize("name", ["cheetah_run", "finger_spin"])
def test_the_model_planned_with_has_what_the_suite_changes_after_reading_it(name):
    domain, task = split(name)
    environment = load(domain, task, seed=3)
    environment.reset()
    own, planned = environment.physics.model.ptr, mujoco.MjModel.from_xml_path(str(save_model(domain, task)))
    for field in ("body_mass", "body_inertia", "dof_damping", "jnt_range", "geom_friction"):
        np.testing.assert_allclose(getattr(planned, field), getattr(own, field), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("name", ["humanoid_walk", "fish_swim"])
def test_the_model_planned_with_moves_as_the_suites_does(name):
    domain, task = split(name)
    environment = load(domain, task, seed=3)
    environment.reset()
    own, planned = environment.physics.model.ptr, mujoco.MjModel.from_xml_path(str(save_model(domain, task)))
    there, here = mujoco.MjData(own), mujoco.MjData(planned)
    there.qpos[:] = environment.physics.data.qpos
    rng, contacts = np.random.default_rng(0), 0
    for _ in range(150):
        here.qpos[:], here.qvel[:], here.qacc_warmstart[:] = there.qpos, there.qvel, there.qacc_warmstart
        here.ctrl[:] = there.ctrl[:] = rng.uniform(-1.0, 1.0, own.nu)
        mujoco.mj_step(own, there)
        mujoco.mj_step(planned, here)
        np.testing.assert_allclose(here.qvel, there.qvel, atol=2e-3)
        assert here.ncon == there.ncon
        contacts += there.ncon
    assert contacts > 0 or domain == "fish"  # which touches nothing


def test_a_state_with_a_free_root_is_seen_as_it_is():
    environment = load("fish", "swim", seed=4)
    environment.reset()
    for _ in range(10):
        environment.step(np.array([1.0, -1.0, 0.5, 1.0, -0.3]))
    compiled = compile_scene(scene_of("fish_swim"))
    state, data = Eyes(compiled, environment).state(), environment.physics.named.data
    np.testing.assert_allclose(state.joint_q[:3], data.qpos["root"][:3], atol=1e-6)
    np.testing.assert_allclose(state.joint_q[3:7], np.roll(data.qpos["root"][3:], -1), atol=1e-6)
    turn = data.xmat["torso"].reshape(3, 3) @ data.qvel["root"][3:]
    np.testing.assert_allclose(state.joint_qd[3:6], turn, atol=1e-6)
    np.testing.assert_allclose(state.joint_q[7:], environment.physics.data.qpos[7:], atol=1e-6)
    assert state.time == pytest.approx(environment.physics.time())


def test_every_scene_is_one_of_the_suites_tasks():
    assert names()
    for name in names():
        assert load(*split(name), seed=0).control_timestep() == pytest.approx(scene_of(name).timing.control_dt)


def row(task: str, seed: int, reward: float, **other) -> dict:
    """An episode as the tool records it."""
    return {
        "task": task,
        "seed": seed,
        "steps": 1000,
        "reward": reward,
        "engine": "fused",
        "samples": 64,
        "horizon": 0.5,
        "iterations": 2,
        "control_ms": 20.0,
        "plan_ms": {"p50": 1.0 + seed, "p99": 9.0},
        "threads": 1,
        "fallbacks": 0,
        "settings": "0123",
        **other,
    }


def test_the_table_has_means_their_intervals_and_the_worst_and_counts_them():
    text = table([row("walker_run", 1, 900.0), row("walker_run", 0, 860.0), row("hopper_hop", 0, 200.0)])
    # Student's t of one degree of freedom: 12.706 · 28.28 / √2
    assert "| walker run | **880** ± 254 | 860 | 2 | 877 | 2.0 / 9.0 | 20 | 64 × 2 | 0.5 |" in text
    assert "| hopper hop | **200** | 200 | 1 |" in text
    assert "1 of 2 at 800 or more, 1 below 300, 1 at TD-MPC2's return or above. Seeds 0 to 1;" in text
    assert "not to be compared" in table([row("walker_run", 0, 1.0, steps=20)])


def test_episodes_that_differ_in_more_than_their_seed_have_no_mean():
    with pytest.raises(ValueError, match="walker_run: episodes of different settings"):
        table([row("walker_run", 1, 900.0), row("walker_run", 2, 860.0, settings="4567")])
    with pytest.raises(ValueError, match="walker_run: a seed was played twice"):
        table([row("walker_run", 1, 900.0), row("walker_run", 1, 860.0)])


def test_files_of_episodes_become_one_table(tmp_path, capsys):
    rows = [row("walker_run", seed, 900.0) for seed in range(3)]
    for name, some in (("a", rows[:2]), ("b", rows[1:])):
        (tmp_path / name).write_text(json.dumps(some))
    assert read([tmp_path / "a", tmp_path / "b"]) == rows
    assert commands.run("studies", "", ["dm_suite", "--table", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert "| walker run | **900** ± 0 | 900 | 3 |" in capsys.readouterr().out
    (tmp_path / "a").write_text('[{"task": "walker_run"}]')
    assert commands.run("studies", "", ["dm_suite", "--table", str(tmp_path / "a")]) == 2
    assert f"error: {tmp_path / 'a'}: no episodes" in capsys.readouterr().err


@pytest.fixture
def drawn(tmp_path, monkeypatch) -> Path:
    """A file of drawn seeds that the tool uses in place of its own."""
    file = tmp_path / "seeds.toml"
    file.write_text('[[block]]\nreport = "old"\nfirst = 1000\nlast = 2399\n')
    monkeypatch.setattr(dm_suite, "draw", functools.partial(seeds.draw, file=file))
    return file


def test_a_report_draws_ten_seeds_that_nobody_has_looked_at_once(drawn):
    def seeds_of(*arguments: str) -> list[int]:
        return sorted({episode.seed for episode in dm_suite.episodes(dm_suite.parse(list(arguments)))})

    assert seeds_of("pendulum_swingup", "--report", "a") == list(range(2400, 2410))
    assert seeds.blocks(drawn)[-1].report == "a"
    assert seeds_of("reacher_hard", "--report", "a") == list(range(2400, 2410))  # goes on with another task
    assert seeds_of("reacher_hard", "--report", "b") == list(range(2410, 2420))
    with pytest.raises(ValueError, match="'a' was made with other settings, its seeds are worn out"):
        seeds_of("reacher_hard", "--report", "a", "--set", "planner.samples=8")
    assert [block.report for block in seeds.blocks(drawn)] == ["old", "a", "b"]


def test_seeds_named_by_hand_above_those_for_tuning_are_warned_of(capsys):
    dm_suite.episodes(dm_suite.parse(["pendulum_swingup", "--seeds", "999"]))
    assert capsys.readouterr().err == ""
    dm_suite.episodes(dm_suite.parse(["pendulum_swingup", "--seeds", "999", "1000"]))
    assert "worn out by this: [1000]" in capsys.readouterr().err


def test_shipped_blocks_of_seeds_do_not_overlap():
    used = seeds.blocks()
    for block, before in zip(used, [seeds.TUNING, *(block.seeds for block in used[:-1])], strict=True):
        assert block.first > before[-1]
        assert len(block.seeds) >= seeds.COUNT


def test_one_episode_of_each_task_comes_first_and_then_the_longest():
    order = dm_suite.episodes(dm_suite.parse(["pendulum_swingup", "walker_run", "hopper_hop"]))
    longest = ["walker_run", "hopper_hop", "pendulum_swingup"]
    assert [episode.name for episode in order] == longest + [name for name in longest for _ in range(2)]


def test_episodes_played_already_are_not_played_again(tmp_path):
    file = tmp_path / "played.json"
    arguments = ["pendulum_swingup", "--steps", "10", "--engine", "mujoco", "--json", str(file)]
    assert commands.run("studies", "", ["dm_suite", *arguments, "--seeds", "3"]) == 0
    first = read([file])
    assert commands.run("studies", "", ["dm_suite", *arguments, "--seeds", "3", "4"]) == 0
    assert [row["seed"] for row in read([file])] == [3, 4]
    assert read([file])[:1] == first  # to the microsecond of its plans
    (other,) = dm_suite.episodes(dm_suite.parse([*arguments, "--seeds", "3", "--set", "planner.samples=8"]))
    assert other.settings != first[0]["settings"]  # and so is another episode


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["walker_fly"], "no scene for the task 'walker_fly'"),
        (["walker_run", "--engine", "warp"], "no engine 'warp'"),
        (["walker_run", "--set", "planner.sample=3"], "sample"),
        (["--table", "/nowhere/played.json"], "/nowhere/played.json"),
    ],
)
def test_bad_input_is_one_clear_error(arguments, said):
    done = subprocess.run([sys.executable, TOOL, "dm_suite", *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("error:")
    assert said in done.stderr
