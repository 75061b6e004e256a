# SPDX-License-Identifier: Apache-2.0
"""States from and to simulators of the user's own: a MuJoCo model or a Newton model with the scene's joints.

States of a scene as rows of its MuJoCo model's (qpos, qvel, act).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ...kernels.engine.clone import mujoco_state_kernel, record_mujoco_kernel
from ...kernels.geometry.kinematics import FREE
from ...physics.runtime.launch import Launcher, unrecorded
from .joints import joint_table
from .state import State

if TYPE_CHECKING:
    import newton

    from .compiled_scene import CompiledScene
    from .layout import Layout
    from .mujoco_model import MujocoWorld


class _JointMap:
    """Joints of a scene that another model has, too, and where their numbers are in a state.

    Args:
        layout: The scene's layout.
        find: Joint of the other model for a joint of the layout, None where it has none.
    """

    missing: tuple[str, ...]
    """Joints of the scene that the other model lacks."""

    def __init__(self, layout: Layout, find: Callable[[int], int | None]):
        moving = np.flatnonzero(layout.joint_dof_dim.sum(axis=1)).tolist()
        found = {j: there for j in moving if (there := find(j)) is not None}
        if not found:
            names = ", ".join(layout.joint_name[j] for j in moving)
            raise ValueError(f"this model has none of the scene's joints: {names}")
        self.missing = tuple(layout.joint_name[j] for j in moving if j not in found)
        self.joint, self.other = np.array(list(found)), np.array(list(found.values()))
        ends = np.append(layout.joint_q_start[1:], layout.nq)
        self._q_width = (ends - layout.joint_q_start)[self.joint]
        self._qd_width = layout.joint_dof_dim[self.joint].sum(axis=1)
        self.q, self.qd = self.numbers(layout.joint_q_start[self.joint], layout.joint_qd_start[self.joint])

    def numbers(self, first_q: np.ndarray, first_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places of all coordinates and of all velocities, from those of each joint's first."""
        return _runs(first_q, self._q_width), _runs(first_qd, self._qd_width)

    def state(self, q: np.ndarray, qd: np.ndarray, others: State | None) -> State:
        """The state of the coordinates ``[nq]`` and velocities ``[nv]`` that were found; the rest is from ``others``.

        Raises:
            ValueError: If joints are missing and there is nothing to take them from.
        """
        if self.missing and others is None:
            names = ", ".join(self.missing)
            raise ValueError(f"the model has no joint {names}: give others = a State that tells where these are")
        if others is None:
            return State(q, qd)
        whole = [np.array(array, dtype=np.float32) for array in (others.joint_q, others.joint_qd)]
        whole[0][self.q], whole[1][self.qd] = q[self.q], qd[self.qd]
        return replace(others, joint_q=whole[0], joint_qd=whole[1])


def _runs(first: np.ndarray, width: np.ndarray) -> np.ndarray:
    """The indices from each first one on."""
    return np.concatenate([np.arange(a, a + n) for a, n in zip(first, width, strict=True)])


def _spellings(*names: str) -> list[str]:
    """Names with and without what stands before the first slash."""
    return [name for full in names if full for name in (full, full.partition("/")[2]) if name]


class MujocoStates:
    """Turns ``qpos`` and ``qvel`` of a MuJoCo model into a :class:`~warpmpc.State` of a scene, and back.

    Joints, actuators and mocap bodies are found by name: as the scene calls them (``robot/joint``) or without the
    robot; a free joint also by the body that it moves. The order and sign of quaternions and the velocities of free and
    ball joints differ between the two and are converted.

    Args:
        compiled: The scene, compiled (``Controller.compiled``).
        model: The model.

    Raises:
        ValueError: If the model has none of the scene's joints.
    """

    def __init__(self, compiled: CompiledScene, model: mujoco.MjModel):
        layout = self._layout = compiled.layout
        self._model = model
        self._joints = _JointMap(layout, lambda j: self._joint(compiled, j))
        self.missing = self._joints.missing
        """Joints of the scene that the model lacks."""
        there = self._joints.other
        first = [np.full(len(layout.joint_name), -1, dtype=np.int32) for _ in range(2)]
        first[0][self._joints.joint], first[1][self._joints.joint] = model.jnt_qposadr[there], model.jnt_dofadr[there]
        self._qpos, self._qvel = self._joints.numbers(model.jnt_qposadr[there], model.jnt_dofadr[there])
        self._act = self._places(mujoco.mjtObj.mjOBJ_ACTUATOR, layout.activation_name, model.actuator_actadr)
        self._mocap = self._places(mujoco.mjtObj.mjOBJ_BODY, layout.mocap_name, model.body_mocapid)
        self._table = joint_table(layout, "cpu", mujoco_q=first[0], mujoco_qd=first[1])
        self._launch = Launcher("cpu")
        self._row = wp.zeros((1, 1, 1 + model.nq + model.nv), dtype=wp.float64, device="cpu")
        self._first = wp.zeros(1, dtype=int, device="cpu")
        sizes = ((layout.nq, float), (layout.nv, float), (layout.nb, wp.transform), (layout.nb, wp.spatial_vector))
        self._slices = [wp.zeros((2, 1, n), dtype=kind, device="cpu") for n, kind in sizes]

    def _joint(self, compiled: CompiledScene, j: int) -> int | None:
        """The model's joint for one of the layout's."""
        layout, dof = self._layout, int(self._layout.joint_qd_start[j])
        found = self._named(mujoco.mjtObj.mjOBJ_JOINT, compiled.joint_name[dof], layout.dof_name[dof])
        if found is None and layout.joint_type[j] == FREE:
            body = self._named(mujoco.mjtObj.mjOBJ_BODY, layout.body_name[layout.joint_child[j]])
            if body is not None and self._model.body_dofnum[body] == 6:
                found = int(self._model.body_jntadr[body])
        return found

    def _named(self, kind: mujoco.mjtObj, *names: str) -> int | None:
        ids = (mujoco.mj_name2id(self._model, kind, name) for name in _spellings(*names))
        return next((i for i in ids if i >= 0), None)

    def _places(self, kind: mujoco.mjtObj, names: Iterable[str], address: np.ndarray) -> np.ndarray | None:
        """Places of these names in the model; None where it lacks any of them."""
        found, seen = [], {}
        for name in names:
            index = self._named(kind, name)
            if index is None or address[index] < 0:
                return None
            seen[name] = seen.get(name, -1) + 1  # an actuator may have several activations
            found.append(int(address[index]) + seen[name])
        return np.array(found, dtype=int)

    def read(self, data: mujoco.MjData, *, others: State | None = None) -> State:
        """The state that MuJoCo's data are in, with its time.

        Args:
            data: ``qpos``, ``qvel``, ``time``, and what the scene knows of ``act`` and mocap bodies.
            others: Where the joints are that the model lacks, such as objects that a camera sees.

        Raises:
            ValueError: If the model lacks joints of the scene and ``others`` is not given.
        """
        row = self._row.numpy()[0, 0]
        row[1 : 1 + self._model.nq], row[1 + self._model.nq :] = data.qpos, data.qvel
        inputs = [self._table, self._model.nq, self._first, self._row, 1, 0, 1]
        self._launch(record_mujoco_kernel, (1, 1), inputs, self._slices)
        q, qd = (array.numpy()[1, 0].copy() for array in self._slices[:2])
        state = replace(self._joints.state(q, qd, others), time=float(data.time))
        if self._act is not None and len(self._act):
            state = replace(state, act=data.act[self._act].astype(np.float32))
        if self._mocap is not None and len(self._mocap):
            turned = np.roll(data.mocap_quat[self._mocap], -1, axis=1)  # w comes first in MuJoCo
            state = replace(state, mocap=np.hstack([data.mocap_pos[self._mocap], turned]).astype(np.float32))
        return state

    def write(self, state: State, data: mujoco.MjData) -> None:
        """Put MuJoCo's data into a state; what the scene does not know stays as it is. No ``mj_forward`` is called.

        Args:
            state: State of one environment.
            data: Its ``qpos``, ``qvel``, ``act``, mocap bodies and, if the state has one, ``time`` are written.
        """
        for array, values in zip(self._slices, (state.joint_q, state.joint_qd), strict=False):
            array.numpy()[0, 0] = values
        inputs = [self._table, self._model.nq, *self._slices[:2], 0]
        self._launch(mujoco_state_kernel, 1, inputs, [self._row[0]])
        row = self._row.numpy()[0, 0]
        data.qpos[self._qpos], data.qvel[self._qvel] = row[1 + self._qpos], row[1 + self._model.nq + self._qvel]
        if state.act is not None and self._act is not None:
            data.act[self._act] = state.act
        if state.mocap is not None and self._mocap is not None:
            data.mocap_pos[self._mocap] = state.mocap[:, :3]
            data.mocap_quat[self._mocap] = np.roll(state.mocap[:, 3:], 1, axis=1)
        if state.time is not None:
            data.time = float(state.time)


class NewtonStates:
    """Turns a state of a Newton model into a :class:`~warpmpc.State` of a scene, and back.

    Both have the same conventions; joints are found by their labels, with or without what stands before the slash.

    Args:
        compiled: The scene, compiled (``Controller.compiled``).
        model: The model, on any device.
        world: Which of the model's worlds.

    Raises:
        ValueError: If the model has none of the scene's joints in this world.
    """

    def __init__(self, compiled: CompiledScene, model: newton.Model, *, world: int = 0):
        layout = compiled.layout
        here = np.isin(model.joint_world.numpy(), (-1, world))
        labels = {label: j for j, label in enumerate(model.joint_label) if here[j]}
        own = Counter(label.partition("/")[2] for label in labels)
        known = {short: j for label, j in labels.items() if own[short := label.partition("/")[2]] == 1} | labels
        self._model = model
        self._joints = _JointMap(layout, lambda j: _first(known, _spellings(layout.joint_name[j])))
        self.missing = self._joints.missing
        """Joints of the scene that the model lacks."""
        there = self._joints.other
        starts = (model.joint_q_start.numpy()[there], model.joint_qd_start.numpy()[there])
        self._q, self._qd = self._joints.numbers(*starts)
        self._sizes = layout.nq, layout.nv

    def read(self, state: newton.State, *, time: float | None = None, others: State | None = None) -> State:
        """The state that a Newton state is in.

        Args:
            state: Its ``joint_q`` and ``joint_qd`` are read; after a solver that moves bodies alone call
                ``newton.eval_ik`` first.
            time: When that is [s], which Newton does not keep.
            others: Where the joints are that the model lacks.

        Raises:
            ValueError: If the model lacks joints of the scene and ``others`` is not given.
        """
        whole = [np.zeros(size, dtype=np.float32) for size in self._sizes]
        whole[0][self._joints.q] = state.joint_q.numpy()[self._q]
        whole[1][self._joints.qd] = state.joint_qd.numpy()[self._qd]
        return replace(self._joints.state(*whole, others), time=time)

    def write(self, state: State, out: newton.State) -> None:
        """Put a Newton state into a state, bodies included; joints that the scene does not know stay as they are.

        Args:
            state: State of one environment.
            out: Its ``joint_q``, ``joint_qd``, ``body_q`` and ``body_qd`` are written.
        """
        import newton

        pairs = ((out.joint_q, self._q, state.joint_q[self._joints.q]),)
        pairs += ((out.joint_qd, self._qd, state.joint_qd[self._joints.qd]),)
        for array, places, values in pairs:
            numbers = array.numpy().copy()
            numbers[places] = values
            array.assign(numbers)
        newton.eval_fk(self._model, out.joint_q, out.joint_qd, out)


def _first(known: dict[str, int], names: Sequence[str]) -> int | None:
    """Return what the first of the names that is known stands for."""
    return next((known[name] for name in names if name in known), None)


class StateRows:
    """Turns joint coordinates and velocities into MuJoCo's.

    Args:
        layout: State layout.
        world: MuJoCo's model of the scene.
    """

    def __init__(self, layout: Layout, world: MujocoWorld):
        model = world.model
        self._nq, self._activation = model.nq, model.nq + model.nv + np.asarray(world.activation, dtype=int)
        self._width = 1 + model.nq + model.nv + model.na
        self._table = joint_table(layout, "cpu", mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        self._launch = Launcher("cpu")

    @unrecorded
    def __call__(self, joint_q: np.ndarray, joint_qd: np.ndarray, act: np.ndarray | None = None) -> np.ndarray:
        """Rows ``[E, nx]`` of coordinates ``[E, nq]``, velocities ``[E, nv]`` and activations ``[E, na]``."""
        q, qd = (wp.array(np.asarray(a)[None], dtype=float, device="cpu") for a in (joint_q, joint_qd))
        rows = wp.zeros((len(joint_q), self._width), dtype=wp.float64, device="cpu")
        self._launch(mujoco_state_kernel, len(joint_q), [self._table, self._nq, q, qd, 0], [rows])
        out = rows.numpy()[:, 1:]
        if len(self._activation) and act is not None:
            out[:, self._activation] = act
        return out
