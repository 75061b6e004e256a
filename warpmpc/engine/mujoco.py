# SPDX-License-Identifier: Apache-2.0
"""The engine ``mujoco``: MuJoCo's C engine on all cores, one differently randomized model per world."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp

from ..kernels.worlds.clone import (
    clone_activation_kernel,
    clone_mocap_kernel,
    clone_state_kernel,
    divergence_kernel,
    gather_kernel,
    mujoco_activation_kernel,
    mujoco_control_kernel,
    mujoco_mocap_kernel,
    mujoco_state_kernel,
    record_mujoco_kernel,
)
from ..kernels.worlds.contacts import mujoco_contact_force_kernel
from ..model.joints import joint_table
from ..model.mujoco_model import MujocoWorld, Options, make_world
from ..model.pairs import Pair
from ..model.randomize import randomize_model
from .crew import Crew
from .trajectory import ObservedState, Shape, Trajectory

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.properties import Properties

FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
MOCAP = int(mujoco.mjtState.mjSTATE_MOCAP_POS) | int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)


class WarningCounter:
    """Counts MuJoCo's warnings instead of letting it print them and write a log file."""

    def __init__(self):
        self.count = 0
        self.last = ""

    def __call__(self, message: str) -> None:
        """Take one warning."""
        self.count += 1
        self.last = str(message)


PARTS = 4
"""Parts of the worlds per thread: worlds with much contact take longer, and equal shares would leave threads idle."""
LEAST_PART = 4
"""Worlds in a part, but for the last: below this, handing parts out takes longer than stepping them."""


def _split(worlds: int, threads: int) -> list[tuple[int, int]]:
    """First world and number of worlds of each part."""
    size = worlds if threads == 1 else max(-(-worlds // (PARTS * threads)), LEAST_PART)
    return [(first, min(size, worlds - first)) for first in range(0, worlds, size)]


warnings = WarningCounter()


def silence_mujoco() -> None:
    """Send MuJoCo's warnings to :data:`warnings`: a diverging world would print thousands of them."""
    mujoco.set_mju_user_warning(warnings)


class MujocoEngine:
    """Rolls controls out with ``mujoco.rollout`` on all cores.

    Args:
        compiled: The scene.
        shape: Environments, samples, domains and horizon.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties; sample s and domain d use draw d when there are several domains,
            else draw s. ``None`` leaves every world nominal.
        threads: CPU threads, 0 for one per core this process may use.
        options: What the scene says about the physics.
        sensors: Sensors to record, all if None; the others are left out of the model.
    """

    name = "mujoco"
    device = "cpu"

    def __init__(
        self,
        compiled: CompiledScene,
        shape: Shape,
        *,
        substeps: Sequence[int],
        timestep: float,
        pairs: tuple[Pair, ...] = (),
        properties: Properties | None = None,
        threads: int = 0,
        options: Options | None = None,
        sensors: Collection[str] | None = None,
    ):
        self.shape, self.pairs, self.substeps = shape, pairs, tuple(substeps)
        layout = compiled.layout
        world = make_world(compiled, timestep=timestep, pairs=pairs, options=options, sensors=sensors)
        self.model, self.joint_qd = world.model, world.joint_qd
        self._pair_sensor = world.first_contact + 3 * world.pair_sensor
        self.models = self._randomized(world, properties)
        self.threads = threads or len(os.sched_getaffinity(0))
        self._crew = Crew(self.threads)
        self._own = threading.local()  # every thread has a simulation state of its own
        self._parts = _split(shape.worlds, self.threads)
        end = np.cumsum(substeps)
        self.steps = int(end[-1])
        self.duration = self.steps * world.model.opt.timestep

        nstate = mujoco.mj_stateSize(world.model, FULL)
        self.initial = np.zeros((shape.worlds, nstate))
        self._control_spec = CONTROL | (MOCAP if layout.nm else 0)
        self.control = np.tile(self._control_at_rest(world.model), (shape.worlds, self.steps, 1))
        self.state = np.zeros((shape.worlds, self.steps, nstate))
        self.sensor = np.zeros((shape.worlds, self.steps, world.model.nsensordata))
        # the same memory, seen by Warp
        self._initial, self._control, self._state, self._sensor = (
            wp.array(a, dtype=wp.float64, device="cpu", copy=False)
            for a in (self.initial, self.control, self.state, self.sensor)
        )
        self._end = wp.array(end - 1, dtype=int, device="cpu")
        self._step = wp.array(np.repeat(np.arange(shape.horizon), substeps), dtype=int, device="cpu")
        self._table = joint_table(layout, "cpu", worlds=shape.worlds, mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        self._bind_columns(world)
        self._matrix = wp.array(world.actuator_matrix, dtype=float, device="cpu")
        self._offset = wp.array(world.actuator_offset, dtype=float, device="cpu")
        self.trajectory = Trajectory.allocate(shape, layout, len(pairs), "cpu")
        silence_mujoco()

    def _control_at_rest(self, model: mujoco.MjModel) -> np.ndarray:
        """What a rollout is given at a physics step: no controls, and mocap bodies where the model has them."""
        row = np.empty(mujoco.mj_stateSize(model, self._control_spec))
        mujoco.mj_getState(model, mujoco.MjData(model), row, self._control_spec)
        return row

    def _bind_columns(self, world: MujocoWorld) -> None:
        """Where activations, mocap bodies, sensors and contact forces stand in MuJoCo's arrays."""

        def upload(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=int, device="cpu")

        self._activation = upload(1 + world.model.nq + world.model.nv + world.activation)
        self._mocap = upload(world.mocap)
        self._sensors = upload(world.sensor)
        self._senses = bool((world.sensor >= 0).any())
        self._pair_start = upload(self._pair_sensor)

    def _randomized(self, world, properties: Properties | None) -> list[mujoco.MjModel]:
        if properties is None or not properties.names:
            return [world.model] * self.shape.worlds
        draws = properties.of_worlds(self.shape)
        models = {draw: randomize_model(world, properties, draw) for draw in np.unique(draws)}
        return [models[draw] for draw in draws]

    def clone(self, state: ObservedState) -> None:
        """Put every world into the observed state; warm starts and forces of earlier plans are gone with it."""
        out = self.trajectory
        if self._mocap.size:
            self._clone_mocap(state)
        wp.launch(
            clone_state_kernel,
            dim=self.shape.worlds,
            inputs=[self._table, state.joint_q, state.joint_qd, self.shape.rollouts],
            outputs=[out.joint_q, out.joint_qd, out.body_q, out.body_qd],
            device="cpu",
        )
        wp.launch(
            mujoco_state_kernel,
            dim=self.shape.worlds,
            inputs=[self._table, self.model.nq, out.joint_q, out.joint_qd],
            outputs=[self._initial],
            device="cpu",
        )
        if self._activation.size:
            self._clone_activations(state)

    def _clone_activations(self, state: ObservedState) -> None:
        out, dim = self.trajectory, (self.shape.worlds, self._activation.size)
        inputs = [state.act, self.shape.rollouts]
        wp.launch(clone_activation_kernel, dim=dim, inputs=inputs, outputs=[out.act], device="cpu")
        inputs = [out.act, self._activation]
        wp.launch(mujoco_activation_kernel, dim=dim, inputs=inputs, outputs=[self._initial], device="cpu")

    def _clone_mocap(self, state: ObservedState) -> None:
        """Put the mocap bodies of every world where they are observed."""
        dim, inputs = (self.shape.worlds, self._mocap.size), [state.mocap, self.shape.rollouts]
        wp.launch(clone_mocap_kernel, dim=dim, inputs=inputs, outputs=[self.mocap_pose], device="cpu")
        self._write_mocap()

    def _write_mocap(self) -> None:
        wp.launch(
            mujoco_mocap_kernel,
            dim=(self.shape.worlds, self.steps),
            inputs=[self.mocap_pose, self._mocap, self.model.nu, self.model.nmocap],
            outputs=[self._control],
            device="cpu",
        )

    @property
    def mocap_pose(self) -> wp.array:
        """Where the mocap bodies of every world are ``[W, nm]``."""
        return self._table.mocap_pose

    def move_mocap(self, world: int, index: int, pose: np.ndarray) -> None:
        """Put one mocap body of one world at a pose (x, y, z, qx, qy, qz, qw)."""
        self.mocap_pose.numpy()[world, index] = pose
        self._write_mocap()

    def run(self, work: Callable[[int, int], None]) -> None:
        """Call ``work(first, count)`` for parts of the worlds, on all threads."""
        self._crew.run(len(self._parts), lambda part, _: work(*self._parts[part]))

    def rollout(self, control: wp.array, first: int = 0, count: int | None = None) -> None:
        """Roll controls [T, W, nu] of some worlds out from the cloned state into :attr:`trajectory`.

        Args:
            control: Controls of all worlds.
            first: First of the worlds.
            count: How many they are, all from the first on if None. Different threads may take different worlds.
        """
        count = self.shape.worlds - first if count is None else count
        wp.launch(
            mujoco_control_kernel,
            dim=(count, self.steps),
            inputs=[control, self._matrix, self._offset, self._step, first],
            outputs=[self._control],
            device="cpu",
        )
        self.step_physics(first, count)
        self._record(first, count)

    def step_physics(self, first: int, count: int) -> None:
        """The physics of some worlds alone, on this thread."""
        own, worlds = self._own, slice(first, first + count)
        if not hasattr(own, "rollout"):
            own.rollout, own.data = mujoco.rollout.Rollout(nthread=0), [mujoco.MjData(self.model)]
        own.rollout.rollout(
            self.models[worlds],
            own.data,
            self.initial[worlds],
            self.control[worlds],
            nstep=self.steps,
            state=self.state[worlds],
            sensordata=self.sensor[worlds],
            skip_checks=True,
            control_spec=self._control_spec,
        )

    def _record(self, first: int, count: int) -> None:
        out = self.trajectory
        dim = (self.shape.horizon, count)
        wp.launch(
            record_mujoco_kernel,
            dim=dim,
            inputs=[self._table, self.model.nq, self._end, self._state, first],
            outputs=[out.joint_q, out.joint_qd, out.body_q, out.body_qd],
            device="cpu",
        )
        if self.pairs:
            wp.launch(
                mujoco_contact_force_kernel,
                dim=dim,
                inputs=[self._sensor, self._pair_start, self._end, first],
                outputs=[out.contact_force],
                device="cpu",
            )
        if self._activation.size:
            inputs = [self._state, self._activation, self._end, 1, first]
            wp.launch(gather_kernel, dim=dim, inputs=inputs, outputs=[out.act], device="cpu")
        if self._senses:
            inputs = [self._sensor, self._sensors, self._end, 0, first]
            wp.launch(gather_kernel, dim=dim, inputs=inputs, outputs=[out.sensor], device="cpu")
        wp.launch(
            divergence_kernel,
            dim=count,
            inputs=[self._state, wp.float64(self.duration), first],
            outputs=[out.diverged],
            device="cpu",
        )

    def pair_force(self, world: int) -> np.ndarray:
        """Net contact force on the first of each pair of one world at every physics step ``[steps, pairs, 3]`` [N]."""
        if not self.pairs:
            return np.zeros((self.steps, 0, 3))
        start = self._pair_sensor
        parts = self.sensor[world, :, start[0] :].reshape(self.steps, -1, 3)
        return -np.add.reduceat(parts, (start[:-1] - start[0]) // 3, axis=1)  # MuJoCo measures it on the second

    def overflow_message(self, bits: int) -> str:
        """MuJoCo's C engine grows its memory as needed."""
        return f"capacity bits {bits:#x}"

    def close(self) -> None:
        """Stop the threads."""
        self._crew.close()
