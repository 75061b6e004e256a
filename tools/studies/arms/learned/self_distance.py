# SPDX-License-Identifier: Apache-2.0
"""How deep a robot's links are in each other, for many configurations at once: what a network is trained on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpmpc.cost.binding import Binding
from warpmpc.cost.terms import TERMS
from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.errors import SceneError
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.spheres import colliding_bodies, self_fingerprint, self_moving_dofs
from warpmpc.scene.task.task import task_layout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import Scene

CHUNK = 8192
"""Configurations that are looked at together."""


class SelfDistance:
    """The term ``self_collision`` of one robot as a function of its joints, without a margin.

    Args:
        scene: A scene with the robot; where it has a term ``self_collision``, links that this one leaves out or adds
            are left out and added here, too.
        robot: Its name; may be left out where it is the only one.
        joints: Joints that may be anywhere within their limits, all others stay at the start. Those that are driven
            when left out, or all where none is. Those that move no link against another are left out.

    Raises:
        SceneError: If there is no such robot or joint.
    """

    def __init__(self, scene: Scene, robot: str | None = None, joints: Sequence[str] | None = None):
        self.layout = layout = task_layout(compile_scene(scene).layout, scene)
        robots = [entity for entity in layout.entities if entity.kind == "robot"]
        if robot is None and len(robots) > 1:
            raise SceneError("several robots: name one", key="robot", found=[r.name for r in robots])
        self.robot = layout.entity(robots[0].name if robot is None else robot)
        given = next(r for r in scene.robot if r.name == self.robot.name).spheres
        own = next((cost.params for cost in scene.cost if cost.term == "self_collision"), {})
        params = TERMS["self_collision"].bind({**own, "of": self.robot.name}, Binding(scene, layout, key="cost"))
        table = params.spheres
        first, count = table.first.numpy(), table.count.numpy()
        self._body = np.repeat(table.body.numpy(), count)
        self._centre, self._radius = table.centre.numpy(), table.radius.numpy()
        pairs = []
        for a, b in zip(params.first.numpy(), params.second.numpy(), strict=True):
            own, others = (np.arange(first[g], first[g] + count[g]) for g in (a, b))
            pairs += [(i, j) for i in own for j in others]
        if not pairs:
            raise SceneError("no two links of this robot can collide", key="robot", found=self.robot.name)
        self.pairs = np.array(pairs)
        """Spheres that are compared ``[pairs, 2]``."""
        self.dofs = self._inputs(joints, self_moving_dofs(layout, colliding_bodies(layout, self.robot, given)))
        self.names = [layout.dof_name[dof].partition("/")[2] for dof in self.dofs]
        self.fingerprint = self_fingerprint(layout, self.robot, self.dofs, given)
        span = layout.dof_upper[self.dofs] - layout.dof_lower[self.dofs]
        bounded = (span > 0.0) & (span < 1e6)
        self.lower = np.where(bounded, layout.dof_lower[self.dofs], -np.pi)
        self.upper = np.where(bounded, layout.dof_upper[self.dofs], np.pi)

    def _inputs(self, joints: Sequence[str] | None, needed: list[int]) -> list[int]:
        layout = self.layout
        if joints is not None:
            coords = [layout.joint(name, key="joints") for name in joints]
            return [dof for dof in needed if layout.dof_coord[dof] in coords]
        driven = {*layout.actuator_dof.tolist()}
        return [dof for dof in needed if dof in driven] or needed

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Configurations within the limits ``[count, joints]``; a joint without limits turns once."""
        return rng.uniform(self.lower, self.upper, (count, len(self.dofs))).astype(np.float32)

    def inputs(self, q: np.ndarray) -> np.ndarray:
        """What the network sees: sin q, cos q ``[n, 2 joints]``."""
        return np.concatenate([np.sin(q), np.cos(q)], axis=1)

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Deepest penetration of two links, negative where all are apart ``[n]`` [m]."""
        return np.concatenate([self._deepest(q[i : i + CHUNK]) for i in range(0, len(q), CHUNK)])

    def _deepest(self, q: np.ndarray) -> np.ndarray:
        at = self._centres(q)
        d = at[self.pairs[:, 0]] - at[self.pairs[:, 1]]  # [pairs, 3, n]
        apart = np.sqrt(np.einsum("pin,pin->pn", d, d))
        reach = self._radius[self.pairs[:, 0]] + self._radius[self.pairs[:, 1]]
        return (reach[:, None] - apart).max(axis=0)

    def _centres(self, q: np.ndarray) -> np.ndarray:
        """Where the spheres are in the world ``[spheres, 3, n]``."""
        layout = self.layout
        joint_q = np.tile(layout.joint_q, (len(q), 1))
        joint_q[:, layout.dof_coord[self.dofs]] = q
        body_q = wp.zeros((1, len(q), layout.nb), dtype=wp.transform, device="cpu")
        body_qd = wp.zeros(body_q.shape, dtype=wp.spatial_vector, device="cpu")
        inputs = [wp.array(a[None], dtype=float, device="cpu") for a in (joint_q, np.zeros((len(q), layout.nv)))]
        table = joint_table(layout, "cpu", worlds=len(q))
        wp.launch(forward_kinematics_kernel, (1, len(q)), [table, *inputs], [body_q, body_qd], device="cpu")
        pose = body_q.numpy()[0].transpose(1, 2, 0)[self._body]  # [spheres, 7, n]
        u, w = pose[:, 3:6], pose[:, 6:]
        v = np.broadcast_to(self._centre[:, :, None], u.shape)
        return pose[:, :3] + v + 2.0 * np.cross(u, np.cross(u, v, axis=1) + w * v, axis=1)
