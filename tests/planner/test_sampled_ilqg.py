# SPDX-License-Identifier: Apache-2.0
"""iLQG that goes on from samples: when it does, what it is handed, and what it holds that samples let fall.

Slow ones by hand: pytest -m slow tests/planner/test_sampled_ilqg.py
"""

import threading
import time
import traceback

import numpy as np
import pytest
import warp as wp
from post_scene import POST
from small_scenes import DISC, make_scene
from warp._src import context

from warpmpc import Controller, SceneError, State, load_scene, run_episode
from warpmpc.engine.protocol import TimeGrid
from warpmpc.physics.runtime.launch import CapturedLaunches, Launcher, capturing
from warpmpc.planner.refine import some_draws
from warpmpc.planner.refiners import fine_grid
from warpmpc.scene.model.properties import Properties

OTHERS = "tools/studies/others"


def controller(**planner) -> Controller:
    return Controller(make_scene(planner=planner), engine="fused", device="cpu")


@pytest.mark.parametrize(
    ("planner", "engine", "goes_on"),
    [
        ({}, "fused", True),
        ({}, "mujoco", True),
        ({}, "kinematic", False),  # nothing is unstable without physics
        ({"samples": 32, "iterations": 1}, "fused", False),  # 19 worlds for differences
        ({"samples": 38, "iterations": 1}, "fused", True),
        ({"samples": 32, "iterations": 1, "refine": {"method": "ilqg"}}, "fused", True),
        ({"refine": None}, "fused", False),
        ({"execute": "best"}, "fused", False),
        ({"method": "cem"}, "fused", False),
        ({"method": "predictive_sampling"}, "fused", False),
    ],
    ids=str,
)
def test_it_goes_on_unasked_where_it_is_cheap_beside_samples_with_physics(planner, engine, goes_on):
    mpc = Controller(make_scene(planner=planner), engine=engine, device="cpu")
    assert (mpc.plan_step.refiner is not None) == goes_on


@pytest.mark.usefixtures("optimized")
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_robot_keeps_away_from_a_post_as_with_samples_alone(tmp_path, seed):
    """Derivatives see a force only once there is contact: noise in the candidates keeps a distance."""
    file = tmp_path / "post.toml"
    file.write_text(POST)
    result = run_episode(load_scene(file, overrides=["timing.timeout=5.0"]), device="cpu", seed=seed)
    assert result.time_in_contact == 0.0
    assert result.position_error < 1.0  # it came as near as it can
    assert sum(result.proposers[name] for name in result.proposers if name != "lowered") == pytest.approx(1.0)
    assert 0.1 < result.proposers["lowered"] <= 1.0


def test_terms_that_are_not_taken_step_by_step_leave_it_out():
    keys = ["engine.name=mujoco", "planner.dt=[0.02]", "planner.horizon=10", "planner.samples=128"]
    mpc = Controller(load_scene("storm_balance", overrides=keys), device="cpu")
    assert mpc.plan_step.refiner is None
    with pytest.raises(SceneError, match="carries numbers along"):
        Controller(load_scene("storm_balance", overrides=[*keys, "planner.refine.method=ilqg"]), device="cpu")


def test_plans_have_a_control_for_every_step_and_samples_keep_their_knots():
    mpc = controller(samples=64, lookahead=0.8, dt=0.08, knots=4, refine={"method": "ilqg"})
    for now in (0.0, 0.04, 0.08):
        plan = mpc.plan(State(np.zeros(3), np.zeros(3), now))
        assert plan.knots.shape == (20, 3)
        assert mpc.rollout().knots.shape == (4, 3)
        np.testing.assert_allclose(plan.times, now + 0.04 * np.arange(20), atol=1e-6)
        np.testing.assert_allclose(plan.at(now), mpc.command, atol=1e-6)


def test_the_plan_costs_no_more_than_that_of_the_samples():
    """Samples about plans that bear noise cost 5.98 here, those about plans of samples 5.94, each ± 1 % over seeds."""
    scenes = [make_scene(planner={"samples": 64, "refine": refine}) for refine in (None, {"method": "ilqg"})]
    q = np.array([0.2, -0.3, 0.4])
    ends = np.empty((2, 4))
    for i, scene in enumerate(scenes):
        for seed in range(4):
            mpc = Controller(scene, engine="fused", device="cpu", seed=seed)
            for n in range(8):
                mpc.step(State(q, np.zeros(3), 0.04 * n))
            ends[i, seed] = mpc.info.cost  # of the best sample: samples are drawn about the improved plan
    assert ends[1].mean() <= 1.03 * ends[0].mean()


def test_no_environment_changes_the_plan_of_another():
    scene = make_scene(planner={"samples": 64, "refine": {"method": "ilqg"}})
    knots = []
    for second in ([0.0, 0.0, 0.0], [0.5, 1.0, 0.3]):
        starts = np.array([[0.2, -0.3, 0.4], second], dtype=np.float32)
        knots.append(
            Controller(scene, engine="fused", device="cpu", envs=2).plan(State(starts, 0.0 * starts, 0.0)).knots
        )
    np.testing.assert_array_equal(knots[0][0], knots[1][0])
    assert np.abs(knots[0][1] - knots[1][1]).max() > 0.1


def test_the_last_step_counts_as_much_beside_the_others():
    coarse = TimeGrid(np.full(10, 0.08), np.array([*0.9 ** np.arange(9), 20.0], dtype=np.float32))
    fine = fine_grid(coarse, 0.02)
    assert fine.steps == 40
    assert fine.t[-1] == pytest.approx(coarse.t[-1])
    assert fine.discount[-1] == 80.0
    np.testing.assert_allclose(fine.discount[:36], coarse.discount[:9].repeat(4))
    assert fine_grid(TimeGrid(np.full(8, 0.01), np.ones(8)), 0.02).steps == 8  # never longer than a step of samples


def test_candidates_are_tried_in_the_nominal_world_first_and_in_the_same_draws():
    drawn = Properties(("box",), np.array([[0.8], [1.3], [1.1]]), np.ones((3, 1)), np.full((3, 1, 3), 0.02))
    tried = some_draws(drawn, 2, 3)
    np.testing.assert_allclose(tried.mass[:, 0], [1.0, 0.8, 1.3] * 2)
    np.testing.assert_allclose(tried.size[:, 0, 0], [0.0, 0.02, 0.02] * 2)


@pytest.mark.usefixtures("optimized")
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_it_holds_a_pole_that_samples_let_fall(seed):
    def fell(**changes: object) -> bool:
        overrides = [f"{key}={value}" for key, value in {"timing.timeout": 4.0, **changes}.items()]
        return not run_episode(
            load_scene(f"{OTHERS}/pole_arm.toml", overrides=overrides), device="cpu", seed=seed
        ).success

    assert not fell()
    assert fell(**{"planner.refine": "false"})


@wp.kernel
def add_kernel(x: wp.array[float]):
    """One thread: adds one to a number."""
    x[wp.tid()] = x[wp.tid()] + 1.0


@pytest.mark.parametrize("planner", [{"samples": 64, "refine": {"method": "ilqg"}}, {"method": "ilqg"}], ids=str)
def test_plans_are_made_while_other_threads_record(planner):
    """A recording takes in what any thread launches or copies meanwhile, and copies of some arrays end it."""
    mpc, numbers, launch = controller(**planner), wp.zeros(8, dtype=float, device="cpu"), Launcher("cpu")
    stopped, errors = threading.Event(), []

    def record() -> None:
        try:
            while not stopped.is_set():
                sequence = CapturedLaunches(lambda: [launch(add_kernel, 8, [], [numbers]) for _ in range(20)])
                sequence()
                sequence()
                time.sleep(1e-3)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=record)
    thread.start()
    try:
        for n in range(40):
            plan = mpc.plan(State(np.zeros(3), np.zeros(3), 0.04 * n))
    finally:
        stopped.set()
        thread.join()
    assert not errors
    assert plan.feedback is not None


@pytest.mark.parametrize("method", ["samples", "auto", "gradient", "ilqg", "ilqs"])
def test_whatever_a_plan_launches_copies_and_writes_waits_for_recordings(monkeypatch, method):
    """Of every thread, also at the first plan, which allocates."""
    found = []

    def watched(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def checked(*args: object, **options: object) -> object:
            if not capturing._is_owned():
                found.append("".join(traceback.format_stack(limit=4)))
            return original(*args, **options)

        monkeypatch.setattr(owner, name, checked)

    refined = {"samples": None, "auto": {}, "gradient": {"method": "gradient"}}
    planner = {"samples": 64, "refine": refined[method]} if method in refined else {"method": method}
    mpc = controller(**planner)
    for owner, name in [(context, "copy"), *((wp, x) for x in ("launch", "launch_tiled", "copy", "clone", "zeros"))]:
        watched(owner, name)
    for name in ("assign", "zero_", "fill_"):
        watched(wp.array, name)
    for n in range(3):
        state = State(np.zeros(3), np.zeros(3), 0.04 * n)
        mpc.plan(state).at(0.04 * n, state)
    assert not found, found[0]


@pytest.mark.parametrize("method", ["ilqg", "gradient"])
def test_an_observation_that_is_not_finite_is_no_plan(method):
    mpc = controller(samples=64, refine={"method": method})
    mpc.step(State(np.full(3, np.nan), np.zeros(3), 0.0))
    assert (mpc.info.fallback, mpc.info.lowered) == (True, 0.0)
    mpc.step(State(np.zeros(3), np.zeros(3), 0.04))
    assert 0.0 < mpc.info.lowered < 1.0


def test_no_derivatives_leave_the_plan_of_the_samples(caplog):
    mpc = controller(samples=64, refine={"method": "ilqg"})
    mpc.plan_step.refiner.differences._moves.state.fill_(np.nan)
    plan = mpc.plan(State(np.zeros(3), np.zeros(3), 0.0))
    assert plan.feedback is None
    mpc.plan(State(np.zeros(3), np.zeros(3), 0.04))
    assert caplog.text.count("no derivatives") == 1  # once until they work again
    assert mpc.info.lowered == 0.0
    assert np.isfinite(plan.knots).all()
    assert np.abs(plan.knots).max() > 0.1
    assert DISC["drive"]["limit"][0] >= np.abs(plan.knots).max()
