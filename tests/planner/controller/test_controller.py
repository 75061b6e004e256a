# SPDX-License-Identifier: Apache-2.0
"""The controller: it reaches its goal, repeats itself, and stays safe when nothing survives."""

import contextlib
import logging
import threading
import time

import numpy as np
import pytest
import warp as wp
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc import (
    Controller,
    Plant,
    SceneError,
    State,
    array_cost,
)

SMALL = {"samples": 16, "horizon": 4}


def make_controller(*, seed: int = 0, engine: str = "auto", terms=(), **sections) -> Controller:
    scene = make_scene(**{"planner": SMALL, **sections})
    return Controller(scene, seed=seed, engine=engine, terms=terms, compiled=compiled(scene))


def start(controller: Controller) -> State:
    return State.start(controller.layout)


@pytest.mark.parametrize("method", ["mppi", "predictive_sampling", "cem"])
def test_it_brings_the_disc_to_its_goal(method):
    planner = {"method": method, "samples": 48, "horizon": 8, "temperature": {"initial": 0.1}, "sigma_min": (0.1,)}
    scene = make_scene(planner=planner)
    controller = Controller(scene, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene))
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
    assert plant.time < 3.0
    info = controller.info
    assert not info.fallback
    assert info.time == pytest.approx(plant.time - 0.04)
    assert info.diverged_worlds == 0
    assert info.plan_ms > 0.0
    assert set(info.stages_ms) == {"begin", "noise", "evaluate", "update"}
    assert info.cost == pytest.approx(sum(info.terms.values()), rel=1e-4)


def test_the_same_seed_gives_the_same_commands_and_reset_starts_over():
    cost = {"term": "distance", "between": ["base/centre", "box"], "metric": "geodesic"}
    wall = {"name": "wall", "shape": "box", "size": (0.2, 1.0, 0.4), "position": (1.0, 0.0, 0.2)}
    sections = {"object": [{**BOX, "position": (2.0, 0.0, 0.1)}], "obstacle": [wall], "cost": [cost]}

    def commands(controller: Controller) -> np.ndarray:
        out = []
        for i in range(10):
            state = start(controller)
            state.joint_q[3] += 0.02 * i  # the box moves, and with it its distance field
            out.append(controller.step(state))
        return np.array(out)

    first = make_controller(seed=3, **sections)
    once = commands(first)
    np.testing.assert_array_equal(once, commands(make_controller(seed=3, **sections)))
    assert not np.array_equal(once, commands(make_controller(seed=4, **sections)))
    first.reset()
    assert first.info is None
    np.testing.assert_array_equal(once, commands(first))


def drive(mode: str, **keys) -> dict:
    common = {"velocity": {"damping": 300.0}, "position": {"stiffness": 500.0, "damping": 50.0}, "effort": {}}
    return {"mode": mode, "effort_limit": 50.0, **common[mode], **keys}


DRIVES = {
    "velocity": drive("velocity", limit=(1.0,)),
    "position": drive("position", lower=(-2.0,), upper=(2.0,)),
    "effort": drive("effort", limit=(20.0,)),
}


@pytest.mark.parametrize("engine", ["auto", "mujoco"])
@pytest.mark.parametrize("why", ["diverged", "nan", "inf"])
@pytest.mark.parametrize("mode", DRIVES)
def test_when_nothing_survives_it_sends_the_safe_command(mode, why, engine, caplog):
    controller = make_controller(engine=engine, robot=[{**DISC, "drive": DRIVES[mode]}])
    state = State(np.array([0.3, -0.4, 3.0], np.float32), np.array([0.2, 0.1, 0.0], np.float32), time=0.4)
    controller.step(state)
    assert not controller.info.fallback
    q, qd = state.joint_q.copy(), state.joint_qd.copy()
    if why == "diverged":
        qd[0] = 1e30  # finite, but no rollout survives it
    else:
        q[1] = {"nan": np.nan, "inf": np.inf}[why]
    bad = State(q, qd, time=0.44)
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        command = controller.step(bad)
    safe = [0.3, -0.4, 2.0] if mode == "position" else [0.0, 0.0, 0.0]  # within its limits
    np.testing.assert_allclose(command, safe, atol=1e-6)
    np.testing.assert_array_equal(controller.plan_step.command.numpy()[0], command)
    assert controller.info.fallback
    assert controller.info.cost == np.inf
    assert controller.info.eta == 0.0
    assert "sending the safe command" in caplog.text
    assert ("diverged" if why == "diverged" else "not finite") in caplog.text
    if why == "diverged":
        assert controller.info.diverged_worlds == controller.shape.worlds


def test_it_recovers_from_a_bad_observation():
    controller, other = make_controller(), make_controller()
    state = start(controller)
    bad = State(np.full(3, np.nan, np.float32), state.joint_qd)
    controller.step(bad)
    for _ in range(3):
        np.testing.assert_array_equal(controller.step(state), other.step(state))
    assert not controller.info.fallback


def test_a_cost_that_is_nowhere_finite_is_a_fallback_too():
    value = [0.0]
    terms = [array_cost("nothing")(lambda batch: np.full(batch["control"].shape[:2], value[0]))]
    controller = make_controller(terms=terms, cost=[{"term": "nothing"}])
    value[0] = np.nan  # a term that is so from the start is refused
    np.testing.assert_array_equal(controller.step(start(controller)), 0.0)
    assert controller.info.fallback
    assert controller.info.diverged_worlds == 0


@pytest.mark.parametrize("shape", [(2, 3), (3, 4), (1,)])
def test_a_state_of_the_wrong_shape_is_refused(shape):
    controller = make_controller()
    q, qd = (np.zeros(n) for n in (shape * 2)[:2])
    with pytest.raises(ValueError, match=r"joint_q \[3\] and joint_qd \[3\]"):
        controller.step(State(q, qd))


def test_the_goal_can_be_moved():
    controller = make_controller(planner={"samples": 48, "horizon": 6, "temperature": {"initial": 0.05}})
    for x in (5.0, -5.0):
        controller.task["goal"] = np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        for _ in range(12):
            command = controller.step(start(controller))
        assert np.sign(command[0]) == np.sign(x)
        assert abs(command[0]) > 0.4


@pytest.mark.parametrize("pose", [np.zeros(3), np.full(7, np.nan), np.zeros((1, 7)), np.zeros(7)])
def test_a_goal_that_is_no_pose_is_refused(pose):
    controller = make_controller()
    before = controller.task["goal"]
    with pytest.raises(ValueError, match="'goal' is a pose"):
        controller.task["goal"] = pose
    np.testing.assert_array_equal(controller.task["goal"], before)


@pytest.mark.parametrize(("keys", "message"), [({"engine": "bullet"}, "bullet"), ({"device": "cuda:9"}, "cuda:9")])
def test_an_engine_or_device_that_is_not_there_is_named(keys, message):
    scene = make_scene()
    with pytest.raises(ValueError, match=message):
        Controller(scene, compiled=compiled(scene), **keys)


def test_a_mistake_in_the_costs_shows_at_construction():
    with pytest.raises(SceneError, match="Did you mean 'base/centre'"):
        make_controller(cost=[{"term": "distance", "between": ["base/center", "goal"]}])


def bad(state: State, e: int | None = None) -> State:
    """The same observation with a NaN, of one environment."""
    q = state.joint_q.copy()
    q[... if e is None else e, 1] = np.nan
    return State(q, state.joint_qd, state.time)


def test_the_safe_command_is_within_the_limits_that_were_set():
    for mode, safe in (("position", [0.25, -0.4, 0.5]), ("velocity", [0.1, 0.0, 0.0]), ("effort", [0.1, 0.0, 0.0])):
        controller = make_controller(robot=[{**DISC, "drive": DRIVES[mode]}])
        state = State(np.array([0.3, -0.4, 0.9], np.float32), np.zeros(3, np.float32))
        controller.step(state)
        lower = np.array([0.1, -0.6, -0.5])
        controller.set_limits(lower, np.array([0.25, 0.6, 0.5]))
        command = controller.step(bad(state))
        assert controller.info.fallback
        np.testing.assert_allclose(command, safe, atol=1e-6)


@pytest.mark.parametrize(
    "limits", [(np.zeros(2), np.ones(2)), (np.ones(3), np.zeros(3)), (np.full(3, np.nan), np.ones(3))]
)
def test_limits_that_make_no_sense_are_refused(limits):
    with pytest.raises(ValueError, match="limits are 3 finite numbers"):
        make_controller().set_limits(*limits)


def test_a_position_drive_that_has_seen_nothing_has_nothing_to_hold():
    """Neither after construction nor after a reset is there a posture to hold; the scene's start is none."""
    controller = make_controller(robot=[{**DISC, "drive": DRIVES["position"]}])
    state = State(np.array([0.3, -0.4, 0.9], np.float32), np.zeros(3, np.float32))
    for _ in range(2):
        with pytest.raises(ValueError, match="no position to hold"):
            controller.step(bad(state))
        controller.step(state)
        np.testing.assert_allclose(controller.step(bad(state)), [0.3, -0.4, 0.9], atol=1e-6)
        controller.reset()


def test_a_position_drive_starts_from_what_it_observes():
    """A first plan that does not move commands the observed posture, not the scene's start."""
    planner = {**SMALL, "noise": {"sigma": (1e-6,)}}
    controller = make_controller(
        robot=[{**DISC, "joint_q": (1.0, 1.0, 0.0), "drive": DRIVES["position"]}], planner=planner
    )
    for place in ([0.3, -0.4, 0.9], [-0.5, 0.2, 0.1]):
        state = State(np.array(place, np.float32), np.zeros(3, np.float32))
        np.testing.assert_allclose(controller.step(state), place, atol=1e-4)
        controller.reset()


def apart(envs: int) -> tuple[np.ndarray, np.ndarray]:
    """Environments at different places."""
    q = np.zeros((envs, 3), np.float32)
    q[:, 0], q[:, 1] = 0.2 * np.arange(envs), -0.3 * np.arange(envs)
    return q, np.zeros((envs, 3), np.float32)


def many(envs: int, *, redraw: bool, method: str = "mppi") -> Controller:
    planner = {**SMALL, "method": method, "noise": {"redraw": redraw}, "temperature": {"initial": 0.1}}
    scene = make_scene(planner=planner)
    return Controller(scene, envs=envs, seed=3, compiled=compiled(scene))


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("method", ["mppi", "cem"])
def test_a_bad_observation_of_one_environment_is_what_it_is_for_a_controller_of_its_own(method, timed):
    """Noise that is drawn once is shared, so every environment does what a controller of one does."""
    together, alone = many(3, redraw=False, method=method), [many(1, redraw=False, method=method) for _ in range(3)]
    if method == "cem":  # redraws at every plan, in every environment its own
        together, alone = many(3, redraw=True, method=method), [many(1, redraw=True, method=method)]
    q, qd = apart(3)
    poisoned = 0 if method == "cem" else 1
    for n in range(8):
        time = 0.04 * n if timed else None
        state = State(q, qd, time)
        command = together.step(bad(state, poisoned) if n == 3 else state)
        for e, controller in enumerate(alone):
            own = State(q[e], qd[e], time)
            expected = controller.step(bad(own) if n == 3 and e == poisoned else own)
            np.testing.assert_array_equal(command[e], expected, err_msg=f"plan {n}, environment {e}")
        assert [info.fallback for info in together.info] == [n == 3 and e == poisoned for e in range(3)]


@pytest.mark.parametrize("redraw", [False, True])
def test_a_bad_observation_disturbs_no_other_environment(redraw):
    disturbed, clean = many(3, redraw=redraw), many(3, redraw=redraw)
    q, qd = apart(3)
    for n in range(6):
        state = State(q, qd, 0.04 * n)
        found, expected = disturbed.step(bad(state, 2) if n in (0, 3) else state), clean.step(state)
        np.testing.assert_array_equal(found[:2], expected[:2])


def test_plans_move_by_the_time_between_observations():
    """Two controls late, half a control early, a clock that runs back: the plan is where the time says."""
    planner = {"samples": 2, "horizon": 8, "noise": {"sigma": (0.3,), "null_sample": False}, "spline": "linear"}
    for times, moved in (
        ([0.0, 0.08], 2.0),
        ([5.0, 5.02], 0.5),
        ([3.0, 2.0], 0.0),
        ([1.0, 1.0], 0.0),
        ([None, None], 1.0),
    ):
        controller = make_controller(planner={**planner, "step_size": 1e-6})
        state = start(controller)
        controller.step(State(state.joint_q, state.joint_qd, times[0]))
        ramp = np.tile(0.1 * np.arange(8.0, dtype=np.float32)[None, :, None], (1, 1, 3))
        controller.plan_step.strategy.mean.assign(ramp)
        command = controller.step(State(state.joint_q, state.joint_qd, times[1]))
        np.testing.assert_allclose(command, 0.1 * moved, atol=1e-4)


@pytest.mark.parametrize(("risk", "share"), [("mean", 0.25), ("worst", 0.25), ("cvar", 0.5), ("cvar", 0.3)])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("engine", ["auto", "mujoco"])
def test_the_terms_add_up_to_the_cost_over_all_domains(risk, share, seed, engine):
    controller = make_controller(
        seed=seed,
        engine=engine,
        object=[{**BOX, "position": (0.36, 0.0, 0.1)}],
        goal={"object": "box", "position": (1.5, 0.0)},
        cost=[
            {"term": "distance", "between": ["box", "goal"], "weight": 3.0},
            {"term": "contact_force", "between": ["base", "box"], "weight": 0.01},
            {"term": "control_rate", "weight": 0.1},
        ],
        randomize={"box": {"mass": {"uniform": 0.9}, "friction": {"uniform": 0.9}}},
        planner={"domains": 4, "risk": risk, "cvar": share, "samples": 12, "horizon": 6, "terminal": 2.0},
    )
    state = start(controller)
    state.joint_qd[0] = 1.0
    for _ in range(3):
        controller.step(state)
        info = controller.info
        assert info.cost == pytest.approx(sum(info.terms.values()), rel=1e-5)
        first = info.best
        if engine == "mujoco":
            cost = controller.engine.evaluator.cost.numpy()[1].sum(axis=0)
        else:
            cost = controller.engine.total.numpy()[1]
        domains = cost[first : first + 4]
        assert np.ptp(domains) > 1e-4  # the first domain alone would not add up


def test_two_controllers_take_turns_without_disturbing_each_other():
    def commands(controllers: list[Controller]) -> np.ndarray:
        state = start(controllers[0])
        return np.array([[c.step(state) for c in controllers] for _ in range(5)]).swapaxes(0, 1)

    scene = make_scene(planner=SMALL, cost=[{"term": "distance", "between": ["base/centre", "goal"]}])
    a, b = (lambda seed=seed: Controller(scene, seed=seed, compiled=compiled(scene)) for seed in (1, 2))
    together = commands([a(), b()])
    np.testing.assert_array_equal(together[0], commands([a()])[0])
    np.testing.assert_array_equal(together[1], commands([b()])[0])


def test_a_controller_made_in_a_thread_touches_nobodys_default_device(monkeypatch):
    """Warp's default device belongs to the whole process: who sets it, however briefly, sets it for all threads."""
    scene = make_scene(planner=SMALL)
    before, entered, made = wp.get_device(), [], []
    enter = wp.ScopedDevice.__enter__
    monkeypatch.setattr(wp.ScopedDevice, "__enter__", lambda scope: entered.append(scope) or enter(scope))
    parts = compiled(scene)
    entered.clear()
    thread = threading.Thread(target=lambda: made.append(Controller(scene, compiled=parts)))
    thread.start()
    thread.join()
    assert wp.get_device() is before
    assert made
    assert not entered
    command = made[0].step(start(made[0]))
    assert np.isfinite(command).all()


def test_a_second_thread_is_refused_and_disturbs_no_plan():
    scene = make_scene(planner={"samples": 64, "horizon": 10}, engine={"threads": 2})
    controller, other = (Controller(scene, engine="mujoco", device="cpu", compiled=compiled(scene)) for _ in range(2))
    state, plans = State.start(controller.layout), 200
    refusals: list[str] = []
    done = threading.Event()

    def intrude():
        while not done.is_set():
            for call in (lambda: controller.step(state), controller.rollout, controller.reset):
                try:
                    call()
                except RuntimeError as error:
                    refusals.append(str(error))
                time.sleep(1e-4)

    with controller._in_use:  # as a plan that takes its time
        thread = threading.Thread(target=intrude, daemon=True)
        thread.start()
        ours = [controller.step(state) for _ in range(plans)]
        done.set()
        thread.join(10.0)
    assert not thread.is_alive()
    assert refusals
    assert set(refusals) == {
        "another thread uses this Controller now: give each thread its own, or let one thread call it"
    }
    np.testing.assert_array_equal(ours, [other.step(state) for _ in range(plans)])


def test_two_threads_that_plan_at_once_do_not_hang():
    scene = make_scene(planner={"samples": 64, "horizon": 10}, engine={"threads": 2})
    controller = Controller(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    state, commands = State.start(controller.layout), []

    def ask():
        for _ in range(100):
            with contextlib.suppress(RuntimeError):
                commands.append(controller.step(state))

    threads = [threading.Thread(target=ask, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30.0)
    assert not any(thread.is_alive() for thread in threads)
    assert commands
    assert np.isfinite(commands).all()
