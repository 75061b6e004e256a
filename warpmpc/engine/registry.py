# SPDX-License-Identifier: Apache-2.0
"""The engines by name: what each runs on, what it can do, and how one is made."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..bake.lines import OutOfRange
from ..compiling import KernelError
from ..registry import ENGINES
from ..scene.errors import SceneError
from ..scene.schema import EngineName, Solver
from .evaluation import SimulatorEngine
from .physics_step import physics_step_count
from .request import EngineRequest, PhysicsSteps

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene
    from .protocol import Engine, Simulator
    from .timegrid import TimeGrid

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
    "cuda": (str(EngineName.FUSED), str(EngineName.NEWTON)),
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
        ValueError: If engine or device is unknown, not to be had here, or the two do not go together.
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
    if measures and ENGINES[name].physics and scene.engine.solver is Solver.MUJOCO:
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
    """Simulator of the engine ``newton``, with the solver that the scene asks for.

    Raises:
        SceneError: If the solver cannot do what the scene needs.
    """
    # slow to import, and nothing else needs them
    from .mujoco_warp import MujocoWarpSimulator
    from .newton import NewtonSimulator

    scene, sensors = request.scene, request.costs.sensors
    common = {"device": request.device, **request.worlds(steps)}
    scene_of = (scene, request.compiled, request.shape)
    if scene.engine.solver is Solver.MUJOCO:
        return MujocoWarpSimulator(*scene_of, sensors=sensors, **common)
    if sensors:
        raise SceneError(
            "this solver has no sensors, but cost terms read some",
            key="engine.solver",
            file=scene.path,
            found=str(scene.engine.solver),
            allowed=["mujoco"],
        )
    return NewtonSimulator(*scene_of, **common)


def _make_fused(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .fused import FusedEngine

    return FusedEngine(request, steps)


def _make_kinematic(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .kinematic import KinematicEngine

    return KinematicEngine(request)


def _make_mujoco(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    from .mujoco import MujocoSimulator, MujocoWorlds

    return SimulatorEngine(request, steps, MujocoSimulator.of, MujocoWorlds)


def _make_newton(request: EngineRequest, steps: PhysicsSteps) -> Engine:
    return SimulatorEngine(request, steps, newton_simulator)


ON_GPU = {"cuda": True, "capturable": True}
register(EngineEntry(name=str(EngineName.MUJOCO), make=_make_mujoco))
register(EngineEntry(name=str(EngineName.NEWTON), make=_make_newton, **ON_GPU))
register(EngineEntry(name=str(EngineName.FUSED), make=_make_fused, **ON_GPU))
register(EngineEntry(name=str(EngineName.KINEMATIC), make=_make_kinematic, any_dt=True, physics=False, **ON_GPU))
