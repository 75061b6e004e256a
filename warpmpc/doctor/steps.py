# SPDX-License-Identifier: Apache-2.0
"""Physics steps that are longer than an MJCF file's own, and the error that they make over a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..engine.mujoco import MujocoSimulator
from ..engine.registry import physics_steps
from ..launch import capturing
from ..model.batch_size import BatchSize
from ..model.layout import rotate
from ..model.mujoco_model import Options
from ..plant.foresight import takes_mujoco_steps
from ..task.observed import ObservedState
from .subject import Finding

if TYPE_CHECKING:
    from ..controller.controller import Controller

FAR = 0.75
"""Error, as a share of the way of the body that goes farthest, from which a step is a mistake."""
SMALL = 0.05
"""Error that is none [m]."""


@dataclass(frozen=True)
class StepError:
    """Difference that the planner's physics step makes over one plan."""

    step: float
    """The planner's physics step [s]."""
    wanted: float
    """Timestep of the MJCF file [s]."""
    ahead: float
    """Length of the plan [s]."""
    body: str
    """Body that ends farthest from where it ends with the file's timestep."""
    error: float
    """Distance between these ends [m]; infinite where the rollout with the planner's step diverges."""
    moved: float
    """Distance of the body that moves most from its start [m]."""

    def __str__(self) -> str:
        effect = "makes it diverge" if np.isinf(self.error) else f"moves {self.body} by {self.error:.2g} m"
        steps = f"{1e3 * self.step:.3g} ms where the file says {1e3 * self.wanted:.3g} ms"
        return f"{steps}; over {self.ahead:.3g} s of the plan this {effect}"

    @property
    def finding(self) -> Finding | None:
        """The finding where the error is large, else None."""
        if self.error <= max(SMALL, FAR * self.moved):
            return None
        return Finding(
            "engine.substeps",
            f"physics steps of {self}: plans are made for another motion",
            f"raise engine.substeps up to {round(self.step / self.wanted)}-fold, or shorten planner.dt",
        )


def step_error(controller: Controller) -> StepError | None:
    """Roll the mean of a plan out with the planner's physics step and with the file's.

    Args:
        controller: It has made a plan from the scene's start.

    Returns:
        The difference; None where no step is longer than an MJCF file's, the engine takes other steps, or the file's
        own steps diverge.
    """
    scene, compiled, grid = controller.scene, controller.compiled, controller.plan_step.grid
    if compiled.timestep is None or not takes_mujoco_steps(controller.engine.name, scene):
        return None
    steps = physics_steps(controller.engine.name, scene, compiled, grid)
    finer = round(steps.length[0] / compiled.timestep)
    if finer < 2:
        return None
    control = controller.rollout(0).control
    coarse, fine = (_paths(controller, control, steps.count, steps.length[0], n) for n in (1, finer))
    if not np.isfinite(fine).all():
        return None
    apart = np.linalg.norm(coarse[-1] - fine[-1], axis=-1)
    moved = np.linalg.norm(fine[-1] - fine[0], axis=-1).max()
    body = int(np.argmax(apart))
    name = controller.layout.body_name[body]
    return StepError(steps.length[0], compiled.timestep, float(grid.t[-1]), name, float(apart[body]), float(moved))


def _paths(
    controller: Controller, control: np.ndarray, count: tuple[int, ...], length: float, finer: int
) -> np.ndarray:
    """Centres of mass of all bodies over a rollout of controls ``[T, nu]`` from the start: ``[T+1, nb, 3]``."""
    shape, layout = BatchSize(1, 1, 1, len(control)), controller.layout
    with capturing:  # nothing may be allocated while a controller records its plan
        simulator = MujocoSimulator(
            controller.compiled,
            shape,
            substeps=[finer * n for n in count],
            timestep=length / finer,
            options=Options.of(controller.scene.engine),
            sensors=(),
            threads=1,
        )
        simulator.trajectory.control.assign(control[:, None].astype(np.float32))
        simulator.clone(ObservedState.allocate(layout, controller.task, "cpu"))
        simulator.rollout(simulator.trajectory.control)
        poses = simulator.trajectory.body_q.numpy()[:, 0].astype(float)
        paths = poses[..., :3] + rotate(poses[..., 3:], layout.body_com)
        if simulator.trajectory.diverged.numpy()[0]:
            paths[-1] = np.inf
        simulator.close()
    return paths
