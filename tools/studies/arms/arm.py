# SPDX-License-Identifier: Apache-2.0
"""An arm as MuJoCo sees it, its links solid to each other: what touches, where its tool is, postures for a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from warpmpc import CompiledScene, Scene

ARM = 16
"""Bit of contact of the links, which scenes leave free."""
ALWAYS = 0.9
"""Links that overlap in more of the postures than this do so by their shapes' making."""


class Arm:
    """The arm of a scene, apart from plant and planner, and without any of the planner's cost terms.

    Links that one joint connects, or that overlap in nearly every posture, do not touch; all others do.

    Args:
        scene: The scene; its goal names the tool's frame.
        compiled: The scene, compiled.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene):
        layout = compiled.layout
        frame = layout.frame(scene.goal.target)
        self.tool_body, self._offset = compiled.body_name[layout.frame_body[frame]], layout.frame_pose[frame]
        self.dofs = np.array(sorted(set(layout.actuator_dof)))
        """Driven joints, the first of the model."""
        self.start = layout.joint_q.astype(float)
        self.lower, self.upper = (a[self.dofs].astype(float) for a in (layout.dof_lower, layout.dof_upper))
        self.speed = layout.dof_speed[self.dofs].astype(float)
        self.model = _solid(compiled, layout.entity(scene.robot[0].name, key="robot").bodies)
        self.data = mujoco.MjData(self.model)
        self._jacobian = np.zeros((6, self.model.nv))
        self._leave_out_what_always_overlaps()

    def _leave_out_what_always_overlaps(self) -> None:
        rng, counts = np.random.default_rng(0), {}
        for _ in range(200):
            for pair in self.touching(rng.uniform(self.lower, self.upper)):
                counts[pair] = counts.get(pair, 0) + 1
        self._ignored = {pair for pair, count in counts.items() if count > ALWAYS * 200}
        if wrong := self.touching(self.start[self.dofs]):
            raise ValueError(f"the arm's start touches: {sorted(wrong)}")

    def place(self, q: np.ndarray) -> None:
        """Put the driven joints ``[n]`` somewhere."""
        self.data.qpos[:] = self.start
        self.data.qpos[self.dofs] = q
        mujoco.mj_kinematics(self.model, self.data)

    def tool(self, q: np.ndarray) -> np.ndarray:
        """Pose of the tool ``[7]``, (x, y, z, qx, qy, qz, qw)."""
        self.place(q)
        body = self.data.body(self.tool_body)
        turn = Rotation.from_quat(body.xquat[[1, 2, 3, 0]])
        position = body.xpos + turn.apply(self._offset[:3])
        return np.concatenate([position, (turn * Rotation.from_quat(self._offset[3:])).as_quat()])

    def touching(self, q: np.ndarray, *, margin: float = 0.0) -> set[tuple[str, str]]:
        """Names of the bodies that overlap, or are closer than a margin [m], pair by pair."""
        self.place(q)
        self.model.geom_margin[:] = 0.5 * margin
        mujoco.mj_collision(self.model, self.data)
        bodies = self.model.geom_bodyid
        pairs = {
            tuple(sorted(self.model.body(bodies[geom]).name or "world" for geom in contact.geom))
            for contact in self.data.contact[: self.data.ncon]
            if contact.dist < margin
        }
        return pairs - getattr(self, "_ignored", set())

    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of geoms that can touch, a link's first."""
        model, geoms = self.model, range(self.model.ngeom)
        bodies, links = model.geom_bodyid, [g for g in geoms if model.geom_contype[g] == ARM]
        moving = [g for g in links if model.body_weldid[bodies[g]] > 0]
        out = []
        for a in moving:
            for b in geoms:
                first, second = model.body_weldid[bodies[a]], model.body_weldid[bodies[b]]
                near = second == first or model.body_weldid[model.body_parentid[first]] == second
                near |= model.body_weldid[model.body_parentid[second]] == first
                if (b in moving and (b <= a or near)) or (b in links and near):
                    continue
                if model.geom_contype[b] | model.geom_conaffinity[b]:
                    out.append((a, b))
        return out

    def postures(self, pose: np.ndarray, count: int, *, seed: int, margin: float = 0.0) -> list[np.ndarray]:
        """Postures ``[n]`` that bring the tool to a pose and touch nothing, found from random starts.

        Args:
            pose: Pose of the tool ``[7]``.
            count: Random starts besides the arm's own.
            seed: Of the random starts.
            margin: Space around the links [m].
        """
        rng = np.random.default_rng(seed)
        starts = [self.start[self.dofs], *rng.uniform(self.lower, self.upper, (count, len(self.dofs)))]
        found: list[np.ndarray] = []
        for start in starts:
            q = self._solve(pose, start)
            if q is None or self.touching(q, margin=margin):
                continue
            if all(np.abs(q - other).max() > 0.05 for other in found):
                found.append(q)
        return found

    def _solve(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray | None:
        """Damped least squares with joints held at their limits; None where it does not arrive."""
        turn = Rotation.from_quat(pose[3:])
        for _ in range(100):
            at = self.tool(q)
            miss = np.concatenate([pose[:3] - at[:3], (turn * Rotation.from_quat(at[3:]).inv()).as_rotvec()])
            if np.abs(miss).max() < 1e-5:
                return q
            mujoco.mj_comPos(self.model, self.data)
            point, body = at[:3], self.data.body(self.tool_body).id
            mujoco.mj_jac(self.model, self.data, self._jacobian[:3], self._jacobian[3:], point, body)
            jacobian = self._jacobian[:, self.dofs]
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), miss)
            q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), self.lower, self.upper)
        return None


def _solid(compiled: CompiledScene, links: list[int]) -> mujoco.MjModel:
    """The plant's model with the links of its arm solid to each other."""
    spec = compiled.spec()
    for exclude in list(spec.excludes):
        spec.delete(exclude)
    for link in links:
        for geom in spec.body(compiled.body_name[link]).geoms:
            if geom.contype | geom.conaffinity:
                geom.contype, geom.conaffinity = ARM, geom.conaffinity | ARM
    return spec.compile()
