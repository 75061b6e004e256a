# SPDX-License-Identifier: Apache-2.0
"""Feedback gains of a plan: how its controls answer states that are not the planned ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..kernels.planner.splines import KNOT_TOLERANCE
from ..physics.tangent import Tangent
from ..scene.model.conversion import StateRows
from ..scene.model.mujoco_model import make_world
from .derivatives.rollouts import Policy

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.state import State


@dataclass(frozen=True)
class StateSpace:
    """Differences of a scene's states."""

    tangent: Tangent
    """Tangent space of MuJoCo's states."""
    rows: StateRows
    """Turns a scene's states into MuJoCo's."""

    @classmethod
    def of(cls, compiled: CompiledScene) -> StateSpace:
        """That of a compiled scene."""
        world = make_world(compiled, timestep=1.0)  # nothing is simulated
        return cls(Tangent(world.model), StateRows(compiled.layout, world))


@dataclass(frozen=True)
class Feedback:
    """Gains K(t) about states x̄(t), of every environment."""

    times: np.ndarray
    """Times of the states ``[E, T]`` [s]; in a plan they are absolute."""
    state: np.ndarray
    """x̄, MuJoCo's (qpos, qvel, act) ``[E, T, nx]``."""
    gain: np.ndarray
    """K ``[E, T, nu, n]``."""
    space: StateSpace
    """Subtracts states."""

    def correction(self, times: np.ndarray, state: State) -> np.ndarray:
        """K (x ⊖ x̄), what the controls answer to states ``[E, nu]``.

        A state is compared with the planned one at the time of the observation, which may precede that of the control.

        Args:
            times: One for each environment ``[E]`` [s]; a state that has a time is taken at its own.
            state: States of all environments, ``joint_q`` ``[E, nq]``.
        """
        seen = times if state.time is None else np.broadcast_to(np.asarray(state.time, dtype=float), times.shape)
        wanted, gain = self.at(seen[:, None])
        found = self.space.rows(state.joint_q, state.joint_qd, state.act)
        answer = np.einsum("eun,en->eu", gain[:, 0], self.space.tangent.subtract(found, wanted[:, 0]))
        return np.where(self._planned(self._place(times[:, None])), answer, 0.0)

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x̄ ``[E, N, nx]`` and K ``[E, N, nu, n]`` at some times ``[E, N]``.

        Between two states lies their geodesic; a gain holds from its state to the next one, the last one as long as
        that before it. Before the first state and after that there is none.
        """
        last, rows, place = self.times.shape[1] - 1, np.arange(len(times))[:, None], self._place(times)
        i = np.clip(np.floor(place).astype(int), 0, last)
        state, after = self.state[rows, i], self.state[rows, np.minimum(i + 1, last)]
        part = np.clip(place - i, 0.0, 1.0)[..., None]
        state = self.space.tangent.add(state, part * self.space.tangent.subtract(after, state))
        return state, np.where(self._planned(place)[..., None, None], self.gain[rows, i], 0.0)

    def planned(self, times: np.ndarray, control: np.ndarray) -> np.ndarray:
        """Controls ``[E, T, nu]`` of its times at others ``[E, N]``, the last for good: ``[E, N, nu]``."""
        i = np.clip(np.floor(self._place(times)).astype(int), 0, self.times.shape[1] - 1)
        return control[np.arange(len(times))[:, None], i]

    def _place(self, times: np.ndarray) -> np.ndarray:
        step = self.times[:, -1:] - self.times[:, -2:-1] if self.times.shape[1] > 1 else np.ones((len(times), 1))
        # a time that was rounded down, to single precision, is no step too early
        return (times - self.times[:, :1]) / step + float(KNOT_TOLERANCE)

    def _planned(self, place: np.ndarray) -> np.ndarray:
        return ~((place < 0.0) | (place >= self.times.shape[1]))  # what is not finite stays so, and is not followed

    def policy(self, times: np.ndarray, control: np.ndarray) -> Policy:
        """The gains at other times ``[E, T]``, about controls ``[E, T, nu]``."""
        state, gain = self.at(times)
        return Policy(state, control, np.zeros_like(control), gain)
