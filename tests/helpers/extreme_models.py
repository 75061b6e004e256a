# SPDX-License-Identifier: Apache-2.0
"""Models of extreme masses, levers, friction, softness and iterations, and how far apart both roll them out."""

import copy
from dataclasses import dataclass

import mujoco
import mujoco.rollout
import numpy as np
from hypothesis import strategies as st

from warpmpc.physics import rollout

WORLDS, STEPS, NUDGE = 16, 50, 6e-8
CALM = 1e-3
"""Own differences of MuJoCo from which on two rollouts may go apart [m, rad]."""


def start(model: mujoco.MjModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States ``[W, 1+nq+nv]`` about the model's own, and controls ``[W, T, nu]``, as single precision holds them."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    state = np.repeat(np.concatenate([[0.0], data.qpos, data.qvel, data.act])[None], WORLDS, axis=0)
    state[:, 1 + model.nq : 1 + model.nq + model.nv] += 0.05 * rng.standard_normal((WORLDS, model.nv))
    control = rng.uniform(-1.0, 1.0, (WORLDS, STEPS, model.nu))
    return state.astype(np.float32).astype(float), control.astype(np.float32).astype(float)


@dataclass
class Apart:
    """Largest differences of coordinates of all worlds, step by step ``[T]``."""

    ours: np.ndarray
    """From MuJoCo."""
    nudged: np.ndarray
    """MuJoCo from itself, after a start that is off by a rounding."""
    exact: np.ndarray
    """MuJoCo from itself, when its solver goes on to the minimum."""

    @property
    def worst(self) -> float:
        """Difference beyond what MuJoCo itself makes of rounding and of its tolerance, as long as it is calm."""
        own = np.maximum.accumulate(np.maximum(self.nudged, self.exact))
        return float(np.where(own < CALM, self.ours - 3.0 * own, 0.0).max()) if np.isfinite(self.ours).all() else np.inf


def apart(model: mujoco.MjModel, seed: int = 0) -> Apart:
    """Roll out a model with both.

    Args:
        model: The model.
        seed: Of starts and controls.
    """
    state, control = start(model, seed)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    exact = copy.copy(model)
    if model.opt.iterations >= 20:
        exact.opt.tolerance, exact.opt.iterations = 0.0, 300
        exact.opt.ls_tolerance, exact.opt.ls_iterations = 1e-10, 200
    near = state.copy()
    near[:, 1:] *= 1.0 + NUDGE * rng.choice([-1.0, 1.0], near[:, 1:].shape)
    with mujoco.rollout.Rollout(nthread=0) as pool:
        first, nudged, minimum = (
            pool.rollout(m, [data], s, control)[0] for m, s in ((model, state), (model, near), (exact, state))
        )
    with rollout.Rollout(nthread=0, fall_back=False) as pool:
        ours = pool.rollout(model, [data], state, control)[0]
    gaps = (np.abs(x - first)[:, :, 1 : 1 + model.nq].max(axis=(0, 2)) for x in (ours, nudged, minimum))
    return Apart(*(np.nan_to_num(gap, nan=np.inf) for gap in gaps))


def numbers(least: float, most: float) -> st.SearchStrategy[float]:
    """Numbers whose logarithms are even between two."""
    return st.floats(np.log10(least), np.log10(most)).map(lambda x: float(f"{10.0**x:.3g}"))


SOFTNESS = st.sampled_from(
    [
        'solref=".02 1"',
        'solref=".004 .7"',
        'solref="-2000 -40"',
        'solref="-100 1"',
        'solref="0 1"',
        'solref=".02 0"',
        'solref=".01 2" solimp=".5 .99 0"',
        'solimp=".9 .9 .01"',
        'solimp="0 1 .002 .5 1"',
        'solimp=".99 .9999 .001 .2 3"',
        'solimp=".2 .5 1e-20"',
    ]
)


@st.composite
def options(draw: st.DrawFn) -> str:
    """Time step, cones, ratio of impedances and iterations."""
    cone, ratio = draw(st.sampled_from(["pyramidal", "elliptic"])), draw(st.sampled_from([0.5, 1, 1, 10, 100]))
    iterations = draw(st.sampled_from(ITERATIONS))
    searches = draw(st.sampled_from([4, 8, 50]))
    step = draw(st.sampled_from([0.002, 0.004]))
    integrator = draw(st.sampled_from(["Euler", "implicitfast"]))
    return (
        f'<option timestep="{step}" cone="{cone}" impratio="{ratio}" iterations="{iterations}" '
        f'ls_iterations="{searches}" integrator="{integrator}"/>'
    )


ITERATIONS = [100]


@st.composite
def wheels(draw: st.DrawFn) -> str:
    """Wheels, knobs and turntables: a hinge through the centre of mass or a little off it, in touch with something."""
    mass, armature = draw(numbers(1e-3, 1e3)), draw(st.sampled_from([0.0, 0.0, 1e-4, 1e-2]))
    off = draw(st.sampled_from([0.0, 0.0, 1e-3, 1e-2]))
    friction, soft = draw(st.one_of(st.just(0.0), numbers(1e-4, 2.0))), draw(SOFTNESS)
    axis, shape = draw(st.sampled_from([
        ("0 1 0", 'type="sphere" size=".1"'),
        ("0 0 1", 'type="cylinder" size=".12 .1"'),
        ("0 1 0", 'type="cylinder" size=".1 .04" euler="90 0 0"'),
        ("0 1 0", 'type="ellipsoid" size=".1 .1 .1"'),
    ]))  # fmt: skip
    kind = draw(st.sampled_from(["hinge", "ball"]))
    turn = f'type="hinge" axis="{axis}"' if kind == "hinge" else 'type="ball"'
    dims = draw(st.sampled_from([1, 3, 3, 4]))
    damping = draw(st.sampled_from([0.0, 0.01])) * mass
    motor = f'<motor joint="turn" gear="{0.05 * mass}" ctrlrange="-1 1"/>' if kind == "hinge" else ""
    return f"""<mujoco>{draw(options())}<worldbody>
      <geom type="plane" size="2 2 .1" friction="{friction:.3g} .005 .0001" {soft}/>
      <body pos="0 0 .0995"><joint name="turn" {turn} armature="{armature * mass}" damping="{damping}"/>
        <geom pos="{off} 0 0" {shape} mass="{mass}" condim="{dims}" friction="{friction:.3g} .005 .0001" {soft}/></body>
      </worldbody><actuator>{motor}</actuator></mujoco>"""


@st.composite
def sliders(draw: st.DrawFn) -> str:
    """Boxes that fall and slide, on ice or rubber, and one of another mass on top."""
    friction, soft = draw(st.sampled_from([0.0, 1e-3, 3e-3, 0.1, 0.6, 2.0])), draw(SOFTNESS)
    mass, above = draw(numbers(1e-3, 1e3)), draw(st.sampled_from([None, 0.1, 10.0]))
    dims = draw(st.sampled_from([1, 3, 3, 4, 6]))
    same = f'friction="{friction} .005 .0001" {soft} condim="{dims}"'
    second = f"""<body pos=".01 0 .22"><freejoint/>
      <geom type="box" size=".05 .05 .04" mass="{mass * (above or 0.0)}" {same}/></body>"""
    return f"""<mujoco>{draw(options())}<worldbody><geom type="plane" size="3 3 .1" {same}/>
      <body pos="0 0 .1" euler="3 5 0"><freejoint/><geom type="box" size=".1 .08 .06" mass="{mass}" {same}/></body>
      {second if above else ""}</worldbody></mujoco>"""


@st.composite
def cranks(draw: st.DrawFn) -> str:
    """A balanced crank whose rod pushes a piston within limits, closed by a connect."""
    mass, armature = draw(numbers(1e-3, 1e3)), draw(st.sampled_from([0.0, 1e-5, 1e-2]))
    rod, soft = draw(st.sampled_from([0.01, 0.1, 1.0])), draw(SOFTNESS)
    limit = soft.replace("solref", "solreflimit").replace("solimp", "solimplimit")
    loss = draw(st.sampled_from([0.0, 0.1])) * mass
    return f"""<mujoco><default><geom contype="0" conaffinity="0"/></default>{draw(options())}<worldbody>
      <body pos="0 0 .3"><joint name="crank" axis="0 1 0" armature="{armature * mass}" frictionloss="{loss}"/>
        <geom type="cylinder" size=".1 .02" euler="90 0 0" mass="{mass}"/>
        <body name="rod" pos=".08 0 0"><joint axis="0 1 0"/>
          <geom type="capsule" size=".01" fromto="0 0 0 .3 0 0" mass="{mass * rod}"/></body></body>
      <body name="piston" pos=".38 0 .3"><joint type="slide" axis="1 0 0" range="-.05 .3" limited="true" {limit}/>
        <geom size=".02" mass="{mass}"/></body></worldbody>
      <equality><connect body1="piston" body2="rod" anchor="0 0 0" {soft}/></equality>
      <actuator><motor joint="crank" gear="{0.1 * mass}" ctrlrange="-1 1"/></actuator></mujoco>"""


MODELS = st.one_of(wheels(), sliders(), cranks())
