# SPDX-License-Identifier: Apache-2.0
"""The engine ``mujoco``: MuJoCo's C engine on all cores, one differently randomized model per world."""

from __future__ import annotations

import ctypes
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

import mujoco
import numpy as np
import warp as wp

from ..kernels.engine.clone import divergence_kernel, mujoco_control_kernel, mujoco_mocap_kernel
from ..kernels.engine.contacts import mujoco_contact_force_kernel
from ..kernels.engine.mujoco import MujocoData, MujocoLibrary, mujoco_rollout_kernel
from ..physics.runtime.launch import CapturedLaunches
from ..physics.runtime.thread_pool import PARTS, ThreadPool, thread_count
from ..scene.model.drawn_model import randomized_models
from ..scene.model.mujoco_model import Options, make_world
from ..scene.model.pairs import Pair
from ..scene.model.trajectory import BatchSize, Trajectory
from .redraw import RedrawnModels
from .step_worlds import MujocoModelSimulator, StepWorlds

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.properties import Properties
    from ..scene.task.observed import ObservedState
    from .protocol import EngineRequest, PhysicsSteps
    from .step_worlds import Residuals

FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
WRENCH = int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
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


LEAST_PART = 2
"""Worlds in a part, but for the last: below this, handing parts out takes longer than stepping them."""


def _split(worlds: int, domains: int, threads: int) -> list[tuple[int, int]]:
    """First world and number of worlds of each part; all domains of a sample are in one part."""
    size = worlds if threads == 1 else max(-(-worlds // (PARTS * threads)), LEAST_PART)
    size = -(-size // domains) * domains
    return [(first, min(size, worlds - first)) for first in range(0, worlds, size)]


def mujoco_library() -> MujocoLibrary:
    """Addresses of the functions of MuJoCo's C library that roll-outs call.

    Raises:
        RuntimeError: If the library that comes with the package ``mujoco`` is not where it used to be.
    """
    folder = Path(mujoco.__file__).parent
    files = [*folder.glob("libmujoco.so.*"), *folder.glob("libmujoco*.dylib"), *folder.glob("mujoco.dll")]
    if not files:
        raise RuntimeError(f"MuJoCo's C library is not in {folder}")
    loaded = ctypes.CDLL(str(files[0]))
    library = MujocoLibrary()
    for name, function in (("step", "mj_step"), ("set_state", "mj_setState"), ("get_state", "mj_getState")):
        setattr(library, name, ctypes.cast(getattr(loaded, function), ctypes.c_void_p).value)
    return library


def native_data(data: Sequence[mujoco.MjData]) -> MujocoData:
    """Addresses of simulation states and of what roll-outs read in them.

    Args:
        data: One state per thread, of models of one structure.
    """

    def addresses(values: Sequence[int]) -> wp.array:
        return wp.array(np.array(values, dtype=np.uint64), dtype=wp.uint64, device="cpu")

    native = MujocoData()
    native.data = addresses([d._address for d in data])
    native.warmstart = addresses([d.qacc_warmstart.ctypes.data for d in data])
    native.sensor = addresses([d.sensordata.ctypes.data for d in data])
    numbers = [d.warning.number for d in data]
    native.warning = addresses([n.ctypes.data for n in numbers])
    native.warning_stride, native.warnings = numbers[0].strides[0], len(numbers[0])
    return native


warnings = WarningCounter()


def silence_mujoco() -> None:
    """Send MuJoCo's warnings to :data:`warnings`: a diverging world would print thousands of them."""
    mujoco.set_mju_user_warning(warnings)


class MujocoSimulator(MujocoModelSimulator):
    """Rolls controls out as ``mujoco.rollout`` does, part by part on whatever thread replays them.

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
        pushed: Whether there are :meth:`wrenches` on the bodies.
    """

    name = "mujoco"
    device = "cpu"

    def __init__(
        self,
        compiled: CompiledScene,
        shape: BatchSize,
        *,
        substeps: Sequence[int],
        timestep: float,
        pairs: tuple[Pair, ...] = (),
        properties: Properties | None = None,
        threads: int = 0,
        options: Options | None = None,
        sensors: Collection[str] | None = None,
        pushed: bool = False,
    ):
        self.shape, self.pairs, self.substeps = shape, pairs, tuple(substeps)
        layout = compiled.layout
        world = make_world(compiled, timestep=timestep, pairs=pairs, options=options, sensors=sensors)
        self.world, self.model, self.joint_qd = world, world.model, world.joint_qd
        self.mj_model = world.model
        self._pair_sensor = world.first_contact + 3 * world.pair_sensor
        self.redraw: RedrawnModels | None = None
        """Draws the properties of the models anew, None where they stay."""
        self.models = self._randomized(world, properties)
        self.threads = thread_count(threads)
        self.parts = _split(shape.worlds, shape.domains, self.threads)
        """First world and number of worlds of each part that a thread takes."""
        self._library = mujoco_library()
        self._data = [mujoco.MjData(world.model) for _ in range(self.threads)]
        self._native = native_data(self._data)
        self.pool = ThreadPool(self.threads, len(self.parts))
        self._thread = wp.array(self.pool.thread, dtype=int, device="cpu", copy=False)
        end = np.cumsum(substeps)
        self.steps = int(end[-1])
        self._duration = wp.float64(self.steps * world.model.opt.timestep)

        nstate = mujoco.mj_stateSize(world.model, FULL)
        self.initial = np.zeros((shape.worlds, nstate))
        self._control_spec = CONTROL | (WRENCH if pushed else 0) | (MOCAP if layout.nm or layout.movable else 0)
        self._first_mocap = world.model.nu + (6 * world.model.nbody if pushed else 0)
        self.control = np.tile(self._control_at_rest(world.model), (shape.worlds, self.steps, 1))
        self.state = np.zeros((shape.worlds, self.steps, nstate))
        self.sensor = np.zeros((shape.worlds, self.steps, world.model.nsensordata))
        # the same memory, seen by Warp
        self.initial_array, self._control, self.state_array, self._sensor = (
            wp.array(a, dtype=wp.float64, device="cpu", copy=False)
            for a in (self.initial, self.control, self.state, self.sensor)
        )
        addresses = np.array([model._address for model in self.models], dtype=np.uint64)
        self._models = wp.array(addresses, dtype=wp.uint64, device="cpu")
        self._bind_model(world, layout, end - 1, "cpu")
        self._step = wp.array(np.repeat(np.arange(shape.horizon), substeps), dtype=int, device="cpu")
        self._pair_start = wp.array(self._pair_sensor, dtype=int, device="cpu")
        columns = [np.flatnonzero(row) for row in world.actuator_matrix]
        spans = [(c[0], c[-1] + 1) if len(c) else (0, 0) for c in columns]
        self._span = wp.array(np.array(spans).reshape(-1, 2), dtype=int, device="cpu")
        self.trajectory = Trajectory.allocate(shape, layout, len(pairs), "cpu")
        silence_mujoco()

    def _control_at_rest(self, model: mujoco.MjModel) -> np.ndarray:
        """Input of a rollout at a physics step: no controls, and mocap bodies where the model has them."""
        row = np.empty(mujoco.mj_stateSize(model, self._control_spec))
        mujoco.mj_getState(model, mujoco.MjData(model), row, self._control_spec)
        return row

    def _randomized(self, world, properties: Properties | None) -> list[mujoco.MjModel]:
        if properties is None or not properties.names:
            return [world.model] * self.shape.worlds
        draws = properties.of_worlds(self.shape)
        models = randomized_models(world, properties)
        if properties.redrawn:
            self.redraw = RedrawnModels(world, properties, models)
        return [models[draw] for draw in draws]

    def clone(self, state: ObservedState, first: int = 0, count: int | None = None) -> None:
        """Put worlds into the observed state, as MuJoCo has it, too; see :meth:`MujocoModelSimulator.clone`."""
        count = self.shape.worlds - first if count is None else count
        super().clone(state, first, count)
        self._write_state(self.initial_array, first, count)

    def _write_mocap(self, poses: wp.array, order: wp.array, first: int, count: int) -> None:
        """Put mocap bodies of some worlds at poses ``[W, n]``, at every physics step."""
        inputs = [poses, order, self._first_mocap, self.model.nmocap, first]
        self._launch(mujoco_mocap_kernel, (count, self.steps), inputs, [self._control])

    @property
    def mocap_pose(self) -> wp.array:
        """Poses of the mocap bodies of every world ``[W, nm]``."""
        return self._table.mocap_pose

    def move_mocap(self, world: int, index: int, pose: np.ndarray) -> None:
        """Put one mocap body of one world at a pose (x, y, z, qx, qy, qz, qw)."""
        self.mocap_pose.numpy()[world, index] = pose
        self._write_mocap(self.mocap_pose, self._mocap, world, 1)

    def place_obstacles(self, world: int, poses: np.ndarray) -> None:
        """Put the movable obstacles of one world at poses ``[n, 7]``."""
        self._obstacle_pose.numpy()[world] = poses
        self._write_mocap(self._obstacle_pose, self._movable, world, 1)

    def wrenches(self, world: int) -> np.ndarray:
        """Forces [N] and moments [N m] in the world on the centres of mass of one world's bodies, to be written to.

        They act in rollouts from now on, at every physics step ``[steps, bodies, 6]``; engines that are ``pushed`` have
        them.
        """
        return self.control[world, :, self.model.nu : self._first_mocap].reshape(self.steps, -1, 6)

    def show(self, world: int, data: mujoco.MjData) -> None:
        """Put a simulation state of the caller's where a world is at the start of its next step."""
        mujoco.mj_setState(self.model, data, self.initial[world], FULL)
        mujoco.mj_setState(self.model, data, self.control[world, 0], self._control_spec)

    def run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run one sequence of launches for each of :attr:`parts`, on all threads."""
        self.pool.run(replays)

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`, on this thread."""
        for part in range(len(self.parts)):
            self.rollout_part(control, part)

    def rollout_part(self, control: wp.array, part: int) -> None:
        """Roll controls [T, W, nu] of a part of the worlds out from the cloned state into :attr:`trajectory`.

        Args:
            control: Controls of all worlds.
            part: Which of :attr:`parts`.
        """
        first, count = self.parts[part]
        inputs = [control, self._matrix, self._offset, self._span, self._step, first]
        self._launch(mujoco_control_kernel, count, inputs, [self._control])
        self.step_physics(part)
        self._record(first, count)

    def step_physics(self, part: int) -> None:
        """The physics of a part of the worlds alone, on this thread."""
        first, count = self.parts[part]
        self._launch(
            mujoco_rollout_kernel,
            count,
            [
                self._library,
                self._native,
                self._models,
                self._thread,
                part,
                first,
                self.model.nv,
                FULL,
                self._control_spec,
                self.initial_array,
                self._control,
            ],
            [self.state_array, self._sensor],
        )

    def _record(self, first: int, count: int) -> None:
        out = self.trajectory
        self._record_rows(self.state_array, self._sensor, first, count, 1)
        if self.pairs:
            inputs = [self._sensor, self._pair_start, self._end, first]
            self._launch(mujoco_contact_force_kernel, count, inputs, [out.contact_force])
        self._launch(divergence_kernel, count, [self.state_array, self._duration, first], [out.diverged])

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
        self.pool.close()

    @classmethod
    def of(cls, request: EngineRequest, steps: PhysicsSteps) -> Self:
        """Simulator of a scene's physics steps."""
        engine, common = request.scene.engine, {"sensors": request.costs.sensors, **request.worlds(steps)}
        options = Options.of(engine)
        return cls(request.compiled, request.shape, threads=engine.threads, options=options, **common)


class MujocoWorlds(StepWorlds):
    """Worlds of the engine ``mujoco``, in double precision; the solver starts cold in every one of them."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        self._engine = engine = MujocoSimulator.of(*request.one_step(steps, worlds))
        super().__init__(request, worlds, residuals, engine.world)
        engine.trajectory = self._recorded
        self._bind(engine.initial_array, engine.state_array, engine.parts, engine.pool)

    def follow(self) -> None:
        """Take over what was observed besides the state, mocap bodies for instance; overwrites :attr:`start`."""
        self._engine.clone(self._state)

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        self._engine.read_start(self.starts, *self.parts[part])
        self._engine.rollout_part(self._engine.trajectory.control, part)
        self._write_residuals(*self.parts[part])
