# SPDX-License-Identifier: Apache-2.0
"""Postures of arms among obstacles, and their spheres in float64."""

import numpy as np
import warp as wp
from arms import arm_scene
from evaluating import Evaluating
from scipy.spatial.transform import Rotation

from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.pairs import moving_bodies
from warpmpc.scene.model.spheres import fit_spheres
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(1, 16, 1, 4)


def evaluating(name: str, cost: dict, seed: int = 0, *, device="cpu", pull: float = 1.0, **sections) -> Evaluating:
    """Postures drawn within limits; with less pull they follow one another more closely."""
    cost = {"weight": 1.0, **cost}
    until = {"conditions": {"term": cost["term"], "below": 0.1}}
    j = Evaluating(arm_scene(name, cost=[cost], success=until, **sections), SHAPE, device=device)
    layout = j.layout
    span = layout.dof_upper - layout.dof_lower
    bounded = (span > 0.0) & (span < 1e6)
    q = np.random.default_rng(seed).uniform(
        np.where(bounded, layout.dof_lower, -1.0),
        np.where(bounded, layout.dof_upper, 1.0),
        (5, SHAPE.worlds, layout.nv),
    )
    place(j, q[:1] + pull * (q - q[:1]))
    return j


def place(j: Evaluating, q: np.ndarray) -> None:
    """Put the rollouts' bodies where joint coordinates [5, W, nq] have them."""
    q = np.broadcast_to(np.asarray(q, dtype=np.float32), (5, SHAPE.worlds, j.layout.nq))
    out, table = j.trajectory, joint_table(j.layout, j.device, worlds=SHAPE.worlds)
    out.joint_q.assign(q)
    inputs = [table, out.joint_q, out.joint_qd]
    wp.launch(forward_kinematics_kernel, q.shape[:2], inputs, [out.body_q, out.body_qd], device=j.device)


def centres(j: Evaluating, spheres) -> np.ndarray:
    """World positions of spheres ``[5, W, n, 3]`` in float64."""
    pose = j.trajectory.body_q.numpy().astype(np.float64)[:, :, spheres.body]
    turned = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).apply(
        np.broadcast_to(spheres.centre.astype(np.float64), pose[..., :3].shape).reshape(-1, 3)
    )
    return turned.reshape(pose[..., :3].shape) + pose[..., :3]


def moving_spheres(j: Evaluating):
    return fit_spheres(j.layout, sorted(moving_bodies(j.layout)))
