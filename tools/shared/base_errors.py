# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimated base along a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import warpmpc
    from warpmpc.loop.estimation.free_joints import FreeJoint


class BaseErrors:
    """Adds up what is seen of a robot's base beside the truth.

    Args:
        joint: The base's free joint.
    """

    def __init__(self, joint: FreeJoint):
        self._joint = joint
        self._off: list[tuple[float, float]] = []  # tilt [rad], velocity [m/s]
        self._way, self._last = 0.0, None
        self._drift = self._yaw = 0.0

    def note(self, seen: warpmpc.State, true: warpmpc.State) -> None:
        """Take note of a state of one time as it is seen and as it is."""
        poses = [state.joint_q[self._joint.q] for state in (seen, true)]
        ours, theirs = (Rotation.from_quat(pose[3:]) for pose in poses)
        up = [turn.inv().apply([0.0, 0.0, 1.0]) for turn in (ours, theirs)]
        tilt = np.arctan2(np.linalg.norm(np.cross(*up)), up[0] @ up[1])
        # along the base's own axes: yaw is counted by itself
        velocities = [
            turn.inv().apply(state.joint_qd[self._joint.qd][:3])
            for turn, state in zip((ours, theirs), (seen, true), strict=True)
        ]
        self._off.append((float(tilt), float(np.linalg.norm(velocities[0] - velocities[1]))))
        place = poses[1][:2]
        self._way += 0.0 if self._last is None else float(np.linalg.norm(place - self._last))
        self._last = place.copy()
        self._drift = float(np.linalg.norm(poses[0][:2] - place))
        self._yaw = abs(float((ours * theirs.inv()).as_rotvec()[2]))

    def result(self) -> dict[str, float]:
        """Errors of the run.

        Returns:
            ``tilt`` [rad] and ``velocity`` [m/s], root mean squares; ``drift`` of the horizontal position at the end
            [m], ``yaw`` at the end [rad], and ``way``, how far the base went [m].
        """
        tilt, velocity = np.sqrt(np.mean(np.square(self._off), axis=0)).tolist()
        return {"tilt": tilt, "velocity": velocity, "drift": self._drift, "yaw": self._yaw, "way": self._way}

    @staticmethod
    def text(runs: list[dict[str, float]]) -> str:
        """Errors of several runs in words: root mean squares over runs, drift as a share of the way."""
        tilt, velocity, yaw = (np.sqrt(np.mean([run[key] ** 2 for run in runs])) for key in ("tilt", "velocity", "yaw"))
        shares = [run["drift"] / run["way"] for run in runs]
        return (
            f"tilt {np.degrees(tilt):.2f}°, {100.0 * velocity:.1f} cm/s; at the end {100.0 * np.mean(shares):.1f} %"
            f" (to {100.0 * max(shares):.1f}) of the way, yaw {np.degrees(yaw):.1f}°"
        )
