# SPDX-License-Identifier: Apache-2.0
"""Variables of source on one state of a rollout: joints, frames, velocities, poses of the task.

Names in the source: ``q3`` is a joint coordinate, ``v3``, ``a3`` and ``b3`` velocity and acceleration of a degree of
freedom and its acceleration one step before, ``c3`` and ``d3`` a control and the one before, ``dt`` the length of the
step [s], ``gap`` the time between its middle and the middle of the one before, ``left`` how much of the horizon there
is when it begins, ``h`` its number, ``e`` the environment; ``s`` is the :class:`~warpmpc.StepView`, whose arrays of
states are not there, ``p`` holds the parameters of all terms.

Source of cost terms that a rollout evaluates on its way: written by any engine, around its own state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...kernels.cost.view import TASK_BODY
from ...kernels.geometry.kinematics import FREE
from ...physics.runtime.bake import Lines, Matrix, Operand, Vector, known, text
from ...scene.model.layout import IDENTITY
from .tree import Given, KinematicsSource, Place

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from .tree import Axis


class Refused(Exception):
    """A construct or a part of the state that source has not, which keeps a term out of the launch."""


@dataclass(frozen=True)
class FrameCode:
    """Pose of a frame."""

    columns: Matrix
    """Of its rotation."""
    position: Vector
    place: Place | None
    """Its body's chain of axes and its fixed pose in it; None for poses of the task."""


class StateCode:
    """Source of one state: statements that terms share, each written when it is first asked for.

    Args:
        layout: Layout of the scene, targets included.
        moving: Degrees of freedom that controls move; all others stand still.
        quaternions: Whether bodies' orientations are wanted as quaternions, too.
    """

    def __init__(self, layout: Layout, moving: frozenset[int], *, quaternions: bool = False):
        self.layout, self.moving = layout, moving
        self.once = Lines("u")
        """Statements that come once, before the first step: what is the same for all steps."""
        self.lines = Lines("e")
        """Statements of every state."""
        self.kept: dict[str, str] = {}
        """Values of a state that the next one asks for, and what they are called then."""
        self.held: dict[str, str] = {}
        """Values of the observed state that all others ask for, and what they are called."""
        self._moving_coordinates = {int(layout.dof_coord[dof]) for dof in moving}
        self._known: dict[object, object] = {}
        self.tree = KinematicsSource(layout, self.lines, self.coordinate, self._joint, quaternions=quaternions)

    def coordinate(self, i: int) -> str:
        """Joint coordinate i [m or rad]."""
        if i not in self._moving_coordinates:
            return self._cached(("q", i), lambda: self.once.let(f"(T)q_start[{i}]"))
        return f"q{i}"

    def speed(self, dof: int) -> Operand:
        """Joint velocity [m/s or rad/s]."""
        return f"v{dof}" if dof in self.moving else 0.0

    def acceleration(self, dof: int) -> Operand:
        """Joint acceleration during the step [m/s² or rad/s²]."""
        return f"a{dof}" if dof in self.moving else 0.0

    def acceleration_before(self, dof: int) -> Operand:
        """Joint acceleration during the step before [m/s² or rad/s²].

        Before the first step stands the control that acts now; without drives of accelerations the first step's own.
        """
        return f"b{dof}" if dof in self.moving else 0.0

    def frame(self, index: int) -> FrameCode:
        """A frame of the layout."""
        return self._cached(("frame", index), lambda: self._frame(index))

    def body_point(self, body: int, at: np.ndarray) -> Vector:
        """A point of a body or of a pose of the task, given in its own frame, in the world's [m]."""
        at = np.asarray(at, dtype=float)
        return self._cached(("point", body, *at.tolist()), lambda: self._point(body, at))

    def _point(self, body: int, at: np.ndarray) -> Vector:
        if body <= int(TASK_BODY):
            given = self.task_pose(int(TASK_BODY) - body)
            return self.lines.transform(given.rotation, known(at), given.position)
        return self.tree.point(self.tree.place(body), at)

    def body_columns(self, body: int) -> Matrix:
        """Columns of a body's rotation."""
        return self.tree.columns(self.tree.place(body))

    def sensor(self, index: int) -> Operand:
        """A number of the sensors, in the sensor's own unit."""
        raise Refused(f"number {index} of the sensors")

    def force(self, pair: int) -> Vector:
        """Mean contact force on the first of a watched pair during the step, in the world's frame [N]."""
        raise Refused(f"the force of pair {pair}")

    def point_velocity(self, body: int, at: np.ndarray) -> tuple[Vector, Vector]:
        """Velocity of such a point [m/s], and its body's angular velocity [rad/s]."""
        if body < 0:
            return [0.0] * 3, [0.0] * 3
        place, point = self.tree.place(body), self.body_point(body, at)
        key = ("point velocity", body, *np.asarray(at, dtype=float).tolist())
        return self._cached(key, lambda: self.tree.velocity(place, point, self.speed))

    def before(self, value: Operand) -> Operand:
        """Shared value one step before; before the first step, in the observed state."""
        if value not in self.lines.names:  # known, or the same at all steps
            return value
        return self.kept.setdefault(value, f"was_{value}")

    def at_start(self, value: Operand) -> Operand:
        """Shared value in the observed state."""
        if value not in self.lines.names:  # known, or the same at all steps
            return value
        return self.held.setdefault(value, f"first_{value}")

    def free_start(self, body: int) -> int | None:
        """First joint coordinate of a body that moves freely, whose pose these coordinates are; None for others."""
        layout = self.layout
        joint = int(np.flatnonzero(layout.joint_child == body)[0])
        free = int(layout.joint_type[joint]) == int(FREE) and int(layout.joint_parent[joint]) < 0
        anchors = np.stack([layout.joint_pose_parent[joint], layout.joint_pose_child[joint]])
        return int(layout.joint_q_start[joint]) if free and (anchors == IDENTITY).all() else None

    def velocity(self, index: int) -> tuple[Vector, Vector]:
        """Velocity of a frame's origin [m/s], and its angular velocity [rad/s]."""
        frame = self.frame(index)
        if frame.place is None:
            return [0.0] * 3, [0.0] * 3
        return self._cached(("velocity", index), lambda: self.tree.velocity(frame.place, frame.position, self.speed))

    def _cached(self, key: object, make: Callable[[], object]) -> object:
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]

    def _frame(self, index: int) -> FrameCode:
        layout, body = self.layout, int(self.layout.frame_body[index])
        at = layout.frame_pose[index].astype(float)
        if body <= int(TASK_BODY):
            given = self.task_pose(int(TASK_BODY) - body)
            return FrameCode(given.rotation, given.position, None)
        place = self.tree.place(body).moved(Rotation.from_quat(at[3:]).as_matrix(), at[:3])
        return FrameCode(self.tree.columns(place), self.tree.position(place), place)

    def scalar(self, index: int) -> str:
        """A scalar of the task, the same for all samples."""
        value = f"(T)((const float*)s.scalar.data)[e * s.scalar.shape[1] + {index}]"
        return self._cached(("scalar", index), lambda: self.once.let(value))

    def task_pose(self, index: int) -> Given:
        """A pose of the task, the same for all samples."""
        pose = f"((const float*)s.pose.data + 7 * (e * s.pose.shape[1] + {index}))"
        return self._cached(("pose", index), lambda: self._pose(pose))

    def _joint(self, joint: int) -> Given:
        """The transform of a free or ball joint, or of a mocap body, where it is observed."""
        layout, body = self.layout, int(self.layout.joint_child[joint])
        mocap = layout.mocap_body.tolist()
        if body in mocap:
            return self._pose(f"(mocap_start + {7 * mocap.index(body)})")
        start = int(layout.joint_q_start[joint])
        if layout.joint_dof_dim[joint, 0]:
            return self._pose(f"(q_start + {start})")
        return self._pose(f"(q_start + {start})", position=False)

    def _pose(self, array: str, *, position: bool = True) -> Given:
        """Seven numbers (x, y, z, qx, qy, qz, qw) of an array; or the last four alone."""
        let, first = self.once.let, 3 if position else 0
        at: Vector = [let(f"(T){array}[{i}]") for i in range(3)] if position else [0.0] * 3
        x, y, z, w = quaternion = [let(f"(T){array}[{first + i}]") for i in range(4)]

        def twice(a: str, b: str, sign: str, c: str, d: str) -> str:
            return f"2.0f * ({a} * {b} {sign} {c} * {d})"

        columns = [
            [f"1.0f - {twice(y, y, '+', z, z)}", twice(x, y, "+", z, w), twice(x, z, "-", y, w)],
            [twice(x, y, "-", z, w), f"1.0f - {twice(x, x, '+', z, z)}", twice(y, z, "+", x, w)],
            [twice(x, z, "+", y, w), twice(y, z, "-", x, w), f"1.0f - {twice(x, x, '+', y, y)}"],
        ]
        columns = [[let(entry) for entry in column] for column in columns]
        return Given(columns, at, list(quaternion))


@dataclass(frozen=True)
class TermCode:
    """Place at which the source of one term is written."""

    state: StateCode
    """Source of the state that it reads."""
    lines: Lines
    """Takes its statements."""
    params: str
    """Its parameters' struct in the source, whose numbers may change between plans: ``f"{code.params}.margin"``."""

    def variable(self, name: str, value: str) -> str:
        """Define a variable that later statements change; returns its name, which no other term has."""
        name = f"{name}_{self.params.replace('.', '_')}"
        self.lines.add(f"T {name} = {value};")
        return name


def moving_dofs(layout: Layout) -> frozenset[int]:
    """Degrees of freedom that a scene's drives move."""
    return frozenset(int(dof) for dof in np.asarray(layout.actuator_dof))


POINTERS = """const float* q_start = (const float*)k.joint_q.data + e * k.joint_q.shape[1];
const float* qd_start = (const float*)k.joint_qd.data + e * k.joint_qd.shape[1];
const float* mocap_start = (const float*)k.mocap.data + 7 * e * k.mocap.shape[1];
const float* weight = (const float*)sums.weights.term.data + e * sums.weights.term.shape[1];
const float* last_control = (const float*)s.last_control.data + e * controls;"""
"""Pointers that the source of terms reads of an environment ``e``."""
TIMES = """const float dt = sums.dt.data[at];
const float discount = live ? sums.weights.discount.data[at] : 0.0f;
const float* terminal = (const float*)sums.weights.terminal.data + at * sums.weights.terminal.shape[1];
const float gap = at == 0 ? dt : 0.5f * (dt + sums.dt.data[at - 1]); // between the middles of two steps
const float left = s.step_end.data[steps] - s.step_end.data[at]; // of the horizon when the step begins"""
"""Times and factors of the step ``at``."""


@dataclass(frozen=True)
class TermSource:
    """The source of one term."""

    index: int
    """Its row among all terms."""
    lines: Lines
    value: Operand

    @property
    def start(self) -> str:
        """Its sum, before the first step."""
        return f"T total{self.index} = (T)0.0f;"

    @property
    def step(self) -> str:
        """Its statements of one step; without weight, or at a step at which it does not count, it is off."""
        body = "\n".join(self.lines.statements)
        total = f"total{self.index} += discount * terminal[{self.index}] * {text(self.value)};"
        counts = f"weight[{self.index}] != 0.0f && terminal[{self.index}] != 0.0f"
        return f"if (live && {counts}) {{\n{body}\n{total}\n}}"

    def end(self, world: str, lane: str = "") -> str:
        """Its cost over the horizon in a world, after the last step."""
        i = self.index
        return f"sums.total.data[{i} * worlds + {world}] = weight[{i}] * total{i}{lane};"


def sums(terms: Sequence[TermSource]) -> str:
    """Statements that write the sums of ``count`` samples from ``row`` on down, on a CPU."""
    return "\n".join(("for (int l = 0; l < count; ++l) {", *(term.end("row + l", "[l]") for term in terms), "}"))


def manipulability(code: TermCode, p: Any) -> Operand:
    """``arm.manipulability`` (Eq. 10): √det(J Jᵀ), which does not depend on the point that J looks at."""
    state, lines, params = code.state, code.lines, code.params
    axes = chain_axes(code, p)
    turning = [axis for axis in axes if axis.turns]
    # the axes of a wrist meet in one point: from there two of its columns have no linear part
    about = turning[-2 if len(turning) > 1 else -1].origin if turning else state.frame(p.of).position
    columns = [[*(axis.direction if axis.turns else [0.0] * 3), *state.tree.lever(axis, about)] for axis in axes]
    if len(columns) < 6:
        gram = {(i, j): lines.dot(columns[i], columns[j]) for i in range(len(columns)) for j in range(i + 1)}
    else:
        rows = [[column[i] for column in columns] for i in range(6)]
        gram = {(i, j): lines.dot(rows[i], rows[j]) for i in range(6) for j in range(i + 1)}
    _, pivots = factorize(code, gram, min(len(columns), 6))
    m = lines.let(f"VSQRT(VMAX({' * '.join(pivots)}, 0.0f))")
    if p.step:
        return lines.let(f"VSELECT({m} < {params}.least, 1.0f - {m}, 0.0f)")
    return lines.let(f"VMAX(({params}.least - {m}) / {params}.least, 0.0f)")


def chain_axes(code: TermCode, p: Any) -> list[Axis]:
    """The axes that are columns of a term's Jacobian, in the order of its parameters."""
    place = code.state.frame(p.of).place
    by_coord = {int(code.state.layout.dof_coord[axis.dof]): axis for axis in place.axes}
    return [by_coord[int(i)] for i in p.chain.coord.numpy()[p.chain.column.numpy()]]


def factorize(code: TermCode, gram: dict[tuple[int, int], Operand], n: int) -> tuple[dict, list[str]]:
    """L and D of L D Lᵀ for a symmetric matrix, given by its lower half."""
    lines, pivots = code.lines, []
    low: dict[tuple[int, int], str] = {}
    work: dict[tuple[int, int], str] = {}
    for j in range(n):
        for i in range(j, n):
            taken = "".join(f" - {work[i, k]} * {low[j, k]}" for k in range(j))
            work[i, j] = lines.let(f"{text(gram[i, j])}{taken}")
        pivots.append(lines.let(f"VMAX({work[j, j]}, 1.0e-9f)"))  # what rounding makes of a singular posture
        for i in range(j + 1, n):
            low[i, j] = lines.let(f"{work[i, j]} / {pivots[j]}")
    return low, pivots
