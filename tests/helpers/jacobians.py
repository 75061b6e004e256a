# SPDX-License-Identifier: Apache-2.0
"""Jacobians of robots' frames in float64, by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
from small_scenes import compiled

from warpmpc import Scene


def mujoco_jacobians(scene: Scene, frame: str, q: np.ndarray) -> np.ndarray:
    """Jacobians [T, W, 6, nv] of a frame's origin, linear before angular, at joint coordinates [T, W, nq].

    For robots whose joints all slide or turn about one axis each.
    """
    whole = compiled(scene)
    layout, model = whole.layout, whole.spec().compile()
    data = mujoco.MjData(model)
    number = layout.frame(frame)
    body = model.body(whole.body_name[layout.frame_body[number]]).id
    joints = [
        model.joint(name) if name and layout.dof_coord[i] >= 0 else None for i, name in enumerate(whole.joint_name)
    ]
    out = np.zeros((*q.shape[:2], 6, layout.nv))
    point, turn = np.zeros((2, 3, model.nv))
    for at in np.ndindex(q.shape[:2]):
        for dof, joint in enumerate(joints):
            data.qpos[joint.qposadr[0]] = q[(*at, layout.dof_coord[dof])]
        mujoco.mj_forward(model, data)
        place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ layout.frame_pose[number][:3]
        mujoco.mj_jac(model, data, point, turn, place, body)
        out[at] = np.concatenate([point, turn])[:, [joint.dofadr[0] for joint in joints]]
    return out
