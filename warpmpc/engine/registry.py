# SPDX-License-Identifier: Apache-2.0
"""The engines by name: what each runs on, what it can do, and how one is made.

Number of physics steps in a step of a rollout where a scene leaves it out: few, as long as plans hardly change.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..physics.runtime.bake import OutOfRange
from ..physics.runtime.compiling import KernelError
from ..physics.runtime.launch import capturing
from ..scene.errors import SceneError
from ..scene.model.control_values import safe_command
from ..scene.model.layout import rotate
from ..scene.model.mujoco_model import Options
from ..scene.model.trajectory import BatchSize
from ..scene.registry import ENGINES
from ..scene.schema import EngineName, Solver
from ..scene.task.observed import ObservedState
from ..scene.task.task import Task, task_layout
from .evaluation import SimulatorEngine
from .protocol import EngineRequest, PhysicsSteps

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.schema import Scene
    from .protocol import Engine, Simulator, TimeGrid

PHYSICS_STEP_LONGEST = 0.01
"""Longest step that is chosen [s]: MuJoCo softens contacts whose time constant, 0.02 s by default, is less than two."""
FACTORS = (4, 2)
"""Numbers of the MJCF file's steps that are put into one: the first that will do is taken."""
SMALL = 0.01
"""Error that is small, as a share of the spread of the rollouts: planning compares rollouts, and those that differ a
hundred times as much as a longer step moves them keep their order. Robots with legs are at 0.15 and more, arms and
carts below 0.03; a hand that turned an egg in two of two runs did in one with twice the step, at 0.02."""
WORLDS = 16
"""Rollouts that are compared."""
MOVES = 0.05
"""Share of the largest spread below which a body is not moved by the controls."""
KNOTS = 6
"""Random controls of a rollout, between which they are interpolated."""


def physics_step_count(scene: Scene, compiled: CompiledScene, grid: TimeGrid, count: int) -> int:
    """Number of physics steps in the first step of a rollout.

    Random controls of small to large amplitude are rolled out over the horizon with the file's step and with longer
    ones, always the same controls.

    Args:
        scene: The scene.
        compiled: The scene, compiled from MJCF files.
        grid: Steps of the rollout.
        count: What it is with the file's step.
    """
    dt = float(grid.dt[0])
    counts = dict.fromkeys(
        n for n in (math.ceil(count / k) for k in FACTORS) if n < count and dt / n <= PHYSICS_STEP_LONGEST + 1e-9
    )
    fitting = [n for n in counts if np.abs(grid.dt * n / dt - np.round(grid.dt * n / dt)).max() < 1e-6]
    if not fitting or not compiled.layout.nu:
        return count
    key, known = f"{scene.engine.model_dump_json()} {grid.dt.tolist()}", compiled.measured
    if key not in known:
        with capturing:  # nothing may be allocated while a controller records its plan
            rollouts = _Rollouts(scene, compiled, grid)
            exact = rollouts.centres(count)
            known[key] = next((n for n in fitting if _error(rollouts.centres(n), exact) <= SMALL), count)
    return known[key]


class _Rollouts:
    """Random controls from a scene's start.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        grid: Steps of the rollouts.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene, grid: TimeGrid):
        self._scene, self._compiled, self._grid = scene, compiled, grid
        self._layout = layout = task_layout(compiled.layout, scene)
        self._state = ObservedState.allocate(layout, Task(scene), "cpu")
        lower, upper = layout.control_lower.astype(float), layout.control_upper.astype(float)
        start = safe_command(layout, layout.joint_q[None], np.zeros((1, layout.nv)), float(grid.dt[0]))[0]
        amplitude = np.geomspace(0.1, 1.0, WORLDS)[:, None, None] * (upper - lower) / 2.0
        knots = amplitude * np.random.default_rng(0).uniform(-1.0, 1.0, (WORLDS, KNOTS, layout.nu))
        place = (KNOTS - 1) * grid.t[:-1] / max(grid.t[-2], 1e-9)
        first = np.minimum(place.astype(int), KNOTS - 2)
        share = (place - first)[:, None]
        control = knots[:, first] * (1.0 - share) + knots[:, first + 1] * share
        self._control = np.clip(start + control, lower, upper).swapaxes(0, 1)

    def centres(self, count: int) -> np.ndarray:
        """Centres of mass of all bodies ``[T+1, W, nb, 3]``, not finite in a world that diverges.

        Args:
            count: Physics steps in the first step of the rollouts.
        """
        from .mujoco import MujocoSimulator

        length = float(self._grid.dt[0]) / count
        simulator = MujocoSimulator(
            self._compiled,
            BatchSize(1, WORLDS, 1, self._grid.steps),
            substeps=np.round(self._grid.dt / length).astype(int).tolist(),
            timestep=length,
            options=Options.of(self._scene.engine),
            sensors=(),
            threads=1,
        )
        simulator.trajectory.control.assign(self._control.astype(np.float32))
        simulator.clone(self._state)
        simulator.rollout(simulator.trajectory.control)
        poses = simulator.trajectory.body_q.numpy().astype(float)
        centres = poses[..., :3] + rotate(poses[..., 3:], self._layout.body_com)
        centres[:, simulator.trajectory.diverged.numpy().astype(bool)] = np.nan
        simulator.close()
        return centres


def _error(centres: np.ndarray, exact: np.ndarray) -> float:
    """Difference of rollouts ``[T+1, W, nb, 3]``, as a share of how far they are from one another.

    Root mean square over worlds and steps, of the body for which it is largest among those that the controls move;
    infinite where a world diverges.
    """
    if not (np.isfinite(centres).all() and np.isfinite(exact).all()):
        return math.inf

    def size(apart: np.ndarray) -> np.ndarray:
        return np.sqrt((apart**2).sum(axis=-1).mean(axis=(0, 1)))

    spread = size(exact - exact.mean(axis=1, keepdims=True))
    moved = (spread > 0.0) & (spread >= MOVES * spread.max(initial=0.0))
    return float((size(centres - exact)[moved] / spread[moved]).max(initial=0.0)) if moved.any() else math.inf


logger = logging.getLogger("warpmpc")


@dataclass(frozen=True, kw_only=True)
class EngineEntry:
    """An engine as the registry knows it."""

    name: str
    """By which scene files and controllers name it."""
    make: Callable[[EngineRequest, PhysicsSteps], Engine]
    cuda: bool = False
    """True for engines that run on CUDA devices."""
    cpu: bool = True
    """True for engines that run on the CPU."""
    capturable: bool = False
    """True where a CUDA graph can hold its evaluation; else every plan on a CUDA device runs launch by launch."""
    any_dt: bool = False
    """True where its physics steps may have any length; else every step of a rollout is a multiple of one length."""
    physics: bool = True
    """True where a world that diverged is one whose physics failed; without physics its cost was not finite."""


PREFERRED = {
    "cpu": (str(EngineName.FUSED), str(EngineName.MUJOCO)),
    "cuda": (str(EngineName.FUSED), str(EngineName.MUJOCO_WARP)),
}
"""Engines that ``auto`` stands for, the fastest first; the last can do most."""


def register(entry: EngineEntry) -> None:
    """Add an engine, for scene files, commands and controllers.

    Raises:
        ValueError: If there is one of this name.
    """
    ENGINES.register(entry.name, entry)


def resolve(scene: Scene, engine: str, device: str) -> tuple[str, str]:
    """Engine and Warp device for what a user asked for; an engine ``auto`` stays so (:data:`PREFERRED`).

    Args:
        scene: The scene, whose ``engine.name`` counts when ``engine`` is ``auto``.
        engine: ``auto`` or an engine's name.
        device: ``auto``, ``cpu`` or a CUDA device.

    Raises:
        ValueError: If engine or device is unknown, not available here, or the two do not go together.
    """
    engine = str(scene.engine.name) if engine == "auto" else engine
    entry = None if engine == "auto" else ENGINES.find(engine, "auto")
    if device != "auto":
        try:
            device = str(wp.get_device(device))
        except Exception as error:  # Warp raises several kinds for a device that is not there
            have = ", ".join(str(d) for d in wp.get_devices())
            raise ValueError(f"no device '{device}' on this machine; there is: auto, {have}") from error
    if entry is None:
        if device == "auto":
            device = str(wp.get_preferred_device()) if wp.is_cuda_available() else "cpu"
        return engine, device
    if device == "auto":
        device = str(wp.get_preferred_device()) if entry.cuda else "cpu"
    if not (entry.cpu if device == "cpu" else entry.cuda):
        raise ValueError(f"the engine {engine} runs on device {'cpu' if entry.cpu else 'cuda'}, not '{device}'")
    return engine, device


def make_engine(name: str, request: EngineRequest) -> tuple[EngineEntry, Engine]:
    """Build an engine; ``auto`` is the first of those preferred on the device that can do what the scene asks for.

    Returns:
        Its entry, and the engine.

    Raises:
        SceneError: If it cannot, or none can.
    """
    if name == "auto":
        names = PREFERRED["cpu" if request.device == "cpu" else "cuda"]
        for preferred in names[:-1]:
            try:
                return make_engine(preferred, request)
            except SceneError as error:
                unexpected = isinstance(error.__cause__, KernelError)
                logger.log(logging.WARNING if unexpected else logging.INFO, "%s; taking the next engine", error)
        name = names[-1]
    entry, scene = ENGINES[name], request.scene
    steps = physics_steps(name, scene, request.compiled, request.grid)
    try:
        return entry, entry.make(request, steps)
    except (KernelError, OutOfRange) as error:
        others = [other for other in ENGINES if other != name]
        message = f"the engine {name} cannot be had: {error}"
        raise SceneError(message, key="engine.name", file=scene.path, allowed=["auto", *others]) from error


SUBSTEPS, LONGEST = 2, 0.02
"""Least number of physics steps in a step of a rollout, and their greatest length [s], where neither the scene nor an
MJCF file says anything."""


def steps_as_mujoco(name: str, scene: Scene) -> bool:
    """Return whether an engine takes MuJoCo's steps."""
    return ENGINES[name].physics and (name != EngineName.NEWTON or scene.engine.solver is Solver.MUJOCO)


def physics_steps(name: str, scene: Scene, compiled: CompiledScene, grid: TimeGrid) -> PhysicsSteps:
    """Divide the steps of a rollout into physics steps of an engine.

    Args:
        name: The engine's name. With steps of any length it divides each into equally many, as many as the first has.
        scene: The scene.
        compiled: The scene, compiled.
        grid: Steps of the rollout.

    Raises:
        SceneError: If a step is no multiple of the physics step, although that has one length in this engine.
    """
    default = max(SUBSTEPS, math.ceil(grid.dt[0] / LONGEST - 1e-6))
    substeps = compiled.substeps(scene.engine.substeps, float(grid.dt[0]), default)
    measures = scene.engine.substeps is None and compiled.timestep is not None
    if measures and steps_as_mujoco(name, scene):
        substeps = physics_step_count(scene, compiled, grid, substeps)
    if ENGINES[name].any_dt:
        return PhysicsSteps((substeps,) * grid.steps, tuple((grid.dt / substeps).tolist()))
    timestep = float(grid.dt[0]) / substeps
    count = grid.dt / timestep
    if np.abs(count - np.round(count)).max() > 1e-6:
        raise SceneError(
            f"the physics of the engine {name} takes steps of one length, {timestep:g} s (the first step / "
            "engine.substeps), and every step of a rollout must be a multiple of it",
            key="planner.dt",
            file=scene.path,
            found=[float(round(dt, 6)) for dt in grid.dt],
        )
    return PhysicsSteps(tuple(np.round(count).astype(int).tolist()), (timestep,) * grid.steps)


def newton_simulator(request: EngineRequest, steps: PhysicsSteps) -> Simulator:
    """Simulator of the engine ``newton``.

    Raises:
        SceneError: If its solver cannot do what the scene needs.
    """
    from .newton import NewtonSimulator  # slow to import, and nothing else needs it

    if request.costs.sensors:
        raise SceneError(
            "the engine newton has no sensors, but cost terms read some",
            key="engine.name",
            file=request.scene.path,
            allowed=["mujoco", "mujoco_warp"],
        )
    return NewtonSimulator(
        request.scene, request.compiled, request.shape, device=request.device, **request.worlds(steps)
    )


def mujoco_warp_simulator(request: EngineRequest, steps: PhysicsSteps) -> Simulator:
    """Simulator of the engine ``mujoco_warp``.

    Raises:
        SceneError: If MuJoCo Warp lacks what the scene needs.
    """
    from .mujoco_warp import MujocoWarpSimulator  # slow to import, and nothing else needs it

    scene, sensors = request.scene, request.costs.sensors
    return MujocoWarpSimulator(
        scene, request.compiled, request.shape, sensors=sensors, device=request.device, **request.worlds(steps)
    )


def _make_fused(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .fused import FusedEngine

    return FusedEngine(request, steps)


def _make_kinematic(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .kinematic import KinematicEngine

    return KinematicEngine(request)


def _make_mujoco(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .mujoco import MujocoSimulator, MujocoWorlds

    return SimulatorEngine(request, steps, MujocoSimulator.of, MujocoWorlds)


def _make_mujoco_warp(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    return SimulatorEngine(request, steps, mujoco_warp_simulator)


def _make_newton(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    return SimulatorEngine(request, steps, newton_simulator)


ON_GPU = {"cuda": True, "capturable": True}
register(EngineEntry(name=str(EngineName.MUJOCO), make=_make_mujoco))
register(EngineEntry(name=str(EngineName.MUJOCO_WARP), make=_make_mujoco_warp, **ON_GPU))
register(EngineEntry(name=str(EngineName.NEWTON), make=_make_newton, **ON_GPU))
register(EngineEntry(name=str(EngineName.FUSED), make=_make_fused, **ON_GPU))
register(EngineEntry(name=str(EngineName.KINEMATIC), make=_make_kinematic, any_dt=True, physics=False, **ON_GPU))
