# SPDX-License-Identifier: Apache-2.0
"""Quantities that conditions look at, from states that were observed without simulation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cost.values import TermValues
from ..kernels.geometry.kinematics import forward_kinematics_kernel
from ..launch import Launcher, capturing
from ..model.batch_size import BatchSize
from ..model.joints import joint_table
from ..model.trajectory import Trajectory
from ..scene.errors import SceneError
from ..task.conditions import StateSnapshot

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Scene
    from ..task.task import Task


class ObservedSnapshots:
    """Bodies follow from joints, cost terms from two states and the control between them.

    Args:
        scene: The scene.
        layout: Its layout, targets included.
        task: The task.
        e: Environment of the task.
        labels: Cost terms that are looked at.
        terms: Users' own cost terms.

    Raises:
        SceneError: If a term reads what a state does not tell: contact forces or sensors.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        e: int,
        labels: Collection[str],
        *,
        terms: Sequence[UserTerm] = (),
    ):
        shape, self._e = BatchSize(task.envs, 1, 1, 1), e
        self._launch = Launcher("cpu")
        self._table = joint_table(layout, "cpu", worlds=task.envs)
        self._trajectory = Trajectory.allocate(shape, layout, 0, "cpu")
        self._values = TermValues(scene, layout, task, labels, terms=terms) if labels else None
        if self._values:
            if self._values.pairs or self._values.sensors:
                raise SceneError(
                    "conditions on cost terms that read contact forces or sensors need a simulated plant",
                    key="cost",
                    file=scene.path,
                    found=sorted(labels),
                )
            self._values.attach(self._trajectory, self._trajectory.control, shape, scene.timing.control_dt)
        self.reset()

    def reset(self) -> None:
        """The next state is the first one."""
        self._before: float | None = None

    def __call__(self, state: State, control: np.ndarray | None, time: float) -> StateSnapshot | None:
        """Compute them for a state, None where it is not finite.

        Args:
            state: The state, of all environments or of this one.
            control: The control ``[nu]`` that led to it.
            time: Its time [s].
        """
        out, poses = self._trajectory, self._table.mocap_pose.numpy()
        rows = [(out.joint_q.numpy(), state.joint_q, 1), (out.joint_qd.numpy(), state.joint_qd, 1)]
        rows = [(array, self._row(value, axes)) for array, value, axes in rows]
        mocap = poses[self._e] if state.mocap is None else self._row(state.mocap, 2)
        if not all(np.isfinite(value).all() for value in (*(value for _, value in rows), mocap)):
            return None
        poses[:] = mocap
        for array in (*(array for array, _ in rows), out.body_q.numpy(), out.body_qd.numpy()):
            array[0] = array[1]
        for array, value in rows:
            array[1] = value
        after = (array[1:] for array in (out.joint_q, out.joint_qd, out.body_q, out.body_qd))
        joint_q, joint_qd, body_q, body_qd = after
        self._launch(forward_kinematics_kernel, body_q.shape[:2], [self._table, joint_q, joint_qd], [body_q, body_qd])
        out.control.numpy()[:] = 0.0 if control is None else control
        values: dict[str, float] = {}
        if self._values and self._before is not None:
            with capturing:
                values = self._values([self._before] * len(poses))[self._e]
        self._before = time
        return StateSnapshot(out.body_q.numpy()[1, self._e].copy(), rows[0][1], values)

    def _row(self, values: np.ndarray, axes: int) -> np.ndarray:
        """This environment's part of what was observed."""
        values = np.asarray(values, dtype=np.float32)
        return values[self._e] if values.ndim > axes else values
