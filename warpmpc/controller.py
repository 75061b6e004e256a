# SPDX-License-Identifier: Apache-2.0
"""The controller: observe → plan → command."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .cost.stack import CostStack
from .engine.compiled import CompiledScene, compile_scene
from .engine.mujoco import MujocoEngine
from .engine.properties import draw_properties
from .engine.trajectory import ObservedState, Shape
from .goal import goal_pose
from .planner.plan import PlanStep, step_dt
from .state import Info, State

if TYPE_CHECKING:
    from .cost.term import ArrayCost, CostTerm
    from .scene.schema import Scene

logger = logging.getLogger("warpmpc")


class Controller:
    """Plans the next control of a scene's robots from its observed state.

    Args:
        scene: The scene, from :func:`warpmpc.load_scene` or built in Python.
        engine: ``"mujoco"``, or ``"auto"`` for the fastest one this machine has.
        device: ``"cpu"``, or ``"auto"``.
        seed: Seed of noise and randomized worlds; the same seed gives the same commands on the same machine.
        terms: Users' own cost terms that the scene names.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: If the scene names anything that does not exist.
        ValueError: If the engine or device is unknown or not to be had here.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        engine: str = "auto",
        device: str = "auto",
        seed: int = 0,
        terms: Sequence[CostTerm | ArrayCost] = (),
        compiled: CompiledScene | None = None,
    ):
        engine = str(scene.engine.name) if engine == "auto" else engine
        if engine not in ("auto", "mujoco"):
            raise ValueError(f"no engine '{engine}'; there is: auto, mujoco")
        if device not in ("auto", "cpu"):
            raise ValueError(f"the engine mujoco runs on device cpu, not '{device}'")
        self.scene, self.seed = scene, seed
        self.compiled = compiled or compile_scene(scene)
        self.layout = self.compiled.layout
        planner, physics = scene.planner, scene.engine
        self.shape = Shape(1, planner.samples, planner.domains, planner.horizon)
        self.costs = CostStack(scene, self.layout, terms=terms, device="cpu")
        draws = planner.domains if planner.domains > 1 else planner.samples
        self.engine = MujocoEngine(
            self.compiled,
            self.shape,
            control_dt=step_dt(scene),
            substeps=physics.substeps,
            pairs=self.costs.pairs,
            properties=draw_properties(scene, self.layout, draws, seed=2 * seed),
            threads=physics.threads,
            iterations=physics.iterations,
            tolerance=physics.tolerance,
        )
        self.plan = PlanStep(scene, self.layout, self.shape, self.engine, self.costs, seed=seed)
        self._observed = ObservedState(
            wp.zeros((1, self.layout.nq), dtype=float, device="cpu"),
            wp.zeros((1, self.layout.nv), dtype=float, device="cpu"),
        )
        self._hold = self.layout.joint_q.copy()
        self.info: Info | None = None
        """What the last plan did."""
        self.set_goal(goal_pose(scene))

    @property
    def device(self) -> str:
        """Device the rollouts run on."""
        return self.engine.device

    def set_goal(self, pose: np.ndarray) -> None:
        """Move the goal; takes effect at the next plan.

        Args:
            pose: Pose ``[7]`` (x, y, z, qx, qy, qz, qw); the quaternion is normalized.

        Raises:
            ValueError: If the pose is not seven finite numbers, or its quaternion is zero.
        """
        pose = np.array(pose, dtype=np.float32)
        if pose.shape != (7,) or not np.isfinite(pose).all() or not pose[3:].any():
            raise ValueError(f"a goal is a pose of seven finite numbers (x, y, z, qx, qy, qz, qw), not {pose}")
        pose[3:] /= np.linalg.norm(pose[3:])
        self.costs.set_goal(pose[None])

    def reset(self) -> None:
        """Forget every earlier plan, as if just constructed."""
        self.plan.reset()
        self.info = None

    def step(self, state: State) -> np.ndarray:
        """Plan from an observed state.

        Args:
            state: Observed state, ``joint_q [nq]`` and ``joint_qd [nv]``.

        Returns:
            Control ``[nu]`` to apply now, within its limits. When no rollout survives (a diverged simulation, a NaN
            in the observation) it is the safe command: zero velocity, zero effort, or the held position;
            :attr:`info` says so and a warning is logged.

        Raises:
            ValueError: If the state has the wrong shape.
        """
        q, qd = np.asarray(state.joint_q, dtype=np.float32), np.asarray(state.joint_qd, dtype=np.float32)
        if q.shape != (self.layout.nq,) or qd.shape != (self.layout.nv,):
            raise ValueError(
                f"a state of this scene has joint_q [{self.layout.nq}] and joint_qd [{self.layout.nv}], "
                f"not {list(q.shape)} and {list(qd.shape)}"
            )
        start = time.perf_counter()
        finite = bool(np.isfinite(q).all() and np.isfinite(qd).all())
        if finite:
            self._hold = q
            self._observed.joint_q.assign(q[None])
            self._observed.joint_qd.assign(qd[None])
            self.plan(self._observed)
        command, costs = self.plan.command.numpy()[0].copy(), self.plan.weights.cost.numpy()[0]
        fallback = not finite or not np.isfinite(costs).any()
        if fallback:
            command = self._safe_command()
            self.plan.costs.last_control.assign(command[None])
            logger.warning(
                "t = %.2f s: %s; sending the safe command",
                state.time,
                "every rollout diverged" if finite else "the observation is not finite",
            )
        self.info = self._describe(state, costs, fallback, 1e3 * (time.perf_counter() - start))
        return command

    def _safe_command(self) -> np.ndarray:
        """Zero velocity or effort; the present position where a drive holds positions."""
        held = self.layout.control_safe
        safe = np.where(held >= 0, self._hold[np.maximum(held, 0)], 0.0)
        return np.clip(safe, self.layout.control_lower, self.layout.control_upper).astype(np.float32)

    def _describe(self, state: State, costs: np.ndarray, fallback: bool, plan_ms: float) -> Info:
        sample = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        world = sample * self.shape.domains
        discount = self.scene.planner.discount ** np.arange(self.shape.horizon)
        terms = self.costs.cost.numpy()[:, :, world] @ discount
        return Info(
            time=state.time,
            beta=float(self.plan.weights.beta.numpy()[0]),
            eta=0.0 if fallback else float(self.plan.weights.eta.numpy()[0]),
            cost=float("inf") if fallback else float(costs[sample]),
            terms={label: float(value) for label, value in zip(self.costs.labels, terms, strict=True)},
            best=world,
            plan_ms=plan_ms,
            stages_ms={name: 1e3 * seconds for name, seconds in self.plan.stages.items()},
            diverged_worlds=int(np.count_nonzero(self.engine.trajectory.diverged.numpy())),
            fallback=fallback,
        )
