# SPDX-License-Identifier: Apache-2.0
"""The controller: observe → plan → command."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cost.stack import CostStack
from ..engine.registry import make_engine, resolve
from ..engine.trajectory import Shape
from ..kernels.worlds.exchange import REPORT
from ..model.compiled import CompiledScene, compile_scene
from ..model.properties import draw_properties
from ..model.state import Info, State
from ..planner.graph import PlanGraph
from ..planner.plan import PlanStep, step_dt
from ..task.goal import goal_pose

if TYPE_CHECKING:
    from ..cost.term import ArrayCost, CostTerm
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")


class Controller:
    """Plans the next control of a scene's robots from its observed state.

    With several environments it solves as many independent problems in one go: states, goals and controls then have
    a leading axis ``[E]``, and :attr:`info` is a tuple. All environments share noise and randomized worlds.

    Args:
        scene: The scene, from :func:`warpmpc.load_scene` or built in Python.
        engine: ``"mujoco"``, ``"newton"``, or ``"auto"``: with a GPU the faster of the two, measured once.
        device: ``"cpu"``, a CUDA device such as ``"cuda:0"``, or ``"auto"``.
        seed: Seed of noise and randomized worlds; on the CPU the same seed gives the same commands on the same machine.
        envs: Number of environments E.
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
        envs: int = 1,
        terms: Sequence[CostTerm | ArrayCost] = (),
        compiled: CompiledScene | None = None,
    ):
        if envs < 1:
            raise ValueError(f"a controller has at least one environment, not {envs}")
        name, device = resolve(scene, engine, device)
        self.scene, self.seed, self.envs = scene, seed, envs
        self.compiled = compiled or compile_scene(scene)
        if name == "auto":
            from ..run.choose_engine import fastest

            name, device = fastest(scene, self.compiled, device, envs=envs, terms=terms)
        self.layout = self.compiled.layout
        planner = scene.planner
        self.shape = Shape(envs, planner.samples, planner.domains, planner.horizon)
        self.costs = CostStack(scene, self.layout, terms=terms, device=device)
        draws = planner.domains if planner.domains > 1 else planner.samples
        properties = draw_properties(scene, self.layout, draws, seed=2 * seed) if planner.randomize else None
        self.engine = make_engine(
            name,
            scene,
            self.compiled,
            self.shape,
            control_dt=step_dt(scene),
            device=device,
            pairs=self.costs.pairs,
            sensors=self.costs.sensors,
            properties=properties,
        )
        self.plan = PlanStep(scene, self.layout, self.shape, self.engine, self.costs, seed=seed)
        self.graph = PlanGraph(self.plan)
        # the last finite observation of every environment
        self._hold_q = np.tile(self.layout.joint_q, (envs, 1))
        self._hold_qd = np.tile(self.layout.joint_qd, (envs, 1))
        self._warned_of_overflow = False
        self._last: tuple[State, np.ndarray, np.ndarray, float] | None = None
        self._info: Info | tuple[Info, ...] | None = None
        self.goal = np.empty((envs, 7), dtype=np.float32)
        """Goal poses ``[E, 7]`` (x, y, z, qx, qy, qz, qw); change them with :meth:`set_goal`."""
        self.set_goal(goal_pose(scene))

    @property
    def device(self) -> str:
        """Device the rollouts run on."""
        return self.engine.device

    @property
    def info(self) -> Info | tuple[Info, ...] | None:
        """What the last plan did, one per environment when there are several; None before the first."""
        if self._info is None and self._last is not None:
            state, rows, fallback, plan_ms = self._last
            infos = tuple(self._describe(state, e, rows[e], bool(fallback[e]), plan_ms) for e in range(self.envs))
            self._info = infos if np.ndim(state.joint_q) == 2 else infos[0]
        return self._info

    def set_goal(self, pose: np.ndarray) -> None:
        """Move the goal; takes effect at the next plan.

        Args:
            pose: Pose ``[7]`` of every environment, or ``[E, 7]`` (x, y, z, qx, qy, qz, qw); quaternions are
                normalized.

        Raises:
            ValueError: If a pose is not seven finite numbers, or its quaternion is zero.
        """
        pose = np.array(pose, dtype=np.float32)
        right = pose.shape in ((7,), (self.envs, 7))
        if not right or not np.isfinite(pose).all() or not pose[..., 3:].any(axis=-1).all():
            raise ValueError(f"a goal is a pose of seven finite numbers (x, y, z, qx, qy, qz, qw), not {pose}")
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        self.goal[:] = pose
        self.costs.aim(self.goal)

    def set_weight(self, term: str, weight: float) -> None:
        """Change the weight of a cost term; takes effect at the next plan.

        Raises:
            ValueError: If there is no such term, or the weight is not finite.
        """
        self.costs.set_weight(term, weight)

    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``; takes effect at the next plan.

        Raises:
            ValueError: If they have the wrong shape, are not finite, or cross.
        """
        lower, upper = np.asarray(lower, dtype=np.float32), np.asarray(upper, dtype=np.float32)
        right = (
            lower.shape == upper.shape == (self.layout.nu,) and np.isfinite(lower).all() and np.isfinite(upper).all()
        )
        if not right or (lower >= upper).any():
            raise ValueError(f"limits are {self.layout.nu} finite numbers each, lower below upper")
        self.plan.lower.assign(lower)
        self.plan.upper.assign(upper)

    def reset(self) -> None:
        """Forget every earlier plan, as if just constructed."""
        self.plan.reset()
        self._last = self._info = None

    def step(self, state: State) -> np.ndarray:
        """Plan from an observed state.

        Args:
            state: Observed state, ``joint_q [nq]`` and ``joint_qd [nv]``; ``[E, nq]`` and ``[E, nv]`` with several
                environments.

        Returns:
            Control ``[nu]``, or ``[E, nu]``, to apply now, within its limits. Where no rollout survives (a diverged
            simulation, a NaN in the observation) it is the safe command: zero velocity, zero effort, or the held
            position; :attr:`info` says so and a warning is logged.

        Raises:
            ValueError: If the state has the wrong shape.
        """
        q, qd = self._checked(state)
        start = time.perf_counter()
        finite = np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1)
        self._hold_q[finite], self._hold_qd[finite] = q[finite], qd[finite]
        nu = self.layout.nu
        if finite.any():
            report = self.graph(self._hold_q, self._hold_qd, self.goal)
            command, rows = report[:, :nu].copy(), report[:, nu:].astype(float)
        else:
            command, rows = np.zeros((self.envs, nu), np.float32), np.full((self.envs, int(REPORT)), np.nan)
        fallback = ~finite | ~np.isfinite(rows[:, 2])
        if fallback.any():
            command[fallback] = self._safe_command()[fallback]
            self.plan.costs.last_control.assign(command)
            logger.warning(
                "t = %.2f s: %s; sending the safe command",
                state.time,
                "the observation is not finite" if not finite.all() else "every rollout diverged",
            )
        plan_ms = 1e3 * (time.perf_counter() - start)
        if finite.any():
            self._warn_of_overflow(rows)
        self._last, self._info = (state, rows, fallback, plan_ms), None
        return command if np.ndim(state.joint_q) == 2 else command[0]

    def _checked(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Joint coordinates and velocities with a leading axis [E]."""
        q, qd = np.asarray(state.joint_q, dtype=np.float32), np.asarray(state.joint_qd, dtype=np.float32)
        nq, nv = self.layout.nq, self.layout.nv
        many = (q.shape, qd.shape) == ((self.envs, nq), (self.envs, nv))
        if not many and not (self.envs == 1 and (q.shape, qd.shape) == ((nq,), (nv,))):
            lead = f"{self.envs}, " if self.envs > 1 else ""
            raise ValueError(
                f"a state of this scene has joint_q [{lead}{nq}] and joint_qd [{lead}{nv}], "
                f"not {list(q.shape)} and {list(qd.shape)}"
            )
        return q.reshape(self.envs, nq), qd.reshape(self.envs, nv)

    def _safe_command(self) -> np.ndarray:
        """Zero velocity or effort; the present position where a drive holds positions; ``[E, nu]``."""
        held = self.layout.control_safe
        safe = np.where(held >= 0, self._hold_q[:, np.maximum(held, 0)], 0.0)
        return np.clip(safe, self.layout.control_lower, self.layout.control_upper).astype(np.float32)

    def _warn_of_overflow(self, rows: np.ndarray) -> None:
        if not self._warned_of_overflow and (bits := int(rows[:, 5].max())):
            self._warned_of_overflow = True
            logger.warning("%s", self.engine.overflow_message(bits))

    def _describe(self, state: State, e: int, row: np.ndarray, fallback: bool, plan_ms: float) -> Info:
        """Row e of the report, in words; without a plan it is all NaN."""
        planned = not np.isnan(row[2])
        sample, diverged = (int(row[3]), int(row[4])) if planned else (0, 0)
        terms = row[int(REPORT) :] if planned else [np.nan] * len(self.costs.labels)
        return Info(
            time=state.time,
            beta=float(row[0] if planned else self.plan.weights.beta.numpy()[e]),
            eta=0.0 if fallback else float(row[1]),
            cost=float("inf") if fallback else float(row[2]),
            terms={label: float(value) for label, value in zip(self.costs.labels, terms, strict=True)},
            best=(e * self.shape.samples + sample) * self.shape.domains,
            plan_ms=plan_ms,
            stages_ms={name: 1e3 * seconds for name, seconds in self.graph.stages.items()},
            diverged_worlds=diverged,
            fallback=fallback,
        )
