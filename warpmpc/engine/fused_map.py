# SPDX-License-Identifier: Apache-2.0
"""Places of a scene's numbers in the physics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..kernels.geometry.kinematics import BALL, FREE
from ..physics.state_map import StateMap, Turn, Watch

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.layout import Layout
    from ..model.mujoco_model import MujocoWorld
    from ..physics.model import PhysicsModel


def state_map(compiled: CompiledScene, world: MujocoWorld, model: PhysicsModel, *, own_start: bool = False) -> StateMap:
    """The map from a scene's numbers to those of its MuJoCo model.

    Args:
        compiled: The scene, compiled.
        world: Its MuJoCo model, with sensors of the contact forces that are watched.
        model: The same as the physics reads it.
        own_start: Whether every world starts in a state of its own.
    """
    layout = compiled.layout
    return StateMap(
        matrix=world.actuator_matrix,
        offset=world.actuator_offset,
        own_start=own_start,
        coordinates=_straight(layout, layout.joint_q_start, world),
        speeds=_straight(layout, layout.joint_qd_start, world, speeds=True),
        turns=[_turn(layout, j, world) for j in _joints(layout, world, turning=True)],
        bodies=[world.model.body(name).id for name in compiled.body_name],
        centres=layout.body_com,
        mocap=world.mocap,
        movable=world.movable,
        activations=world.activation.tolist(),
        watched=watched(model, world),
        pairs=len(world.pair_sensor) - 1,
    )


def _joints(layout: Layout, world: MujocoWorld, *, turning: bool) -> list[int]:
    """Joints of the layout that the model has: free and ball joints, or all others."""
    kinds = layout.joint_type
    return [
        j for j in range(len(kinds)) if world.joint_q[j] >= 0 and (int(kinds[j]) in (int(FREE), int(BALL))) == turning
    ]


def _straight(layout: Layout, first: np.ndarray, world: MujocoWorld, *, speeds: bool = False) -> dict[int, int]:
    """The model's number behind each of the layout's, of slides and hinges."""
    start, out = world.joint_qd if speeds else world.joint_q, {}
    for j in _joints(layout, world, turning=False):
        out |= {int(first[j]) + i: int(start[j]) + i for i in range(int(layout.joint_dof_dim[j].sum()))}
    return out


def _turn(layout: Layout, j: int, world: MujocoWorld) -> Turn:
    return Turn(
        joint=j,
        ball=int(layout.joint_type[j]) == int(BALL),
        q=int(layout.joint_q_start[j]),
        v=int(layout.joint_qd_start[j]),
        model_q=int(world.joint_q[j]),
        model_v=int(world.joint_qd[j]),
        body=int(layout.joint_child[j]),
        parent=layout.joint_pose_parent[j],
        child=layout.joint_pose_child[j],
    )


def watched(model: PhysicsModel, world: MujocoWorld) -> list[Watch]:
    """Pairs of geoms whose forces count towards the watched pairs of entities, by the model's contact sensors."""
    m, out = world.model, []
    first = m.nsensor - int(world.pair_sensor[-1])
    for index, (start, end) in enumerate(zip(world.pair_sensor[:-1], world.pair_sensor[1:], strict=True)):
        for sensor in range(first + start, first + end):
            one = _geoms(m, int(m.sensor_objtype[sensor]), int(m.sensor_objid[sensor]))
            other = _geoms(m, int(m.sensor_reftype[sensor]), int(m.sensor_refid[sensor]))
            for n, pair in enumerate(model.pairs):
                a, b = pair.geoms
                if a in one and b in other:
                    out.append(Watch(n, index, -1.0))
                elif b in one and a in other:
                    out.append(Watch(n, index, 1.0))
    return out


def _geoms(m: mujoco.MjModel, kind: int, index: int) -> set[int]:
    """Geoms of what a contact sensor looks at: a geom, a body, or a body with all that hangs on it."""
    if kind == int(mujoco.mjtObj.mjOBJ_GEOM):
        return {index}
    bodies = {index}
    if kind == int(mujoco.mjtObj.mjOBJ_XBODY):
        for body in range(index + 1, m.nbody):
            if int(m.body_parentid[body]) in bodies:
                bodies.add(body)
    return set(np.flatnonzero(np.isin(m.geom_bodyid, list(bodies))).tolist())
