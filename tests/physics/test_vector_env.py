# SPDX-License-Identifier: Apache-2.0
"""``BatchVectorEnv`` against gymnasium's own environments of the same model, in every mode of resetting.

Slow ones by hand: pytest -m slow tests/physics/test_vector_env.py
"""

import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import warp as wp
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from needs import needs

from warpmpc.physics import BatchSimulator
from warpmpc.physics.vector_env import BatchVectorEnv
from warpmpc.physics.world_view import WorldView, control, joint_position, joint_velocity

WORLDS, LIMIT = 9, 16
EXAMPLE = str(Path(__file__).parents[2] / "examples" / "ppo.py")
MODES = list(AutoresetMode)


@wp.func
def observe(s: WorldView, o: wp.array[float]):
    for i in range(2):
        o[i] = joint_position(s, i)
        o[2 + i] = joint_velocity(s, i)


@wp.func
def fallen(s: WorldView) -> bool:
    return wp.abs(joint_position(s, 1)) > 0.2


@wp.func
def standing(s: WorldView) -> float:
    return wp.where(fallen(s), 0.0, 1.0)


@wp.func
def pushed(s: WorldView) -> float:
    return control(s, 0) * control(s, 0)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Gymnasium's pendulum on a cart with an integrator that this physics has."""
    own = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "inverted_pendulum.xml"
    path = tmp_path_factory.mktemp("model") / "pendulum.xml"
    path.write_text(own.read_text().replace('integrator="RK4"', 'integrator="implicitfast"'))
    return path


class Starts:
    """Start states of gymnasium's environments: those that generators of one for each world draw."""

    def __init__(self, seed):
        self.rngs = [np.random.default_rng(seed + w) for w in range(WORLDS)]

    def __call__(self, _, worlds):
        drawn = np.array([[self.rngs[w].uniform(-0.01, 0.01, 2) for _ in range(2)] for w in worlds])
        return {"qpos": drawn[:, 0], "qvel": drawn[:, 1]}


def random_starts(rng, worlds):
    return {name: rng.uniform(-0.01, 0.01, (len(worlds), 2)) for name in ("qpos", "qvel")}


def make(file, mode="NextStep", *, worlds=WORLDS, device="cpu", vary=(), **keys):
    model = mujoco.MjModel.from_xml_path(str(file))
    keys = {
        "observe": observe,
        "size": 4,
        "rewards": {standing: 1.0},
        "terminations": [fallen],
        "start": random_starts,
        "substeps": 2,
        "max_episode_steps": LIMIT,
    } | keys
    return BatchVectorEnv(BatchSimulator(model, worlds, device=device, vary=vary), autoreset_mode=mode, **keys)


def theirs(file, mode):
    def one():
        return TimeLimit(InvertedPendulumEnv(str(file), frame_skip=2), LIMIT)

    return SyncVectorEnv([one] * WORLDS, autoreset_mode=mode)


def actions(step):
    """Actions that let some worlds fall and others reach their limit of steps."""
    rng = np.random.default_rng(step)
    return (rng.uniform(-1.0, 1.0, (WORLDS, 1)) * np.linspace(0.02, 1.0, WORLDS)[:, None]).astype(np.float32)


@pytest.mark.parametrize("mode", MODES)
def test_episodes_are_those_of_gymnasiums_own_environments(file, mode):
    ours = RecordEpisodeStatistics(make(file, mode, start=Starts(3)))
    peer = RecordEpisodeStatistics(theirs(file, mode))
    seen = [ours.reset(seed=3)[0], peer.reset(seed=3)[0]]
    ended = np.zeros((2, WORLDS), dtype=int)  # terminated, truncated
    for step in range(120):
        np.testing.assert_allclose(*seen, atol=2e-4)
        (a, *left, info), (b, *right, info_b) = ours.step(actions(step)), peer.step(actions(step))
        for mine, other in zip(left, right, strict=True):
            np.testing.assert_array_equal(mine, other)
            assert mine.dtype == other.dtype
        assert ("final_obs" in info, "episode" in info) == ("final_obs" in info_b, "episode" in info_b)
        for key in {"_final_obs", "_final_info", "_episode"} & set(info_b):
            np.testing.assert_array_equal(info[key], info_b[key])
        for mine, other in zip(info.get("final_obs", ()), info_b.get("final_obs", ()), strict=True):
            assert (mine is None) == (other is None)
            if mine is not None:
                np.testing.assert_allclose(mine, other, atol=2e-4)
        # their reset takes the mask out of the options, which their statistics then miss
        if "episode" in info and mode != AutoresetMode.DISABLED:
            np.testing.assert_array_equal(info["episode"]["r"], info_b["episode"]["r"])
            np.testing.assert_array_equal(info["episode"]["l"], info_b["episode"]["l"])
        ended += left[1:]
        seen = [a, b]
        if mode == AutoresetMode.DISABLED and (over := left[1] | left[2]).any():
            seen = [env.reset(options={"reset_mask": over.copy()})[0] for env in (ours, peer)]
    assert ended.sum(axis=1).min() > 5
    if mode != AutoresetMode.DISABLED:
        assert list(ours.return_queue) == list(peer.return_queue)


class One(gymnasium.Env):
    """The only world of a vector environment, for checks that gymnasium has for single ones alone."""

    def __init__(self, envs):
        self.envs = envs
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.envs.reset(seed=seed, options=options)[0][0], {}

    def step(self, action):
        observation, *rest, _ = self.envs.step(action[None])
        return observation[0], *(x[0].item() for x in rest), {}


@pytest.mark.filterwarnings("ignore:.*(minimum|maximum) value is|.*symmetric and normalized")
def test_gymnasiums_checks_pass(file):
    check_env(One(make(file, "Disabled", worlds=1)), skip_render_check=True)
    env = make(file)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, info = NormalizeObservation(env).reset(seed=0)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert (observation.shape, info) == ((WORLDS, 4), {})
    np.testing.assert_array_equal(env.single_action_space.high, [3.0])


def trace(env, seed, steps=60):
    out = [env.reset(seed=seed)[0]]
    for step in range(steps):
        observation, reward, terminated, truncated, _ = env.step(actions(step))
        out.append(np.hstack([observation, np.transpose([reward, terminated, truncated])]))
    return np.concatenate([x.ravel() for x in out])


@pytest.mark.parametrize("mode", MODES[:2])
def test_a_seed_says_all_draws(file, mode):
    def numbers(rng, worlds):
        return {"body_mass": env.simulator.model.body_mass * rng.uniform(0.8, 1.2, (len(worlds), 1))}

    env = make(file, mode, vary=("body_mass",), numbers=numbers)
    first = trace(env, 1)
    masses = env.simulator.numbers("body_mass")
    other = trace(env, 2)
    assert not np.array_equal(first, other)
    np.testing.assert_array_equal(trace(env, 1), first)
    np.testing.assert_array_equal(env.simulator.numbers("body_mass"), masses)
    assert np.ptp(masses[:, 1]) > 0.1 * masses[0, 1]
    env.reset(options={"reset_mask": np.arange(WORLDS) == 4})
    np.testing.assert_array_equal((env.simulator.numbers("body_mass") != masses).any(axis=1), np.arange(WORLDS) == 4)


def test_threads_change_no_bit(file):
    model = mujoco.MjModel.from_xml_path(str(file))
    ends = []
    for threads in (1, 2):
        sim = BatchSimulator(model, 300, threads=threads)
        env = BatchVectorEnv(
            sim,
            observe=observe,
            size=4,
            rewards={pushed: 0.1, standing: 1.0},
            terminations=[fallen],
            start=random_starts,
            autoreset_mode="SameStep",
        )
        env.reset(seed=5)
        for _ in range(60):
            out = env.step(np.linspace(-1.0, 1.0, 300)[:, None])
        ends.append(np.hstack([out[0], out[1][:, None]]))
    np.testing.assert_array_equal(*ends)


def test_worlds_that_go_on_do_not_see_the_resets_of_others(file):
    """The world in the middle, beside worlds that are reset again and again, and alone."""
    paths = []
    for limit in (None, 4):
        env = make(file, start=Starts(0), max_episode_steps=limit, terminations=())
        env.reset(seed=0)
        path = []
        for _ in range(3):
            path.append(env.step(np.zeros((WORLDS, 1)))[0])
        env.reset(options={"reset_mask": np.arange(WORLDS) % 2 == 1})
        path += [env.step(np.zeros((WORLDS, 1)))[0] for _ in range(1)]
        paths.append(np.array(path)[:, ::2])
    np.testing.assert_array_equal(*paths)


def test_there_may_be_many_rewards(file):
    def number(value):
        @wp.func
        def constant(s: WorldView) -> float:
            return float(value)

        return constant

    env = make(file, rewards={number(i): 1.0 for i in range(20)}, terminations=[fallen] * 20)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(np.zeros((WORLDS, 1)))[1], 190.0)
    np.testing.assert_array_equal(env.reward_terms()["constant"], 190.0)
    env.set_weights(constant=-1.0)  # of all that have this name
    np.testing.assert_array_equal(env.step(np.zeros((WORLDS, 1)))[1], -190.0)


@pytest.mark.parametrize("mode", MODES[:2])
def test_a_world_that_diverges_ends_and_begins_anew(file, mode):
    env = make(file, mode, max_episode_steps=None)
    env.reset(seed=0)
    env.simulator.qvel[4] = np.nan
    seen, reward, terminated, _, info = env.step(np.zeros((WORLDS, 1)))
    assert list(np.flatnonzero(terminated)) == [4]
    assert reward[4] == 0.0
    assert not (info["final_obs"][4] if mode == AutoresetMode.SAME_STEP else seen[4]).any()
    for _ in range(3):
        seen, reward, terminated, *_ = env.step(np.zeros((WORLDS, 1)))
    assert np.isfinite(seen).all()
    assert not terminated.any()
    assert reward.all()


@pytest.mark.parametrize(
    ("act", "error", "match"),
    [
        (lambda env: env.step(np.zeros((WORLDS, 1))), ResetNeeded, "9 of 9 worlds need a reset"),
        (lambda env: env.reset() and env.step(np.zeros(WORLDS)), ValueError, r"shape \(9,\), not \(9, 1\)"),
        (lambda env: env.reset(options={"reset_mask": np.zeros(WORLDS, bool)}), ValueError, "one is true"),
        (lambda env: env.reset(options={"reset_mask": np.ones(2, bool)}), ValueError, "9 booleans"),
        (lambda env: env.reset(options={"reset_mask": np.ones(WORLDS)}), ValueError, "9 booleans"),
        (lambda env: env.set_weights(upright=1.0), ValueError, "no reward upright; there is: standing"),
    ],
)
def test_errors_say_what_to_do(file, act, error, match):
    with pytest.raises(error, match=match):
        act(make(file))


def test_a_plain_function_is_an_error(file):
    with pytest.raises(TypeError, match=r"random_starts is no function of Warp: add @wp\.func"):
        make(file, terminations=[random_starts])
    with pytest.raises(ValueError, match="Standing"):
        make(file, "Standing")


def test_a_step_after_an_end_needs_a_reset_where_worlds_do_not_reset_themselves(file):
    env = make(file, "Disabled", max_episode_steps=2)
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros((WORLDS, 1)))
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((WORLDS, 1)))


def run(*args):
    return subprocess.run([sys.executable, *args], capture_output=True, text=True, encoding="utf-8", timeout=280)


def test_without_gymnasium_the_error_says_what_brings_it():
    done = run("-c", "import sys; sys.modules['gymnasium'] = None; import warpmpc.physics.vector_env")
    assert done.stderr.splitlines()[-1] == (
        'ImportError: warpmpc.physics.vector_env needs gymnasium: pip install "warpmpc[gymnasium]"'
    )
    assert run("-c", "import sys; sys.modules['gymnasium'] = None; import warpmpc.physics").returncode == 0


@needs("torch")
def test_the_example_learns_to_balance():
    """Steps of cart-poles get longer within seconds."""
    done = run(EXAMPLE, "cartpole", "--minutes", "0.15", "--worlds", "256", "--threads", "1")
    assert done.returncode == 0, done.stderr
    returns = [float(found) for found in re.findall(r"return ([\d.]+)", done.stdout)]
    assert returns[-1] > 2.0 * returns[0]


@needs("torch")
@needs("mjlab")
@pytest.mark.slow
@pytest.mark.parametrize("robot", ["go1", "g1"])
def test_the_example_walks_robots(robot):
    done = run(EXAMPLE, robot, "--minutes", "0.1", "--worlds", "64", "--threads", "1")
    assert done.returncode == 0, done.stderr
    assert "gait 0." in done.stdout
