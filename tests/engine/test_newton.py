# SPDX-License-Identifier: Apache-2.0
"""MuJoCo Warp, directly and through Newton: agrees with MuJoCo C, forgets plans, keeps a bad world to itself.

On the CPU, kernels for one small scene are compiled once (about a minute with empty caches); the GPU variants run with
``-m gpu``.
"""

import logging

import mujoco
import newton
import numpy as np
import pytest
import warp as wp
from needs import CUDA, need
from small_scenes import BOX, DISC, WALL, compiled, make_engine, make_scene, observed, roll

from warpmpc import Controller, Plant, SceneError, State, load_scene
from warpmpc.engine.mujoco_warp import MujocoWarpSimulator
from warpmpc.engine.newton import NewtonSimulator, build_model
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize

PAIRS = (Pair("base", "wall"), Pair("base", "box"), Pair("box", "ground"), Pair("box", "wall"))
RANDOM = {"box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.01}}}
SAMPLES, HORIZON = 6, 8
ENGINES = {"mujoco_warp": MujocoWarpSimulator, "newton": NewtonSimulator}
BOTH = pytest.mark.parametrize("name", ENGINES)
PUSHER = {**DISC, "asset": "omni_base.urdf"}  # a box: contacts of boxes are computed alike by both, of cylinders not
NEAR_BOX = {**BOX, "position": (0.47, 0.0, 0.1)}


@pytest.fixture(scope="module")
def scene():
    """The base almost touches the box, and the box is not far from the wall."""
    return make_scene(robot=[PUSHER], object=[NEAR_BOX], obstacle=[WALL], randomize=RANDOM)


def controls(worlds: int, *, seed: int = 0) -> np.ndarray:
    """Random controls that mostly push forward, ``[T, W, 3]``."""
    rng = np.random.default_rng(seed)
    return rng.uniform([0.2, -0.5, -1.0], [1.0, 0.5, 1.0], size=(HORIZON, worlds, 3)).astype(np.float32)


def make_simulator(scene, device, *, name, envs=1, samples=SAMPLES, substeps=2, seed=3, pairs=PAIRS, horizon=HORIZON):
    return ENGINES[name](
        scene,
        compiled(scene),
        BatchSize(envs, samples, 1, horizon),
        substeps=[substeps] * horizon,
        timestep=0.04 / substeps,
        pairs=pairs,
        properties=draw_properties(scene, compiled(scene).layout, samples, seed=seed),
        device=device,
    )


@pytest.fixture(scope="module", params=ENGINES)
def engine(request, scene, device):
    return make_simulator(scene, device, name=request.param)


def recorded(engine, control: np.ndarray, q, qd, *, poison: int | None = None) -> dict[str, np.ndarray]:
    """Roll controls [T, W, nu] out from states [E, nq], [E, nv]; returns copies of what was recorded.

    With ``poison`` the start of that world is NaN.
    """
    engine.clone(observed(q, qd, device=engine.device))
    if poison is not None:
        engine.trajectory.joint_q[0, poison].fill_(np.nan)
        engine.trajectory.joint_qd[0, poison].fill_(np.nan)
    engine.rollout(wp.array(control, dtype=float, device=engine.device))
    out = engine.trajectory
    names = ("joint_q", "joint_qd", "body_q", "body_qd", "contact_force", "diverged", "overflow")
    return {name: getattr(out, name).numpy().copy() for name in names}


def start(scene) -> tuple[np.ndarray, np.ndarray]:
    layout = compiled(scene).layout
    return layout.joint_q, layout.joint_qd


def test_it_agrees_with_the_mujoco_engine(scene, engine):
    """Same solver, same formulas: float32 against float64, through contacts and in differently randomized worlds."""
    layout = compiled(scene).layout
    reference = make_engine(
        scene, samples=SAMPLES, horizon=HORIZON, pairs=PAIRS, properties=draw_properties(scene, layout, SAMPLES, seed=3)
    )
    control = controls(SAMPLES)
    expected = roll(reference, control, *start(scene))
    found = recorded(engine, control, *start(scene))
    box = layout.joint_q_start[layout.entity("box").joints[0]]
    assert np.ptp(found["joint_q"][-1, :, box]) > 0.01  # the worlds were pushed differently
    np.testing.assert_allclose(found["joint_q"], expected.joint_q.numpy(), atol=2e-4)
    np.testing.assert_allclose(found["joint_qd"], expected.joint_qd.numpy(), atol=2e-2)
    np.testing.assert_allclose(found["body_q"], expected.body_q.numpy(), atol=2e-4)
    force = expected.contact_force.numpy()
    assert np.abs(force[:, :, 1]).max() > 2.0  # base and box pushed each other
    np.testing.assert_allclose(found["contact_force"], force, atol=0.02 * np.abs(force).max())
    assert not found["diverged"].any()
    assert not found["overflow"].any()


def test_joint_limits_are_as_soft_as_in_the_mujoco_engine():
    """Newton's own gains of URDF joints made light fingers swing up, in this engine alone."""
    arm = load_scene("panda_reach")
    reference = mujoco.MjModel.from_xml_string(compile_scene(arm).mjcf)
    solver = newton.solvers.SolverMuJoCo(build_model(arm, 1, "cpu"), use_mujoco_cpu=True)
    assert reference.jnt_limited.sum() == 7
    np.testing.assert_allclose(solver.mj_model.jnt_solref, reference.jnt_solref)


def test_a_plan_leaves_nothing_behind(scene, engine):
    control = controls(SAMPLES)
    first = recorded(engine, control, *start(scene))
    recorded(engine, controls(SAMPLES, seed=1) * 3.0, *start(scene))
    again = recorded(engine, control, *start(scene))
    for name, values in first.items():
        np.testing.assert_allclose(again[name], values, rtol=1e-4, atol=1e-4, err_msg=name)


def test_a_poisoned_world_hurts_nobody_else_and_not_the_next_plan(scene, engine):
    control = controls(SAMPLES)
    clean = recorded(engine, control, *start(scene))
    poisoned = control.copy()
    poisoned[:, 2] = 1e30
    poisoned[3:, 4] = np.nan
    found = recorded(engine, poisoned, *start(scene), poison=4)
    assert found["diverged"][4] == 1
    others = [0, 1, 3, 5]
    assert not found["diverged"][others].any()
    exact = engine.device == "cpu"  # contacts are gathered in no fixed order on a GPU, which moves the last bits
    for name in ("joint_q", "joint_qd", "body_q", "contact_force"):
        a, b = found[name][:, others], clean[name][:, others]
        if exact:
            np.testing.assert_array_equal(a, b, err_msg=name)
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)
    after = recorded(engine, control, *start(scene))
    for name, values in clean.items():
        np.testing.assert_allclose(after[name], values, rtol=1e-4, atol=1e-4, err_msg=name)


@BOTH
def test_every_environment_starts_from_its_own_state(scene, device, name):
    engine = make_simulator(scene, device, name=name, envs=2, samples=3)
    q, qd = (np.stack([a, a]) for a in start(scene))
    q[1, 1] += 0.1
    control = np.concatenate([controls(3), controls(3)], axis=1)
    both = recorded(engine, control, q, qd)
    np.testing.assert_allclose(both["joint_q"][0, :3], np.tile(q[0], (3, 1)))
    np.testing.assert_allclose(both["joint_q"][0, 3:], np.tile(q[1], (3, 1)))
    swapped = recorded(engine, control, q[::-1], qd[::-1])
    # worlds of both environments are randomized alike
    np.testing.assert_allclose(swapped["joint_q"][:, 3:], both["joint_q"][:, :3], atol=1e-5)


@BOTH
def test_overflow_is_reported_with_the_setting_to_raise(scene, device, name):
    tight = scene.model_copy(
        update={"engine": scene.engine.model_copy(update={"options": {"njmax": 17, "nconmax": 5}})}
    )
    engine = make_simulator(tight, device, name=name, samples=4, pairs=())
    q, qd = start(scene)
    found = recorded(engine, controls(4), q, qd)
    bits = int(found["overflow"].max())
    assert bits != 0
    message = engine.overflow_message(bits)
    assert "engine.options.nconmax" in message
    assert "engine.options.njmax" in message


@pytest.mark.parametrize(
    ("name", "section", "key", "says"),
    [
        ("mujoco_warp", {"options": {"njmx": 3}}, "engine.options.njmx", "njmax"),
        ("mujoco_warp", {"options": {"cone": "round"}}, "engine.options", "refuses"),
        ("newton", {"options": {"njmx": 3}}, "engine.options.njmx", "njmax"),
        ("newton", {"options": {"cone": "round"}}, "engine.options", "refuses"),
        ("newton", {"friction_combine": "average"}, "engine.friction_combine", "priority"),
        ("newton", {"solver": "xpbd", "options": {"iterations": 2, "njmax": 5}}, "engine.options.njmax", "iterations"),
    ],
)
def test_a_solver_that_does_not_fit_is_refused_with_its_key(scene, name, section, key, says):
    wrong = make_scene(robot=[PUSHER], object=[NEAR_BOX], obstacle=[WALL], engine=section)
    with pytest.raises(SceneError) as error:
        make_simulator(wrong, "cpu", name=name, samples=2)
    assert error.value.key == key
    assert says in str(error.value)


@BOTH
def test_the_controller_brings_the_disc_to_its_goal(device, name):
    planner = {"samples": 24, "horizon": 6, "temperature": {"initial": 0.1}}
    scene = make_scene(robot=[PUSHER], planner=planner, timing={"timeout": 3.0})
    controller = Controller(scene, engine=name, device=device, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene))
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
    assert controller.info.diverged_worlds == 0
    assert controller.device == device


@BOTH
def test_both_engines_plan_the_same_command(scene, device, name):
    scene = scene.model_copy(update={"planner": scene.planner.model_copy(update={"samples": SAMPLES, "horizon": 8})})
    controllers = [
        Controller(scene, engine="mujoco", compiled=compiled(scene), seed=2),
        Controller(scene, engine=name, device=device, compiled=compiled(scene), seed=2),
    ]
    state = State.start(compiled(scene).layout)
    for _ in range(4):
        expected, found = (controller.step(state) for controller in controllers)
        np.testing.assert_allclose(found, expected, atol=5e-3)
        costs = [controller.info.cost for controller in controllers]
        assert costs[1] == pytest.approx(costs[0], rel=1e-3)
        for label, value in controllers[0].info.terms.items():
            assert controllers[1].info.terms[label] == pytest.approx(value, rel=1e-2, abs=1e-3)


@pytest.mark.gpu
@BOTH
def test_goals_weights_and_limits_change_without_a_new_graph(scene, name):
    """What a captured plan reads from device arrays may change between replays."""
    need(CUDA)
    controller = Controller(scene, engine=name, device="cuda:0", compiled=compiled(scene))
    state = State.start(compiled(scene).layout)
    for _ in range(3):
        controller.step(state)
    graph = controller.graph.captured
    assert graph is not None
    cost = controller.info.cost
    controller.reset()
    controller.task["goal"] = np.array([3.0, 0.5, 0, 0, 0, 0, 1.0])
    controller.step(state)
    assert controller.info.cost > 1.5 * cost
    controller.task["distance"] = 0.0
    controller.step(state)
    assert controller.info.cost == 0.0
    controller.set_limits(np.full(3, -0.01), np.full(3, 0.01))
    assert np.abs(controller.step(state)).max() <= 0.01
    assert controller.graph.captured is graph
    assert np.isnan(controller.info.stages_ms["evaluate"])  # one graph: no stages


def test_a_warning_names_the_overflow_once(scene, device, caplog):
    options = {"options": {"njmax": 17, "nconmax": 5}}
    tight = make_scene(robot=[PUSHER], object=[NEAR_BOX], obstacle=[WALL], engine=options)
    controller = Controller(tight, engine="mujoco_warp", device=device, compiled=compiled(tight))
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        for _ in range(3):
            controller.step(State.start(compiled(tight).layout))
    assert sum("nconmax" in record.getMessage() for record in caplog.records) == 1
