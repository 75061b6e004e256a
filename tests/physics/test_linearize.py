# SPDX-License-Identifier: Apache-2.0
"""``warpmpc.physics.linearize`` against ``mujoco.mjd_transitionFD`` in double precision, and what it promises.

Slow ones by hand: pytest -m slow tests/physics/test_linearize.py
"""

import mujoco
import numpy as np
import pytest
from actuator_models import ARM
from fused_models import DYNAMICS, compile_model
from fused_steps import exact
from pages import ROOT, blocks
from shared.models import FULL, arm_with_box, quadruped

from warpmpc.physics import linearize
from warpmpc.physics.linearization import WORLDS
from warpmpc.physics.tangent import Tangent
from warpmpc.physics.version import VERSION

PAGE = "docs/physics.md"
SENSED = """
<mujoco><option timestep="0.004" integrator="INTEGRATOR"/>
  <worldbody>
    <body name="torso" pos="0 0 1" quat=".9 .1 .3 .2"><freejoint/>
      <geom type="box" size=".1 .06 .04" pos=".01 .02 .03" mass="2"/><site name="imu" pos=".05 .01 .02"/>
      <body pos=".1 0 0"><joint name="hip" axis="0 1 .2" damping=".3"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .2 0 .05" mass=".5"/>
        <body name="lower" pos=".2 0 .05"><joint type="ball" damping=".1"/>
          <geom type="sphere" size=".04" pos=".1 0 0" mass=".3"/><site name="end" pos=".1 0 0"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hip" gear="2" ctrllimited="true" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos joint="hip"/><framepos objtype="site" objname="end"/><framezaxis objtype="body" objname="lower"/>
    <velocimeter site="imu"/><gyro site="end"/><subtreecom body="torso"/><accelerometer site="imu"/></sensor>
</mujoco>"""


def sensed(integrator: str = "implicitfast") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SENSED.replace("INTEGRATOR", integrator))


def asset(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROOT / "scenes" / "assets" / f"{name}.xml"))


def drawn(model: mujoco.MjModel, count: int, steps: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States ``[N, nstate]`` that MuJoCo comes to from drawn ones, and the controls ``[N, nu]`` on the way."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    states, controls = np.empty((count, mujoco.mj_stateSize(model, FULL))), np.empty((count, model.nu))
    for state, control in zip(states, controls, strict=True):
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        else:
            mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(0.0, 0.1, model.nv), 1.0)
        data.qvel[:] = rng.normal(0.0, 0.3, model.nv)
        limited = model.actuator_ctrllimited.astype(bool)
        lower, upper = np.where(limited, model.actuator_ctrlrange.T, [[-1.0], [1.0]])
        data.ctrl[:] = np.clip(data.ctrl + rng.uniform(-0.15, 0.15, model.nu) * (upper - lower), lower, upper)
        for _ in range(steps):
            mujoco.mj_step(model, data)
        mujoco.mj_getState(model, data, state, FULL)
        control[:] = data.ctrl
    return (x.astype(np.float32).astype(float) for x in (states, controls))


def theirs(model: mujoco.MjModel, states: np.ndarray, controls: np.ndarray, eps: float = 1e-6) -> list[np.ndarray]:
    """A, B, C and D of MuJoCo, centred, ``[N, ...]`` each."""
    m, n, out = exact(model), 2 * model.nv + model.na, []
    for state, control in zip(states, controls, strict=True):
        data = mujoco.MjData(m)
        mujoco.mj_setState(m, data, state, FULL)
        data.ctrl[:] = control
        mujoco.mj_forward(m, data)
        shapes = (n, n), (n, m.nu), (m.nsensordata, n), (m.nsensordata, m.nu)
        out.append([np.zeros(shape) for shape in shapes])
        mujoco.mjd_transitionFD(m, data, eps, True, *(x if x.size else None for x in out[-1]))
    return [np.array(x) for x in zip(*out, strict=True)]


def apart(ours: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Largest difference of each state ``[N]``, as a share of the largest entry of MuJoCo's."""
    return np.abs(ours - own).max(axis=(1, 2)) / np.abs(own).max(axis=(1, 2))


SMOOTH = {
    "acrobot": lambda: asset("acrobot"),
    "cartpole": lambda: asset("cartpole"),
    "quadrotor": lambda: asset("quadrotor"),
    "quadruped": lambda: asset("quadruped"),
    "free and ball joints": sensed,
    "muscles": lambda: compile_model(ARM),
}
MORE = {
    "pendulum": lambda: asset("pendulum"),
    "push_t": lambda: asset("push_t"),
    "walker": lambda: asset("walker"),
    "euler": lambda: sensed("Euler"),
    "implicit": lambda: sensed("implicit"),
    "trees": lambda: compile_model(DYNAMICS),
}
TOUCHING = {"legs on a floor": quadruped}
MORE_TOUCHING = {
    "arm and box": arm_with_box,
    "humanoid": lambda: asset("humanoid"),
}


def models(some: dict, more: dict) -> list:
    slow = [pytest.param(make, id=name, marks=pytest.mark.slow) for name, make in more.items()]
    return [*(pytest.param(make, id=name) for name, make in some.items()), *slow]


def compare(model: mujoco.MjModel, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far A and B are from MuJoCo's, and where MuJoCo's own hardly depend on the step ``[N]``."""
    x, u = drawn(model, count)
    ours, own, wider = linearize(model, x, u), theirs(model, x, u), theirs(model, x, u, eps=3e-4)
    smooth = (apart(wider[0], own[0]) < 1e-4) & (apart(wider[1], own[1]) < 1e-4)
    return apart(ours.a, own[0]), apart(ours.b, own[1]), smooth


@pytest.mark.parametrize("make", models(SMOOTH, MORE))
def test_smooth_steps_have_mujocos_derivatives(make):
    a, b, smooth = compare(make(), 12)
    # kinks of curves and limits: muscles' medians are 3e-4 (MuJoCo 4.0) and 5e-4 (3.17)
    kinks = 8.0 if make in (SMOOTH["muscles"], MORE["trees"]) else 1.0
    assert smooth.mean() >= 0.5
    assert max(np.median(a[smooth]), np.median(b[smooth])) < 2e-4 * kinks
    assert max(np.percentile(a[smooth], 80), np.percentile(b[smooth], 80)) < 1e-3 * kinks


@pytest.mark.parametrize("make", models(TOUCHING, MORE_TOUCHING))
def test_steps_in_contact_have_mujocos_derivatives_where_these_do_not_depend_on_the_step(make):
    a, b, smooth = compare(make(), 16)
    assert smooth.any()

    assert max(np.median(a[smooth]), np.median(b[smooth])) < 1e-3
    assert max(np.percentile(a, 60), np.percentile(b, 60)) < 2e-2


def test_steps_of_runge_kutta_have_the_differences_of_mujocos_steps():
    model = sensed("RK4")
    (x, u), data, tangent = drawn(model, 2), mujoco.MjData(model), Tangent(model)
    for state, control, a in zip(x, u, linearize(model, x, u).a, strict=True):
        ends = []
        for moved in tangent.add(state[1:], np.concatenate([1e-6 * np.eye(20), -1e-6 * np.eye(20)])):
            mujoco.mj_setState(model, data, np.r_[0.0, moved], FULL)
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
            ends.append(np.r_[data.qpos, data.qvel])
        own = tangent.subtract(np.array(ends[:20]), np.array(ends[20:])).T / 2e-6
        assert np.abs(a - own).max() < 5e-4


def test_sensors_are_differentiated_before_the_step():
    model = sensed()
    x, u = drawn(model, 12)
    ours, (_, _, c, d) = linearize(model, x, u, sensors=True), theirs(model, x, u)
    parts = np.split(np.arange(model.nsensordata), model.sensor_adr[1:])
    for rows in parts:
        error = np.abs(ours.c[:, rows] - c[:, rows]).max(axis=(1, 2))
        assert (error < 1e-3 * np.abs(c[:, rows]).max(axis=(1, 2))).all(), rows
    sign = 1.0 if VERSION >= (4, 0) else -1.0  # centred differences of 3.17 have the wrong one, one-sided ones not
    assert apart(ours.d, sign * d).max() < 1e-4
    assert (linearize(model, x, u).c, linearize(model, x, u).d) == (None, None)


def test_the_same_numbers_give_the_same_bits(monkeypatch):
    """On any number of threads, in launches of any size, whatever was differentiated before."""
    model = sensed()
    x, u = drawn(model, 6)
    once = linearize(model, x, u, sensors=True)
    linearize(model, x + 0.1, u, sensors=True)
    monkeypatch.setitem(WORLDS, "cpu", 250)
    for again in (linearize(model, x, u, sensors=True, threads=2), linearize(model, x, u, sensors=True, threads=1)):
        for one, other in zip(once, again, strict=True):
            np.testing.assert_array_equal(one, other)


def test_leading_sizes_are_those_of_state_and_control():
    model = sensed()
    x, u = drawn(model, 6)
    n, flat = 2 * model.nv, linearize(model, x, u[:1])
    a, b, _, _ = linearize(model, x.reshape(2, 3, -1), u[0])
    assert (a.shape, b.shape) == ((2, 3, n, n), (2, 3, n, 1))
    np.testing.assert_array_equal(a.reshape(6, n, n), flat.a)
    np.testing.assert_array_equal(linearize(model, x[4], u[0]).b, flat.b[4])
    assert linearize(model, x[:0], u[:0]).a.shape == (0, n, n)


def test_steps_can_be_given_and_one_sided():
    model = sensed()
    x, u = drawn(model, 4)
    own = theirs(model, x, u)[0]
    centred, one_sided = (linearize(model, x, u, eps=2e-3, centered=both).a for both in (True, False))
    assert apart(centred, own).max() < 3e-4
    assert 3e-4 < apart(one_sided, own).max() < 1e-2


def test_controls_stay_within_their_limits():
    model = sensed()
    x, _ = drawn(model, 1)
    limits = np.array([[0.5], [1.0], [1.5]])
    ours, own = (f(model, np.repeat(x, 3, axis=0), limits) for f in (linearize, theirs))
    np.testing.assert_allclose(ours.b[:2], own[1][:2], atol=3e-4 * np.abs(own[1]).max())
    assert not ours.b[2].any()
    assert not own[1][2].any()


def test_states_that_are_no_numbers_have_no_derivatives_and_change_no_others():
    model = sensed()
    x, u = drawn(model, 5)
    well = linearize(model, x, u)
    x[2, 3] = np.nan
    ill = linearize(model, x, u)
    assert np.isnan(ill.a[2]).all()
    rest = [0, 1, 3, 4]
    np.testing.assert_array_equal(ill.a[rest], well.a[rest])


def test_what_does_not_fit_or_is_lacking_is_told():
    model = sensed()
    x, u = drawn(model, 3)
    for state, control, said in (
        (x[:, 1:], u, r"state and control have the shapes \(3, 22\) and \(3, 1\), not \[..., 23\] and \[..., 1\]"),
        (x, u[:, :0], r"state and control have the shapes \(3, 23\) and \(3, 0\)"),
        (x, u[:2], "broadcast"),
    ):
        with pytest.raises(ValueError, match=said):
            linearize(model, state, control)
    with pytest.raises(ValueError, match=r"eps is 0\.0, not a positive number"):
        linearize(model, x, u, eps=0.0)
    user = mujoco.MjModel.from_xml_string(
        SENSED.replace("INTEGRATOR", "Euler").replace("<motor", '<general dyntype="user"')
    )
    with pytest.raises(ValueError, match="the physics of warpmpc has no dynamics of actuators: USER"):
        linearize(user, np.zeros((1, 24)), np.zeros((1, 1)))
    text = SENSED.replace("INTEGRATOR", "Euler").replace("<gyro", '<user dim="2"/><gyro')
    with pytest.raises(ValueError, match="has no sensors of the kinds user"):
        linearize(mujoco.MjModel.from_xml_string(text), x, u, sensors=True)


def test_the_example_of_the_page_runs():
    model = sensed()
    (x, _), data, rng = drawn(model, 3), mujoco.MjData(model), np.random.default_rng(0)
    names = {"model": model, "data": data, "initial_state": x, "control": rng.uniform(-1, 1, (3, 7, 1))}
    code = [text for _, text in blocks(PAGE) if "rollout" in text.splitlines()[0] or "linearize" in text]
    for text in code:
        exec(text, names)
    assert [names[name].shape for name in "abcd"] == [(3, 6, 20, 20), (3, 6, 20, 1), (3, 6, 19, 20), (3, 6, 19, 1)]
