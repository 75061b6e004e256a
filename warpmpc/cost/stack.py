# SPDX-License-Identifier: Apache-2.0
"""All cost terms of a scene over all rollouts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms.view import StepView
from ..scene.errors import SceneError
from .binding import Binding
from .builtin import BUILTIN
from .resources.geodesic import Grid
from .resources.guide import Guide
from .resources.push_path import STEPS, push_value
from .term import ArrayCost, CostTerm

if TYPE_CHECKING:
    from ..engine.trajectory import Shape, Trajectory
    from ..model.layout import Layout
    from ..scene.schema import Scene


_CELL = 0.05
"""Cell of distance fields and of the search for ways to push [m]; a fifth of a pushed object if that is less, ..."""
_LEAST_CELL = 0.01
"""... down to this: memory and time of the search grow with its square."""
_PUSH_MARGIN = 30
"""Cells around everything in the scene in which ways to push are searched."""


class CostStack:
    """The cost terms of a scene, bound to its layout; :meth:`launch` writes every term's stage costs.

    Args:
        scene: The scene.
        layout: Its layout.
        terms: Users' own terms, next to the built-in ones.
        device: Warp device of the rollouts.

    Raises:
        SceneError: If a term, one of its keys, or a frame or entity they name does not exist.
    """

    def __init__(
        self, scene: Scene, layout: Layout, *, terms: Sequence[CostTerm | ArrayCost] = (), device: str = "cpu"
    ):
        self.layout, self.device = layout, device
        known = {**BUILTIN, **{term.name: term for term in terms}}
        self.labels = _unique([cost.label for cost in scene.cost])
        self._terms: list[CostTerm | ArrayCost] = []
        self._params: list[Any] = []
        binding = Binding(scene, layout)
        with wp.ScopedDevice(device):
            for label, cost in zip(self.labels, scene.cost, strict=True):
                binding.key = f"cost.{label}"
                if cost.term not in known:
                    raise SceneError(
                        "no such cost term", key=f"{binding.key}.term", file=scene.path, found=cost.term, allowed=known
                    )
                term = known[cost.term]
                self._terms.append(term)
                self._params.append(
                    term.bind(cost.params, binding) if isinstance(term, CostTerm) else dict(cost.params)
                )
        self.pairs = tuple(binding.pairs)
        self.sensors = tuple(dict.fromkeys(binding.sensors))
        self._kernels = [term.kernel() if isinstance(term, CostTerm) else None for term in self._terms]
        self.weight = wp.array([cost.weight for cost in scene.cost], dtype=float, device=device)
        self._weights = [cost.weight for cost in scene.cost]
        self._fields = binding.fields
        self._push_paths = binding.push_paths
        self._grid = self._make_grid(scene, binding.supports) if self._fields or self._push_paths else None

    def _make_grid(self, scene: Scene, supports: set[str]) -> Grid:
        starts = [item.position[:2] for item in (*scene.object, *scene.robot)]
        layout = self.layout
        for robot in scene.robot:
            moving = [j for j in layout.entity(robot.name).joints if layout.joint_dof_dim[j].any()]
            axes = "".join("xr"[i] * n for j in moving for i, n in enumerate(layout.joint_dof_dim[j]))
            if axes.startswith("xx"):  # a base that moves in the plane
                q = layout.joint_q_start[moving[0]]
                starts.append(np.add(robot.position[:2], layout.joint_q[q : q + 2]))
        points = np.array([scene.goal.position[:2], *starts], dtype=float)
        if not self._push_paths:
            return Grid(layout, points, supports=supports, cell=_CELL)
        requests = [request for _, request in self._push_paths]
        cell = max(min(_CELL, *(0.4 * min(r.half_size) for r in requests)), _LEAST_CELL)
        room = max([f.inflation for f in self._fields] + [r.inflation + r.length for r in requests])
        margin = max(_PUSH_MARGIN * cell, room + 5 * cell)
        return Grid(layout, points, supports=supports, cell=cell, margin=margin)

    @property
    def capturable(self) -> bool:
        """Whether every term is a kernel, so that a CUDA graph can hold them all."""
        return not any(isinstance(term, ArrayCost) for term in self._terms)

    def set_weight(self, label: str, weight: float) -> None:
        """Change the weight of a term; takes effect at the next plan.

        Raises:
            ValueError: If there is no such term, or the weight is not finite.
        """
        if label not in self.labels:
            raise ValueError(f"no cost term '{label}'; there is: {', '.join(self.labels)}")
        if not np.isfinite(weight):
            raise ValueError(f"a weight is a finite number, not {weight}")
        self._weights[self.labels.index(label)] = float(weight)
        self.weight.assign(np.array(self._weights, dtype=np.float32))

    def attach(self, trajectory: Trajectory, control: wp.array, shape: Shape) -> None:
        """Point the terms at the rollouts they judge.

        Args:
            trajectory: Recorded rollouts.
            control: Controls ``[T, W, nu]``.
            shape: Sizes of the batch.
        """
        layout, device = self.layout, self.device
        self.shape = shape
        self.cost = wp.zeros((len(self._terms), shape.horizon, shape.worlds), dtype=float, device=device)
        self.goal = wp.zeros(shape.envs, dtype=wp.transform, device=device)
        self.last_control = wp.zeros((shape.envs, layout.nu), dtype=float, device=device)
        view = StepView()
        view.joint_q, view.joint_qd = trajectory.joint_q, trajectory.joint_qd
        view.body_q, view.body_qd = trajectory.body_q, trajectory.body_qd
        view.force, view.controls = trajectory.contact_force, control
        view.sensor = trajectory.sensor
        view.last_control, view.goal = self.last_control, self.goal
        half_range = 0.5 * (layout.control_upper - layout.control_lower)
        view.control_scale = wp.array(half_range, dtype=float, device=device)
        view.frame_body = wp.array(layout.frame_body, dtype=int, device=device)
        view.frame_pose = wp.array(layout.frame_pose, dtype=wp.transform, device=device)
        view.fields = len(self._fields)
        self._guide = None
        if self._fields:
            self._guide = Guide(self._grid, self._fields, layout, envs=shape.envs, device=device)
            view.field, view.field_center = self._guide.field, self._guide.center
            view.field_origin, view.field_cell = wp.vec2(*self._grid.origin), self._grid.cell
        for params, _ in self._push_paths:
            side = self._grid.size(self._grid.clearance.shape)
            size = (shape.envs, len(STEPS), side, side)
            params.value = wp.zeros(size, dtype=float, device=device)
            params.origin = wp.zeros(shape.envs, dtype=wp.vec2, device=device)
            params.cell = self._grid.cell
        self._aims = np.full((shape.envs, 7), np.nan)
        self.view, self._trajectory, self._control = view, trajectory, control

    def reset(self) -> None:
        """Forget where the targets of distance fields were."""
        if self._guide is not None:
            self._guide.reset()

    def set_goal(self, pose: np.ndarray) -> None:
        """Set the goal poses ``[E, 7]``."""
        self.goal.assign(np.asarray(pose, dtype=np.float32).reshape(-1, 7))

    def aim(self, goal: np.ndarray) -> None:
        """Search the ways to push to new goals, on the host: some tenths of a second for each goal that moved.

        Args:
            goal: Goal poses ``[E, 7]``.
        """
        for e in np.flatnonzero((self._aims != goal).any(axis=1)) if self._push_paths else ():
            x, y, z, w = goal[e, 3:]
            heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            for params, request in self._push_paths:
                value, origin = push_value(self._grid, request, goal[e, :2], heading)
                params.value[int(e)].assign(value.astype(np.float32))
                params.origin[int(e) : int(e) + 1].assign(origin[None].astype(np.float32))
            self._aims[e] = goal[e]

    def guide(self) -> None:
        """Bring the distance fields up to date with the observed state in slice 0 of the trajectory."""
        if self._guide is not None:
            self._guide.launch(self._trajectory.body_q, self.goal, self.shape.rollouts)

    def launch(self) -> None:
        """Evaluate every term at every step of every world into :attr:`cost` ``[term, T, W]``, weighted."""
        for i, (term, kernel, params) in enumerate(zip(self._terms, self._kernels, self._params, strict=True)):
            if isinstance(term, ArrayCost):
                self._evaluate(i, term, params)
                continue
            wp.launch(
                kernel,
                dim=self.cost.shape[1:],
                inputs=[self.view, params, self.weight, i, self.shape.rollouts],
                outputs=[self.cost],
                device=self.device,
            )

    def _evaluate(self, i: int, term: ArrayCost, params: dict[str, Any]) -> None:
        """Evaluate a term over whole arrays."""
        out = self._trajectory
        batch = {
            "joint_q": out.joint_q,
            "joint_qd": out.joint_qd,
            "body_q": out.body_q,
            "body_qd": out.body_qd,
            "contact_force": out.contact_force,
            "sensor": out.sensor,
            "control": self._control,
            "goal": self.goal,
        }
        if self.device == "cpu":
            batch = {name: array.numpy() for name, array in batch.items()}
        value = term.function({**batch, "params": params})
        if tuple(value.shape) != tuple(self.cost.shape[1:]):
            raise SceneError(
                "this cost term returned an array of the wrong shape",
                key=f"cost.{self.labels[i]}",
                found=tuple(value.shape),
                allowed=f"[T, W] = {tuple(self.cost.shape[1:])}",
            )
        if self.device == "cpu":
            self.cost[i].assign(np.asarray(value, dtype=np.float32) * self._weights[i])
        else:
            wp.copy(self.cost[i], wp.from_dlpack((value * self._weights[i]).contiguous()))


def _unique(labels: list[str]) -> list[str]:
    """Labels with a number behind those that occur again."""
    seen: dict[str, int] = {}
    out = []
    for label in labels:
        seen[label] = seen.get(label, 0) + 1
        out.append(label if seen[label] == 1 else f"{label}_{seen[label]}")
    return out
