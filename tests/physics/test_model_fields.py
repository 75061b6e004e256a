# SPDX-License-Identifier: Apache-2.0
"""Every field of a model is read, refused or without effect: by introspection, and by changing it."""

import copy
import operator

import mujoco
import mujoco.rollout
import numpy as np
import pytest

from warpmpc.physics import model_numbers
from warpmpc.physics.model import PhysicsModel
from warpmpc.physics.model_numbers import ModelNumbers
from warpmpc.physics.outputs import write_outputs
from warpmpc.physics.rollout import lacking
from warpmpc.physics.source import RolloutSource

ALL = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.004" iterations="60" tolerance="1e-10" density="1.5" viscosity=".02" wind=".3 .1 0" impratio="2"
    cone="elliptic" magnetic="0 .5 0"/>
  <size memory="4M"/>
  <asset>
    <mesh name="tet" vertex="0 0 0  .2 0 0  0 .2 0  0 0 .2  .1 .1 .15"/>
    <hfield name="hills" nrow="3" ncol="4" size="1 1 .1 .1" elevation="0 1 0 0 1 0 1 0 0 0 1 1"/>
    <texture name="t" type="2d" builtin="flat" width="4" height="4"/><material name="red" texture="t"/>
    <material name="clear" rgba="0 0 0 0"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="wide" pos="0 -2 1" euler="70 0 0" resolution="64 48" fovy="50"/>
    <camera name="lens" pos="0 -2 1" euler="70 0 0" resolution="64 48" focal=".1 .12" sensorsize=".2 .15"/>
    <body pos="0 0 1.5">
      <geom type="sphere" size=".02" rgba="0 0 0 0" contype="0" conaffinity="0"/>
      <geom type="sphere" size=".03" pos=".5 0 0" material="clear" contype="0" conaffinity="0"/>
    </body>
    <site name="beam" pos="0 0 2" euler="180 0 0"/><site name="ray" pos=".5 0 2" euler="180 0 0"/>
    <geom name="floor" type="plane" size="4 4 .1" friction=".6" solref=".03 1.1" solmix=".7"/>
    <geom name="hills" type="hfield" hfield="hills" pos="3 0 .05" rgba="0 0 0 0"/>
    <body name="arm" pos="-.6 0 .4" euler="5 10 0" gravcomp=".3">
      <inertial pos=".02 .01 .03" mass="1.2" diaginertia=".02 .03 .025" euler="10 0 5"/>
      <joint name="slide" type="slide" axis="1 0 .1" pos=".01 0 0" damping="1" stiffness="20" springref=".1"
        range="-.05 .02" frictionloss=".2" armature=".03" actuatorfrcrange="-3 3"/>
      <joint name="turn" axis="0 1 .1" pos=".02 0 .01" damping=".2" stiffness="3" springref=".2" ref=".1" range="-30 20"
        frictionloss=".05" armature=".02" margin=".02" actuatorfrcrange="-1 1" actuatorgravcomp="true"/>
      <geom name="stick" type="capsule" size=".05" fromto="0 0 0 .3 0 0" mass="1"/>
      <site name="root" pos="0 0 .05"/><camera name="eye" pos="0 .1 0" euler="10 0 0"/>
      <body name="fore" pos=".3 0 0" quat="1 .1 .2 .1">
        <joint name="ball" type="ball" damping=".1" stiffness="2" range="0 40" armature=".01"/>
        <geom name="ell" type="ellipsoid" size=".1 .05 .04" pos=".1 0 0" euler="0 5 5" mass=".5" friction=".7 .01 .01"/>
        <site name="end" pos=".2 .01 0" euler="0 30 10"/>
      </body>
    </body>
    <body name="box" pos="0 0 .099">
      <freejoint name="free"/>
      <geom name="box" type="box" size=".1 .08 .1" mass=".7" friction=".5" condim="4" solref=".015 1.2"
        solimp=".8 .96 .01 .4 2" margin=".005" priority="1"/>
      <site name="top" pos="0 0 -.1" size=".125"/>
    </body>
    <body name="tet" pos="0 1 -.002">
      <freejoint/><geom name="tet" type="mesh" mesh="tet" mass=".4" condim="6" solmix="2"/>
    </body>
    <body name="ball" pos="3 0 .22">
      <freejoint/><geom name="rock" size=".1" mass=".3" pos=".01 .01 0" euler="0 3 4"/>
    </body>
    <body name="puck" pos=".5 .5 .049">
      <joint name="px" type="slide" axis="1 0 0"/><joint name="py" type="slide" axis="0 1 0"/>
      <joint name="pz" type="slide" axis="0 0 1"/>
      <geom name="puck" type="cylinder" size=".08 .05" mass=".3"/><geom name="knob" size=".03" pos="0 0 .08"/>
    </body>
    <body name="near" pos=".64 .5 .049">
      <joint name="nx" type="slide" axis="1 0 0"/><geom name="near" type="sphere" size=".06" mass=".2"/>
    </body>
    <body name="hand" mocap="true" pos=".3 0 .12"><geom type="box" size=".05 .2 .05" name="palm"/></body>
  </worldbody>
  <contact>
    <pair geom1="puck" geom2="floor" condim="3" friction=".4 .4 .01 .01 .01" solref=".03 1" solimp=".85 .93 .002 .5 2"
      margin=".003" solreffriction=".05 1.1"/>
    <exclude body1="arm" body2="box"/><exclude body1="fore" body2="box"/>
  </contact>
  <tendon>
    <fixed name="both" range="-.01 .01" frictionloss=".02" stiffness="5" damping=".3" springlength=".05"
      margin=".004" armature=".01" solreflimit=".03 1" solreffriction=".03 1.1">
      <joint joint="slide" coef="1"/><joint joint="turn" coef=".4"/>
    </fixed>
    <fixed name="other"><joint joint="px" coef="1.1"/></fixed>
    <spatial name="cord" range="0 .2" stiffness="30" damping=".4" springlength="0.1" actuatorfrcrange="-.5 .6">
      <site site="root"/><site site="top"/><pulley divisor="2"/><site site="root"/><site site="end"/>
    </spatial>
  </tendon>
  <equality>
    <connect body1="tet" body2="world" anchor=".1 0 .02" solref=".04 1"/>
    <weld body1="fore" body2="hand" relpose="0 0 .3 1 0 0 0" solimp=".3 .5 .01 .5 2" torquescale=".7"/>
    <joint joint1="nx" joint2="py" polycoef=".01 .6 .1 0 0"/>
    <tendon tendon1="other" tendon2="both" polycoef=".02 .5 0 0 0"/>
  </equality>
  <actuator>
    <position name="p" joint="slide" kp="60" kv="5" ctrlrange="-.4 .4" forcerange="-2 2" armature=".02" damping=".4"/>
    <general name="f" joint="turn" dyntype="filter" dynprm=".05" gainprm="2 0 .1" biastype="affine" biasprm=".1 -1 -.1"
      actlimited="true" actrange="-.03 .03" actearly="true"/>
    <general name="s" site="end" gear="0 10 0 0 0 1" dyntype="integrator"/>
    <motor name="b" joint="ball" gear="1 .5 .2"/>
    <motor name="t" tendon="cord" gear="2" group="1"/>
    <damper name="d" joint="px" kv="2" ctrlrange="0 1"/>
    <muscle name="m" joint="turn" lengthrange="-1 1" ctrlrange="0 1" scale=".5"/>
    <motor name="c" cranksite="root" slidersite="top" cranklength="1.5"/>
  </actuator>
  <sensor>
    <clock/><framepos objtype="site" objname="end" cutoff=".35"/><velocimeter site="end"/><gyro site="top"/>
    <framequat objtype="camera" objname="eye"/><framelinvel objtype="geom" objname="ell" reftype="body" refname="arm"/>
    <subtreecom body="arm"/><ballquat joint="ball"/>
    <framepos objtype="camera" objname="eye"/><jointvel joint="turn"/><accelerometer site="end"/>
    <magnetometer site="end"/><camprojection site="end" camera="wide"/><camprojection site="end" camera="lens"/>
    <rangefinder site="beam"/><rangefinder site="ray"/><touch site="top"/>
  </sensor>
  <keyframe><key qpos="0 0 1 0 0 0 0 0 .2 1 0 0 0 0 1 0 1 0 0 0 3 0 .22 1 0 0 0 0 0 0 0" /></keyframe>
</mujoco>
"""
"""A model with everything that rollouts read, in which limits are met and geoms touch."""
OVERRIDE = """
  <option o_margin=".004" o_solref=".03 1.1" o_solimp=".8 .9 .01" o_friction=".5 .5 .1 .1 .1" actuatorgroupdisable="1">
    <flag override="enable"/>
  </option>
  <compiler"""
VARIANT = ALL.replace("<compiler", OVERRIDE).replace('tolerance="1e-10"', 'tolerance="1e-5"')
"""The same with overridden contacts, a group of actuators that is off, and a solver that ends early."""
REFUSED = """
<mujoco>
  <option noslip_iterations="3" cone="elliptic" density="5"/>
  <worldbody>
    <geom name="floor" type="plane" size="4 4 .1" surfacevel=".1 0 0 0 0 0"/>
    <body pos="0 0 .099">
      <freejoint/><geom name="box" type="box" size=".1 .1 .1" fluidshape="ellipsoid"/><site name="s"/>
    </body>
    <body pos="1 0 .099" gravcomp=".5">
      <joint name="h" axis="0 1 0"/>
      <joint name="k" type="slide" pos=".1 0 0" stiffness="1"/>
      <geom size=".1" pos=".1 0 0" adhesion="3"/>
    </body>
    <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="2 0 .02" radius=".01" dim="2" mass="1"/>
  </worldbody>
  <contact><pair geom1="box" geom2="floor" adhesion="1"/></contact>
  <tendon><fixed name="t"><joint joint="h" coef="1"/></fixed></tendon>
  <actuator>
    <motor joint="k"/><motor tendon="t"/><motor joint="h" gear=".1"/>
    <muscle joint="h" lengthrange="-1 1" ctrlrange="0 1" scale=".5"/><motor joint="k" delay=".004" nsample="3"/>
  </actuator>
  <sensor>
    <contact geom1="floor" num="1" data="found"/>
    <framepos objtype="site" objname="s" delay=".004" nsample="3" interval=".004"/>
  </sensor>
</mujoco>
"""
"""A model with fields that are refused."""
UNTRIED = {"opt.sdf_initpoints", "opt.sdf_iterations", "opt.sleep_tolerance", "jnt_springyield", "tendon_springyield"}
"""Refused ones that need a plugin, steps at rest, or springs that yield."""
OF_ANOTHER_MUJOCO = {
    "flex_vertedge", "flex_vertedgeadr", "flex_vertedgenum", "flex_vertmetric", "flexvert_J_colind",
    "flexvert_J_rowadr", "flexvert_J_rownnz", "nJfv", "flex_plasticadr", "flex_plasticmode", "flex_vertcell",
    "flex_yield", "geom_castshadow", "jnt_plasticadr", "jnt_springyield", "key_plastic", "nplastic",
    "tendon_plasticadr", "tendon_springyield", "tendon_type",
}  # fmt: skip
"""Fields of MuJoCo 3.17 or 4 alone."""
WORLDS, STEPS = 24, 4


def make(text):
    """A model whose fields MuJoCo all reads: it skips none that it found to be usual ones."""
    out = mujoco.MjModel.from_xml_string(text)
    for name in ("body_sameframe", "geom_sameframe", "site_sameframe", "body_simple", "dof_simplenum"):
        getattr(out, name)[:] = 0
    return out


def every_field(model):
    """Names of all arrays and numbers."""
    kinds = (np.ndarray, int, float, bytes)
    out = [name for name in dir(model) if not name.startswith("_") and isinstance(getattr(model, name), kinds)]
    parts = (("opt.", model.opt), ("stat.", model.stat))
    return out + [prefix + name for prefix, part in parts for name in dir(part) if not name.startswith("_")]


CHOICES = {
    "opt.cone": 0, "opt.solver": 0, "opt.integrator": 1, "opt.jacobian": 0, "opt.disableactuator": 2,
    "opt.iterations": 2, "opt.ls_iterations": 2, "opt.ls_tolerance": 0.5,
    "opt.enableflags": int(mujoco.mjtEnableBit.mjENBL_OVERRIDE),
    "opt.disableflags": int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
}  # fmt: skip
"""Other values of options that are no quantities."""


def changed(model, name, rng):
    """A copy of a model with other values of a field."""
    out = copy.copy(model)
    owner, own = (getattr(out, name.partition(".")[0]), name.partition(".")[2]) if "." in name else (out, name)
    old = getattr(owner, own)
    new = np.array(CHOICES.get(name, old))
    if own in ("geom_condim", "pair_dim"):
        new = np.where(new == 3, 1, 3)
    elif own.endswith(("priority", "group")):
        new = rng.integers(0, 3, new.shape)
    elif new.dtype == bool or own.endswith(("limited", "active0", "actearly", "actgravcomp", "_active")):
        new = 1 - new
    elif new.dtype.kind in "iu" and name not in CHOICES:
        new = new + 1
    elif new.dtype.kind == "f":
        scale = 1.0 + 0.1 * rng.random(new.shape)
        new = new * scale + (
            0.0 if own.endswith(("gainprm", "biasprm", "tendon_armature")) else 0.01 * rng.random(new.shape)
        )
        if "solimp" in own:
            new[..., 3:] = np.asarray(old)[..., 3:]  # midpoint and power
        if "quat" in own:
            new /= np.maximum(np.linalg.norm(new, axis=-1, keepdims=True), 1e-9)
    setattr(owner, own, new if isinstance(old, np.ndarray) else new.item())
    return out


def starts(model):
    """Random states near the first one ``[W, ...]``, and controls."""
    rng, state = np.random.default_rng(0), np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, mujoco.MjData(model), state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.repeat(state[None], WORLDS, axis=0)
    end = 1 + model.nq + model.nv
    state[:, 1:end] += rng.uniform(-0.05, 0.05, (WORLDS, end - 1))
    state[:, 1 + model.nq : end] += rng.uniform(-0.5, 0.5, (WORLDS, model.nv))
    return state, rng.uniform(-1.0, 1.0, (WORLDS, STEPS, model.nu))


def of_mujoco(model):
    """States and sensor readings that MuJoCo comes to."""
    return np.concatenate(mujoco.rollout.rollout(model, mujoco.MjData(model), *starts(model)), axis=2)


def read(model):
    """All that rollouts take from a model: the source, and numbers beside it."""
    physics = PhysicsModel(model)
    state_map, code = write_outputs(physics)
    return RolloutSource(physics, state_map, 8, False, code).parts().whole(), physics.given.tobytes()


@pytest.fixture(scope="module")
def models():
    return [make(text) for text in (ALL, VARIANT, REFUSED)]


TABLE = (
    model_numbers.READ,
    model_numbers.PLACES,
    model_numbers.FOLLOWS,
    model_numbers.REFUSED,
    model_numbers.WITHOUT_EFFECT,
)


def test_every_field_is_in_the_table_once(models):
    names = every_field(models[0])
    unknown = [name for name in names if sum(name in part for part in TABLE) != 1]
    assert not unknown, f"say in warpmpc/physics/model_numbers.py what rollouts make of {unknown}"
    assert not set().union(*TABLE) - set(names) - OF_ANOTHER_MUJOCO


def quantities(model, part):
    """Fields of a part of the table that a model has and that hold quantities or switches."""
    for name in sorted(set(every_field(model)) & part):
        value = np.asarray(operator.attrgetter(name)(model))
        number = value.dtype.kind in "fb" or name in model_numbers.READ or "." in name
        if value.size and number and not name.startswith(("flex", "n")):
            yield name


def effects(model, part):
    """Fields which, with other values, change MuJoCo's rollouts; each with the model that has these."""
    nominal = of_mujoco(model)
    for name in quantities(model, part):
        other = changed(model, name, np.random.default_rng(0))
        if not np.allclose(of_mujoco(other), nominal, rtol=0.0, atol=1e-9):
            yield name, other


def test_what_is_read_changes_rollouts_and_those_of_mujoco(models):
    seen = {"stat.meaninertia"}  # with the tolerance it says when a solver ends
    for model in models[:2]:
        assert lacking(model) is None
        own, key = read(model), ModelNumbers().of([model])[0]
        for name, other in effects(model, model_numbers.READ - seen):
            assert read(other) != own or lacking(other), name
            assert ModelNumbers().of([other])[0] != key, name
            seen.add(name)
    assert seen == model_numbers.READ


def test_what_is_refused_would_change_rollouts_of_mujoco(models):
    changes = dict(effects(models[0], model_numbers.REFUSED))
    assert all(lacking(other) for other in changes.values())
    keys = {name: ModelNumbers().of([other])[0] for name, other in changes.items()}
    assert len({*keys.values(), ModelNumbers().of([models[0]])[0]}) == len(keys) + 1
    changes = {*changes, *(name for name, _ in effects(models[2], model_numbers.REFUSED))}
    assert changes - UNTRIED == set(quantities(models[2], model_numbers.REFUSED)) - UNTRIED


def test_what_has_no_effect_changes_nothing(models):
    model, rng, nominal = models[0], np.random.default_rng(0), of_mujoco(models[0])
    other = model
    for name in quantities(model, model_numbers.WITHOUT_EFFECT):
        np.testing.assert_allclose(of_mujoco(changed(model, name, rng)), nominal, rtol=0.0, atol=1e-9, err_msg=name)
        other = changed(other, name, rng)
    assert lacking(other) is None
    assert read(other) == read(model)
