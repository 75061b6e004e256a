# SPDX-License-Identifier: Apache-2.0
"""Which engine rolls out a scene on this machine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..model.mujoco_model import Options
from ..scene.schema import EngineName
from .mujoco import MujocoEngine

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..model.compiled import CompiledScene
    from ..model.pairs import Pair
    from ..model.properties import Properties
    from ..scene.schema import Scene
    from .trajectory import Engine, Shape


SUBSTEPS = 2
"""Physics steps per control of a rollout where neither the scene nor an MJCF file says anything."""


def resolve(scene: Scene, engine: str, device: str) -> tuple[str, str]:
    """Engine and Warp device for what a user asked for; the engine stays ``auto`` where there is a choice to measure.

    Args:
        scene: The scene, whose ``engine.name`` counts when ``engine`` is ``auto``.
        engine: ``auto``, ``mujoco`` or ``newton``.
        device: ``auto``, ``cpu`` or a CUDA device.

    Raises:
        ValueError: If engine or device is unknown, not to be had here, or the two do not go together.
    """
    engine = str(scene.engine.name) if engine == "auto" else engine
    if engine not in list(EngineName):
        raise ValueError(f"no engine '{engine}'; there is: {', '.join(EngineName)}")
    if device != "auto":
        try:
            device = str(wp.get_device(device))
        except Exception as error:  # Warp raises several kinds for a device that is not there
            have = ", ".join(str(d) for d in wp.get_devices())
            raise ValueError(f"no device '{device}' on this machine; there is: auto, {have}") from error
    cuda = wp.is_cuda_available()
    if engine == EngineName.MUJOCO:
        if device not in ("auto", "cpu"):
            raise ValueError(f"the engine mujoco runs on device cpu, not '{device}'")
        return engine, "cpu"
    if engine == EngineName.NEWTON:
        return engine, (str(wp.get_preferred_device()) if device == "auto" else device)
    if device == "cpu" or not cuda:
        return str(EngineName.MUJOCO), "cpu"
    if device != "auto":
        return str(EngineName.NEWTON), device
    return engine, str(wp.get_preferred_device())


def make_engine(
    name: str,
    scene: Scene,
    compiled: CompiledScene,
    shape: Shape,
    *,
    control_dt: float,
    device: str,
    pairs: tuple[Pair, ...] = (),
    properties: Properties | None = None,
    sensors: Collection[str] = (),
) -> Engine:
    """Build an engine.

    Args:
        name: ``mujoco`` or ``newton``.
        scene: The scene.
        compiled: The scene, compiled.
        shape: Sizes of the batch.
        control_dt: Length of a step of a rollout [s].
        device: Warp device.
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties.
        sensors: Sensors that terms read.
    """
    physics = scene.engine
    common = {
        "control_dt": control_dt,
        "substeps": compiled.substeps(physics.substeps, control_dt, SUBSTEPS),
        "pairs": pairs,
        "properties": properties,
    }
    if name == EngineName.NEWTON:
        from .newton import NewtonEngine  # slow to import, and nothing else needs it

        return NewtonEngine(scene, compiled.layout, shape, device=device, **common)
    return MujocoEngine(
        compiled,
        shape,
        threads=physics.threads,
        options=Options.of(physics),
        sensors=sensors,
        **common,
    )
