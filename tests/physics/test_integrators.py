# SPDX-License-Identifier: Apache-2.0
"""Each integrator against MuJoCo C: single steps from states that it visits, and short rollouts.

The model has contacts, limits, tendons, a free body, forces that depend on velocity, and activations of every kind.

Slow ones by hand: pytest -m slow tests/physics/test_integrators.py
"""

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from fused_models import controls, starts
from fused_steps import public_differences, turned, visit

from warpmpc.physics import rollout

ARM = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}" iterations="100" tolerance="1e-10" {more}/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <body pos="0 0 .5">
      <joint name="a" axis="0 1 0" damping=".2" armature=".01" range="-60 60"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
      <site name="a" pos=".15 0 .05"/>
      <body pos=".3 0 0">
        <joint name="b" type="ball" damping=".05" armature=".01"/>
        <geom type="capsule" fromto="0 0 0 .25 .05 0" size=".03"/>
        <body pos=".25 .05 0">
          <joint name="c" axis="1 0 0" damping=".02" armature=".01" stiffness="1"/>
          <joint name="d" type="slide" axis="0 0 1" damping="2" armature=".02" range="-.1 .1" frictionloss=".2"/>
          <geom type="box" size=".1 .05 .04"/>
        </body>
      </body>
      <body pos="0 .2 0">
        <joint name="e" axis="1 1 0" damping=".1" armature=".02"/>
        <joint name="n" axis="0 0 1" armature=".02" range="-3 3" margin=".1" damping=".05 .05 .03" stiffness="1 -4 9"/>
        <geom type="capsule" fromto="0 0 0 0 .3 0" size=".03"/>
        <site name="e" pos="0 .2 .05"/>
      </body>
    </body>
    <body pos="-.3 0 .12" euler="20 10 0">
      <joint type="free" damping=".1 .05 .02"/>
      <geom type="box" size=".15 .1 .05"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="s" stiffness="20" damping=".8" springlength=".1"><site site="a"/><site site="e"/></spatial>
    <fixed name="g" range="-.03 .03" margin=".05"><joint joint="e" coef=".5"/><joint joint="n" coef=".4"/></fixed>
    <fixed name="f" damping=".1 .2 0" stiffness="2 0 5" springlength="-.1 .1">
      <joint joint="a" coef=".5"/><joint joint="c" coef="-1"/>
    </fixed>
  </tendon>
  <actuator>
    <motor joint="a" gear="4" damping=".01 .02 0"/>
    <position joint="c" kp="3" kv=".3"/>
    <general tendon="s" dyntype="filter" dynprm=".03" gainprm="5" biastype="affine" biasprm="0 -5 -1"/>
    <general joint="d" dyntype="filterexact" dynprm=".02" actrange="-.2 .3" actlimited="true" gainprm="20"/>
    <intvelocity joint="e" kp="6" kv=".2" actrange="-.05 .05"/>
    <general tendon="f" dyntype="filterexact" dynprm=".05" actearly="true" gaintype="affine" gainprm="1 0 -.3"/>
  </actuator>
</mujoco>
"""
FLUID = 'density="80" viscosity=".4" wind="1 .2 0"'


@pytest.mark.parametrize(
    ("integrator", "more"),
    [
        ("Euler", ""),
        ("implicitfast", ""),
        pytest.param("implicit", "", marks=pytest.mark.slow),
        ("RK4", FLUID),
        pytest.param("implicitfast", FLUID, marks=pytest.mark.slow),
        ("implicit", FLUID),
    ],
    ids=lambda text: "fluid" if text == FLUID else text,
)
def test_steps_and_rollouts_are_those_of_mujoco(integrator, more):
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator=integrator, more=more))
    worlds, steps = 8, 50
    q, v = starts(model, worlds, seed=1, speed=3.0)
    control = controls(model, steps, worlds, seed=2)
    states = visit([model], q, v, control, every=2)
    found = public_differences(model, states)
    assert (states.rows > 0).mean() > 0.5
    steady = states.edge < 1e-4
    assert steady.mean() > 0.9, found
    most = found.v.max(axis=1)[steady]
    assert np.median(most) <= 5e-6, found
    assert np.percentile(most, 99) <= 1e-4, found

    start = np.hstack([np.zeros((worlds, 1)), q, v, 0.1 * np.ones((worlds, model.na))])
    both = []
    for pool in (rollout.Rollout(fall_back=False), mujoco.rollout.Rollout()):
        with pool:
            both.append(pool.rollout(model, mujoco.MjData(model), start, control.swapaxes(0, 1))[0])
    own, reference = (x[:, -1, 1 : 1 + model.nq] for x in both)
    apart = turned(model, own, reference)
    assert np.median(apart) <= 1e-4, apart
    np.testing.assert_allclose(both[0][..., 0], both[1][..., 0], rtol=1e-6)
    np.testing.assert_allclose(both[0][..., -model.na :], both[1][..., -model.na :], atol=2e-4)


BOUNDED = """
<mujoco>
  <option integrator="{integrator}" timestep=".004"/>
  <worldbody>
    <body gravcomp="1">
      <joint name="a" axis="0 1 0" actuatorfrcrange="-4 4" actuatorgravcomp="true"/>
      <geom type="capsule" size=".04" fromto="0 0 0 .4 0 .1"/>
      <body pos=".4 0 .1"><joint name="b" axis="0 0 1"/><geom type="capsule" size=".03" fromto="0 0 0 .3 .1 0"/></body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="t" actuatorfrcrange="-4 4"><joint joint="a" coef=".7"/><joint joint="b" coef="-1.2"/></fixed>
  </tendon>
  <actuator>
    <position joint="a" kp="30" kv="3"/> <velocity joint="a" kv="1"/>
    <position tendon="t" kp="30" kv="3"/> <velocity tendon="t" kv="1"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("integrator", ["implicitfast", "implicit"])
def test_actuators_whose_sum_is_bounded_damp_as_in_the_installed_mujoco(integrator):
    model = mujoco.MjModel.from_xml_string(BOUNDED.format(integrator=integrator))
    rng, worlds = np.random.default_rng(0), 64
    start = np.hstack([np.zeros((worlds, 1)), rng.uniform(-1, 1, (worlds, 2)), rng.uniform(-3, 3, (worlds, 2))])
    control = rng.uniform(-1, 1, (worlds, 1, model.nu))
    with rollout.Rollout(fall_back=False) as pool:
        found, _ = pool.rollout(model, mujoco.MjData(model), start, control)
    expected, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), start, control)
    np.testing.assert_allclose(found, expected, atol=2e-6)
