# SPDX-License-Identifier: Apache-2.0
"""The tangent space of MuJoCo's states: differences and sums where orientations are quaternions."""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

from ..kernels.planner.derivatives import STRAIGHT
from ..kernels.planner.feedback import TURN, TangentTable

_BACK = np.array([1.0, -1.0, -1.0, -1.0])
"""Signs of the quaternion that turns back."""


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) ``[..., 4]`` of rotation vectors ``[..., 3]``."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def _vector(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors ``[..., 3]`` of at most half a turn, of quaternions (w, x, y, z) ``[..., 4]``."""
    q = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    size = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(size, q[..., :1])
    # 2 half / sin(half), whose limit is 2
    factor = np.where(size > 1e-12, 2.0 * half / np.maximum(size, 1e-300), 2.0)
    return factor * q[..., 1:]


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions (w, x, y, z)."""
    w, v, z, u = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = w * z - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + z * v + np.cross(v, u)], axis=-1)


class Tangent:
    """Sums and differences of states x = (qpos, qvel, act), like ``mj_integratePos`` and ``mj_differentiatePos``.

    A difference is (dq, dv, da): free joints differ by a translation and a rotation vector in the body's frame.

    Args:
        model: The model.
    """

    def __init__(self, model: mujoco.MjModel):
        self.nq, self.nv, self.na = model.nq, model.nv, model.na
        kinds = model.jnt_type
        turning = np.isin(kinds, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))
        lead = np.where(kinds == mujoco.mjtJoint.mjJNT_FREE, 3, 0)
        self._quaternion = (model.jnt_qposadr + lead)[turning][:, None] + np.arange(4)
        self._turn = (model.jnt_dofadr + lead)[turning][:, None] + np.arange(3)
        straight = np.ones(model.nv, dtype=bool)
        straight[self._turn.ravel()] = False
        self._straight = np.flatnonzero(straight)
        plain = np.ones(model.nq, dtype=bool)
        plain[self._quaternion.ravel()] = False
        self._plain = np.flatnonzero(plain)

    @property
    def size(self) -> int:
        """Numbers of a difference, n = 2 nv + na."""
        return 2 * self.nv + self.na

    @property
    def width(self) -> int:
        """Numbers of a state, nq + nv + na."""
        return self.nq + self.nv + self.na

    @property
    def rows(self) -> list[tuple[bool, int, int]]:
        """True for a quaternion, its first number in a state, and in a difference, of all that is subtracted."""
        plain = [(False, int(i), int(j)) for i, j in zip(self._plain, self._straight, strict=True)]
        rest = [(False, self.nq + i, self.nv + i) for i in range(self.nv + self.na)]
        turns = zip(self._quaternion[:, 0], self._turn[:, 0], strict=True)
        return [*plain, *((True, int(i), int(j)) for i, j in turns), *rest]

    @property
    def coordinates(self) -> list[tuple[int, int]]:
        """Place in a state of each number of a difference ``[n]``, and the axis that it turns a quaternion about."""
        out = [(0, 0)] * self.size
        for turns, place, first in self.rows:
            for axis in range(3) if turns else [int(STRAIGHT)]:
                out[first + max(axis, 0)] = place, axis
        return out

    def table(self, device: wp.DeviceLike) -> TangentTable:
        """The rows as kernels take them."""
        out = TangentTable()
        out.kind, out.state, out.tangent = (
            wp.array(column, dtype=int, device=device)
            for column in ([turn * int(TURN) for turn, _, _ in self.rows], *list(zip(*self.rows, strict=True))[1:])
        )
        return out

    def add(self, state: np.ndarray, difference: np.ndarray) -> np.ndarray:
        """States ``[..., nq + nv + na]`` moved by differences ``[..., n]``."""
        shape = np.broadcast_shapes(state.shape[:-1], difference.shape[:-1])
        out = np.array(np.broadcast_to(state, (*shape, self.width)))
        dq = difference[..., : self.nv]
        out[..., self._plain] += dq[..., self._straight]
        if len(self._turn):
            turned = _product(out[..., self._quaternion], _rotation(dq[..., self._turn]))
            out[..., self._quaternion] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        out[..., self.nq :] += difference[..., self.nv :]
        return out

    def subtract(self, state: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Differences ``[..., n]`` that lead from other states to states."""
        shape = np.broadcast_shapes(state.shape[:-1], other.shape[:-1])
        out = np.empty((*shape, self.size))
        out[..., self._straight] = state[..., self._plain] - other[..., self._plain]
        if len(self._turn):
            back = other[..., self._quaternion] * _BACK
            out[..., self._turn] = _vector(_product(back, state[..., self._quaternion]))
        out[..., self.nv :] = state[..., self.nq :] - other[..., self.nq :]
        return out

    def displace(self, state: np.ndarray, column: np.ndarray, step: np.ndarray) -> np.ndarray:
        """States ``[N, K, nq + nv + na]``: each of N, moved K times along one number of a difference.

        Args:
            state: The states ``[N, nq + nv + na]``.
            column: Number of the difference ``[K]``.
            step: How far ``[N, K]``.
        """
        place, turning, at, axis = self._ways(column)
        out = np.repeat(state[:, None], len(column), axis=1)
        plain = np.flatnonzero(~turning)
        out[:, plain, place[plain]] += step[:, plain]
        turned = _product(state[:, at], _rotation(step[:, turning, None] * axis))
        out[:, np.flatnonzero(turning)[:, None], at] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        return out

    def along(self, state: np.ndarray, other: np.ndarray, column: np.ndarray) -> np.ndarray:
        """One number ``[N, K]`` of each difference that leads from other states to states ``[N, K, ...]``."""
        place, turning, at, axis = self._ways(column)
        rows, turns = np.arange(len(column)), np.flatnonzero(turning)[:, None]
        out = state[:, rows, place] - other[:, rows, place]
        turned = _product(other[:, turns, at] * _BACK, state[:, turns, at])
        out[:, turning] = np.sum(_vector(turned) * axis, axis=-1)
        return out

    def _ways(self, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Places in a state, which of these are quaternions, the places of their numbers, and the axes they turn by."""
        place, axis = (np.array(x, dtype=int)[column] for x in zip(*self.coordinates, strict=True))
        turning = axis != int(STRAIGHT)
        return place, turning, place[turning][:, None] + np.arange(4), np.eye(3)[axis[turning]]

    def advance(self, rise: np.ndarray, start: np.ndarray, moved: np.ndarray) -> None:
        """Write where quaternions of pairs of states end, in their tangent space.

        Args:
            rise: Differences ``[N, K, n]`` of the first K ends and the rest.
            start: States ``[N, L, ...]`` at the start; the rest is as many, or one for all.
            moved: How far coordinates go ``[N, L, nv]``.
        """
        if len(self._turn):
            end = _product(start[..., self._quaternion], _rotation(moved[..., self._turn]))
            count = rise.shape[1]
            rise[..., self._turn] = _vector(_product(end[:, count:] * _BACK, end[:, :count]))
