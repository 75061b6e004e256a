# SPDX-License-Identifier: Apache-2.0
"""States between Newton and MuJoCo against MuJoCo's own kinematics; controls, recording and divergence."""

import mujoco
import newton
import numpy as np
import pytest
import warp as wp
from small_scenes import BOX, chain_scene, compiled, make_scene, random_state

import warpmpc
from warpmpc import StepView, frame_acceleration, frame_angular_acceleration
from warpmpc.kernels.engine.clone import (
    clone_state_kernel,
    divergence_kernel,
    mujoco_control_kernel,
    mujoco_state_kernel,
    record_mujoco_kernel,
)
from warpmpc.scene.model.builder import build_world
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.mujoco_model import make_world


@pytest.fixture(scope="module", params=["chain", "disc and box", "panda"])
def scene(request, tmp_path_factory):
    if request.param == "chain":
        return chain_scene(tmp_path_factory.mktemp("chain"))
    if request.param == "panda":
        return warpmpc.load_scene("panda_reach")
    return make_scene(object=[{**BOX, "rotation": (0.1, 0.2, 0.3, 0.9)}])


class Conversion:
    """A scene's joints in both conventions."""

    def __init__(self, scene):
        self.layout = compiled(scene).layout
        self.world = make_world(compiled(scene), timestep=0.01)
        self.model = self.world.model
        self.table = joint_table(self.layout, "cpu", mujoco_q=self.world.joint_q, mujoco_qd=self.world.joint_qd)
        self.size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def write(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """MuJoCo states [W, n] of Newton states [W, nq], [W, nv]."""
        inputs = (wp.array(a[None], dtype=float, device="cpu") for a in (q, qd))
        out = wp.array(np.full((len(q), self.size), np.nan), dtype=wp.float64, device="cpu")
        inputs = [self.table, self.model.nq, *inputs, 0]
        wp.launch(mujoco_state_kernel, dim=len(q), inputs=inputs, outputs=[out], device="cpu")
        return out.numpy()

    def record(self, state: np.ndarray, substeps: int) -> tuple[np.ndarray, ...]:
        """Newton coordinates, velocities, poses and twists [T+1, W, ...] of MuJoCo states [W, T·substeps, n]."""
        worlds, steps = len(state), state.shape[1] // substeps
        shape, layout = (steps + 1, worlds), self.layout
        outputs = [wp.zeros((*shape, n), dtype=float, device="cpu") for n in (layout.nq, layout.nv)]
        outputs += [wp.zeros((*shape, layout.nb), dtype=t, device="cpu") for t in (wp.transform, wp.spatial_vector)]
        states = wp.array(state, dtype=wp.float64, device="cpu")
        end = wp.array(substeps * np.arange(1, steps + 1) - 1, dtype=int, device="cpu")
        inputs = [self.table, self.model.nq, end, states, 1, 0, 2]
        wp.launch(record_mujoco_kernel, dim=(2, worlds), inputs=inputs, outputs=outputs, device="cpu")
        return tuple(a.numpy() for a in outputs)


@pytest.fixture(scope="module")
def conversion(scene):
    return Conversion(scene)


def states(layout, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Random states [W, nq], [W, nv]."""
    return tuple(np.stack(a) for a in zip(*(random_state(layout, seed) for seed in range(worlds)), strict=True))


def same_coordinates(a: np.ndarray, b: np.ndarray, layout) -> None:
    """Assert coordinates [W, nq] equal, quaternions up to their sign."""
    b = b.copy()
    for kind, start in zip(layout.joint_type, layout.joint_q_start, strict=True):
        if kind in (2, 4):
            part = slice(start + (3 if kind == 4 else 0), start + (7 if kind == 4 else 4))
            b[:, part] *= np.sign((a[:, part] * b[:, part]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(a, b, atol=2e-6)


def test_bodies_stand_and_move_in_mujoco_as_in_newton(scene, conversion):
    q, qd = states(conversion.layout, 5)
    rows = conversion.write(q, qd)
    newton_model = build_world(scene).builder.finalize(device="cpu")
    state = newton_model.state()
    data = mujoco.MjData(conversion.model)
    bodies = [conversion.model.body(name).id for name in compiled(scene).body_name]
    for w in range(5):
        mujoco.mj_setState(conversion.model, data, rows[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(conversion.model, data)
        newton.eval_fk(newton_model, *(wp.array(a[w], dtype=float, device="cpu") for a in (q, qd)), state)
        pose, twist = state.body_q.numpy(), state.body_qd.numpy()
        for i, body in enumerate(bodies):
            np.testing.assert_allclose(data.xpos[body], pose[i, :3], atol=2e-5)
            turn = data.xquat[body][[1, 2, 3, 0]]
            np.testing.assert_allclose(turn * np.sign(turn @ pose[i, 3:]), pose[i, 3:], atol=2e-5)
            velocity = np.zeros(6)  # angular, linear, of the centre of mass in world axes
            mujoco.mj_objectVelocity(conversion.model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            np.testing.assert_allclose(velocity[3:], twist[i, :3], atol=1e-4)
            np.testing.assert_allclose(velocity[:3], twist[i, 3:], atol=1e-4)


@wp.kernel
def acceleration_kernel(
    # inputs
    view: StepView,
    # outputs
    linear: wp.array2d[wp.vec3],
    angular: wp.array2d[wp.vec3],
):
    """Accelerations of one frame in one world."""
    w, f = wp.tid()
    s = view
    s.t = 1
    s.w = w
    linear[w, f] = frame_acceleration(s, f)
    angular[w, f] = frame_angular_acceleration(s, f)


def accelerations(scene, poses: np.ndarray, twists: np.ndarray, frames: np.ndarray, dt: float) -> list[np.ndarray]:
    """Linear and angular accelerations ``[W, nb, 3]`` of a frame ``[nb, 7]`` in every body, from two slices."""
    layout, view = compiled(scene).layout, StepView()
    view.body_q = wp.array(poses, dtype=wp.transform, device="cpu")
    view.body_qd = wp.array(twists, dtype=wp.spatial_vector, device="cpu")
    view.body_com = wp.array(layout.body_com, dtype=wp.vec3, device="cpu")
    view.frame_body = wp.array(range(layout.nb), dtype=int, device="cpu")
    view.frame_pose = wp.array(frames, dtype=wp.transform, device="cpu")
    view.step_end = wp.array([0.0, dt], dtype=float, device="cpu")
    out = [wp.zeros(poses.shape[1:3], dtype=wp.vec3, device="cpu") for _ in range(2)]
    wp.launch(acceleration_kernel, dim=out[0].shape, inputs=[view], outputs=out, device="cpu")
    return [array.numpy() for array in out]


@pytest.mark.parametrize("seed", range(3))
def test_frames_accelerate_over_a_short_step_as_mujoco_says_of_its_middle(scene, conversion, seed):
    """To second order of the step, free, ball, hinge and slide joints alike."""
    model, dt, worlds = conversion.model, 0.01, 4
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    rows = conversion.write(*states(conversion.layout, worlds + seed))[seed:]
    frames = np.hstack(
        [rng.normal(scale=0.3, size=(conversion.layout.nb, 3)), np.tile([0, 0, 0, 1.0], (conversion.layout.nb, 1))]
    )
    ends, expected = [], np.zeros((2, worlds, conversion.layout.nb, 3))
    for w in range(worlds):
        mujoco.mj_setState(model, data, rows[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(model, data)
        qpos, qvel = data.qpos.copy(), data.qvel.copy()
        data.qacc[:] = rng.normal(scale=3.0, size=model.nv)
        qacc = data.qacc.copy()
        mujoco.mj_rnePostConstraint(model, data)
        for i, name in enumerate(compiled(scene).body_name):
            body, found = model.body(name).id, np.zeros((2, 6))
            kind = mujoco.mjtObj.mjOBJ_XBODY
            mujoco.mj_objectVelocity(model, data, kind, body, found[0], 0)
            mujoco.mj_objectAcceleration(model, data, kind, body, found[1], 0)
            omega, (alpha, linear) = found[0, :3], found[1].reshape(2, 3)
            arm = data.xmat[body].reshape(3, 3) @ frames[i, :3]
            if found[1].any():  # static bodies have zeros, all others what an accelerometer shows
                linear = linear + model.opt.gravity
            linear = linear + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
            expected[:, w, i] = linear, alpha
        for half in (-0.5 * dt, 0.5 * dt):
            data.qpos[:], data.qvel[:] = qpos, qvel + half * qacc
            mujoco.mj_integratePos(model, data.qpos, qvel + 0.5 * half * qacc, half)
            row = np.zeros(conversion.size)
            mujoco.mj_getState(model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            ends.append(row)
    _, _, poses, twists = conversion.record(np.array(ends).reshape(worlds, 2, -1), 1)
    found = accelerations(scene, poses[1:], twists[1:], frames, dt)
    np.testing.assert_allclose(found, expected, atol=3e-4 * np.abs(expected).max())


def test_states_survive_the_way_to_mujoco_and_back(conversion):
    q, qd = states(conversion.layout, 5)
    rows = conversion.write(q, qd)
    assert np.all(rows[:, 0] == 0.0)
    back_q, back_qd, *_ = conversion.record(rows[:, None], 1)
    same_coordinates(back_q[1], q, conversion.layout)
    np.testing.assert_allclose(back_qd[1], qd, atol=1e-5)


def test_the_last_physics_step_of_every_control_is_recorded(conversion):
    q, qd = states(conversion.layout, 6)
    rows = conversion.write(q, qd)
    state = np.stack([rows, rows[::-1]])  # two worlds of six physics steps
    recorded, velocity, pose, _ = conversion.record(state, 3)
    for w in range(2):
        for t in range(2):
            i = 3 * t + 2 if w == 0 else 3 - 3 * t
            same_coordinates(recorded[t + 1, w][None], q[i][None], conversion.layout)
            np.testing.assert_allclose(velocity[t + 1, w], qd[i], atol=1e-5)
    assert np.all(recorded[0] == 0.0)  # slice 0 is the observed state: not the recorder's
    assert np.all(np.linalg.norm(pose[1:, ..., 3:], axis=-1) > 0.99)


def test_every_world_of_an_environment_starts_in_its_observed_state(conversion):
    layout = conversion.layout
    q, qd = states(layout, 2)
    rollouts, steps = 3, 2
    outputs = [wp.zeros((steps, 6, n), dtype=float, device="cpu") for n in (layout.nq, layout.nv)]
    outputs += [wp.zeros((steps, 6, layout.nb), dtype=t, device="cpu") for t in (wp.transform, wp.spatial_vector)]
    observed = [wp.array(a, dtype=float, device="cpu") for a in (q, qd)]
    inputs = [conversion.table, *observed, rollouts, 0]
    wp.launch(clone_state_kernel, dim=6, inputs=inputs, outputs=outputs, device="cpu")
    for out, expected in zip(outputs, (q, qd), strict=False):
        np.testing.assert_array_equal(out.numpy()[0], np.repeat(expected, rollouts, axis=0))
        assert np.all(out.numpy()[1] == 0.0)
    _, _, pose, twist = conversion.record(conversion.write(np.repeat(q, 3, 0), np.repeat(qd, 3, 0))[:, None], 1)
    np.testing.assert_allclose(outputs[2].numpy()[0, :, :, :3], pose[1, :, :, :3], atol=2e-5)
    np.testing.assert_allclose(outputs[3].numpy()[0], twist[1], atol=2e-4)


@pytest.mark.parametrize("seed", range(2))
def test_controls_are_mapped_and_held(seed, device):
    rng = np.random.default_rng(seed)
    steps, worlds, substeps, nu, na = 3, 4, 2, 2, 3
    control = rng.normal(size=(steps, worlds, nu)).astype(np.float32)
    matrix, offset = (rng.normal(size=s).astype(np.float32) for s in ((na, nu), na))
    out = wp.zeros((worlds, steps * substeps, na), dtype=wp.float64, device=device)
    arrays = [wp.array(a, dtype=float, device=device) for a in (control, matrix, offset)]
    matrix[0, 1] = matrix[2, 0] = 0.0
    arrays[1].assign(matrix)
    span = wp.array([(0, 1), (0, 2), (1, 2)], dtype=int, device=device)
    step = np.repeat(np.arange(steps), substeps)
    inputs = [*arrays, span, wp.array(step, dtype=int, device=device), 0]
    wp.launch(mujoco_control_kernel, dim=worlds, inputs=inputs, outputs=[out], device=device)
    expected = np.einsum("ai,twi->wta", matrix.astype(np.float64), control) + offset
    np.testing.assert_allclose(out.numpy(), np.repeat(expected, substeps, axis=1), atol=1e-6)


def test_a_world_that_stopped_early_or_is_not_finite_has_diverged(device):
    state = np.ones((6, 4, 5))
    duration = 0.2
    state[:, -1, 0] = duration
    state[1, -1, 0] = duration - 0.05  # MuJoCo stopped and repeated its last state
    state[2, -1, 0] = np.nan
    state[3, -1, 4] = np.inf
    state[4, -1, 2] = np.nan
    state[5, -1, 0] = duration * (1.0 + 1e-9)  # a sum of many steps
    diverged = wp.full(6, 7, dtype=int, device=device)
    inputs = [wp.array(state, dtype=wp.float64, device=device), wp.float64(duration), 0]
    wp.launch(divergence_kernel, dim=6, inputs=inputs, outputs=[diverged], device=device)
    assert diverged.numpy().tolist() == [0, 1, 1, 1, 1, 0]
