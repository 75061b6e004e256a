# SPDX-License-Identifier: Apache-2.0
"""Small scenes for tests, built in Python and compiled once per run."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpmpc import Scene
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.scene.model.compiled import CompiledScene, compile_scene
from warpmpc.scene.model.trajectory import BatchSize
from warpmpc.scene.task.observed import ObservedState
from warpmpc.scene.task.task import task_layout

if TYPE_CHECKING:
    from warpmpc.scene.model.layout import Layout

DISC = {
    "name": "base",
    "asset": "point_robot.urdf",
    "ground_contact": False,
    "frames": {"centre": {"link": "base_link"}, "tip": {"link": "base_link", "offset": (0.2, 0.0, 0.0)}},
    "drive": {"damping": 300.0, "effort_limit": 200.0, "limit": (1.0, 1.0, 1.0)},
}
BOX = {"name": "box", "shape": "box", "size": (0.3, 0.5, 0.2), "mass": 1.0, "position": (0.6, 0.0, 0.1)}
WALL = {"name": "wall", "shape": "box", "size": (0.2, 2.0, 0.4), "position": (1.5, 0.0, 0.2)}


PLAIN = {"iterations": 1, "knots": "steps", "spline": "zero", "discount": 0.95, "refine": None}
PLAIN_NOISE = {"shape": "bspline", "spread": (1.0, 1.0), "constant": 0.0}
BY_ITSELF = {"icem": ("iterations", "shape"), "dial": ("iterations", "shape")}
"""What methods mean by themselves."""


def plain(planner: dict, control_dt: float) -> dict:
    """A planner whose arithmetic fits into a test: one round, a knot for every control, σ as it is said."""
    own = BY_ITSELF.get(planner.get("method"), ())
    out = {key: value for key, value in PLAIN.items() if key not in own} | {"dt": control_dt} | planner
    noise, rounds = planner.get("noise", {}), out.get("iterations", 2) > 1
    form = planner.get("covariance", {}).get("form", "knots" if planner.get("method") == "cem" else "fixed")
    shape = {key: value for key, value in PLAIN_NOISE.items() if key not in own}
    temperature = planner.get("temperature", {})
    steered = {} if temperature.keys() & {"ess", "eta"} else {"eta": (5.0, 10.0)}
    return {
        **out,
        "noise": {**shape, "redraw": rounds or form != "fixed", **noise},
        "temperature": {**steered, **temperature},
    }


def make_scene(**sections) -> Scene:
    """A disc that drives to (1, 0.5); keyword arguments replace whole sections.

    A planner whose ``horizon`` is a number is a :func:`plain` one, but for what is said.
    """
    data = {
        "timing": {"control_dt": 0.04, "timeout": 4.0},
        "robot": [DISC],
        "goal": {"frame": "base/centre", "position": (1.0, 0.5)},
        "cost": [{"term": "distance", "between": ["base/centre", "goal"]}],
        "planner": {"samples": 32, "horizon": 6},
        "success": {"distance": 0.1},
    }
    data |= sections
    planner = data["planner"]
    derived = "refine" in planner or planner.get("method") in ("gradient_descent", "ilqg", "ilqs")
    if isinstance(planner.get("horizon"), int) and not derived:
        data["planner"] = plain(planner, data["timing"].get("control_dt", 0.04))
    return Scene.model_validate(data)


def compiled(scene: Scene) -> CompiledScene:
    """Compile a scene once per run."""
    parts = dict.fromkeys(("robot", "object", "obstacle", "ground"), True)
    bodies = scene.model_dump_json(include={**parts, "engine": {"gravity"}})
    return _compiled(bodies, str(scene.path))


def layout_of(scene: Scene) -> Layout:
    """Layout of a scene, its targets among the frames."""
    return task_layout(compiled(scene).layout, scene)


@functools.cache
def _compiled(bodies: str, path: str) -> CompiledScene:
    scene = make_scene(**json.loads(bodies), goal={"frame": "x/y", "position": (0.0, 0.0)})
    return compile_scene(scene if path == "None" else scene.model_copy(update={"path": Path(path)}))


def observed(q, qd, *, device: str = "cpu") -> ObservedState:
    """Observed states [E, nq] and [E, nv] of scenes without activations and mocap bodies, and an empty task."""
    q, qd = (np.atleast_2d(np.asarray(a, dtype=np.float32)) for a in (q, qd))

    def empty(*shape: int, dtype: type = float) -> wp.array:
        return wp.zeros((len(q), *shape), dtype=dtype, device=device)

    return ObservedState(
        observed=wp.full(len(q), 1, dtype=int, device=device),
        elapsed=empty(),
        start=empty(),
        joint_q=wp.array(q, dtype=float, device=device),
        joint_qd=wp.array(qd, dtype=float, device=device),
        act=empty(0),
        mocap=empty(0, dtype=wp.transform),
        pose=empty(0, dtype=wp.transform),
        scalar=empty(0),
        weight=empty(0),
        proposed=empty(0),
        last_control=empty(0),
        body_q=empty(0, dtype=wp.transform),
        body_qd=empty(0, dtype=wp.spatial_vector),
    )


def make_engine(scene: Scene, *, envs=1, samples=1, domains=1, horizon=5, substeps=2, **options) -> MujocoSimulator:
    """An engine over a small scene."""
    return MujocoSimulator(
        compiled(scene),
        BatchSize(envs, samples, domains, horizon),
        substeps=[substeps] * horizon if isinstance(substeps, int) else substeps,
        timestep=scene.timing.control_dt / (substeps if isinstance(substeps, int) else substeps[0]),
        **options,
    )


def roll(engine: MujocoSimulator, control: np.ndarray, q, qd):
    """Roll controls [T, W, nu] out from states [E, nq], [E, nv]; returns the trajectory."""
    engine.clone(observed(q, qd))
    engine.rollout(wp.array(np.asarray(control, dtype=np.float32), dtype=float, device="cpu"))
    return engine.trajectory


def random_state(layout: Layout, seed: int, *, spread: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Random joint coordinates [nq] with unit quaternions, and velocities [nv]."""
    rng = np.random.default_rng(seed)
    q, qd = spread * rng.normal(size=layout.nq), rng.normal(size=layout.nv)
    for kind, start in zip(layout.joint_type, layout.joint_q_start, strict=True):
        if kind in (2, 4):
            i = start + (3 if kind == 4 else 0)
            q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    return q.astype(np.float32), qd.astype(np.float32)


CHAIN = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="trunk" pos="0.1 0.2 1.5" quat="0.9 0.1 0.3 0.2"><freejoint/>
    <inertial pos="0.15 -0.1 0.2" mass="2" diaginertia="0.02 0.03 0.04"/>
    <geom type="box" size=".1 .1 .1" pos="0.1 0 0"/>
    <body name="head" pos="0.3 0 0.1" quat="0.8 0.2 -0.3 0.1">
      <joint name="neck" type="ball" pos="0.05 -0.02 0.03"/>
      <inertial pos="0.05 0.02 -0.07" mass="0.7" diaginertia="0.01 0.02 0.015"/>
      <geom type="sphere" size=".08"/>
    </body>
    <body name="arm" pos="-0.3 0.1 0" quat="0.7 -0.1 0.2 0.5">
      <joint name="arm_1" axis="0 0 1"/> <joint name="arm_2" axis="0 1 0"/> <joint name="arm_3" axis="1 0 0"/>
      <inertial pos="0.1 0 0.03" mass="0.5" diaginertia="0.01 0.02 0.015"/>
      <geom type="capsule" size=".04 .1"/>
      <body name="hand" pos="0.2 0 0" quat="0.6 0.3 0.1 -0.4">
        <joint name="hand_x" type="slide" axis="1 0 0"/>
        <joint name="hand_1" axis="0 0.6 0.8"/> <joint name="hand_2" axis="1 0 0"/>
        <inertial pos="0 0.06 0.02" mass="0.3" diaginertia="0.01 0.01 0.01"/>
        <geom type="sphere" size=".05"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""
"""An MJCF robot with every kind of joint: free, ball, three hinges on one body, a slide and two hinges on another."""


def chain_scene(folder: Path) -> Scene:
    """A scene of the floating chain, away from where its file puts it."""
    path = folder / "chain.xml"
    path.write_text(CHAIN)
    robot = {
        "name": "chain",
        "asset": str(path),
        "floating": True,
        "position": (0.5, -1.0, 0.4),
        "rotation": (0.1, -0.5, 0.2, 0.8),
        "drive": {"damping": 1.0, "limit": 1.0},
    }
    return make_scene(robot=[robot], ground=None, goal={"frame": "chain/hand", "position": (0.0, 0.0)})
