# SPDX-License-Identifier: Apache-2.0
"""A state of the physics as cost terms in the source see it: poses and twists of bodies come from the world."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..cost.code.state import POINTERS, TIMES, Refused, StateCode, sums
from ..cost.code.tree import Axis, KinematicsSource, Place
from ..kernels.geometry.kinematics import BALL, DISTANCE, FREE
from ..physics.runtime.bake import Lines, Operand, Vector, known
from ..physics.source_parts import AddedCode
from ..scene.model.joints import driving
from ..scene.model.layout import IDENTITY

if TYPE_CHECKING:
    from ..cost.code.state import TermSource
    from ..physics.state_map import StateMap, Turn
    from ..scene.model.layout import Layout


class PhysicsState(StateCode):
    """As :class:`~warpmpc.cost.code.state.StateCode`, of the world ``w`` after a control.

    Args:
        layout: Layout of the scene, targets included.
        numbers: Where the world keeps what the layout names.
    """

    def __init__(self, layout: Layout, numbers: StateMap):
        self._turning = {turn.v + i: turn for turn in numbers.turns for i in range(turn.width[1])}
        super().__init__(layout, frozenset({*self._turning, *numbers.speeds}))
        self.numbers = numbers
        self.tree = PhysicsTree(layout, self.lines, numbers.rows)
        dofs = np.arange(layout.nv)
        self._driven = driving(layout, dofs, "acceleration")

    def coordinate(self, i: int) -> str:
        """Joint coordinate i [m or rad]."""
        at = self.numbers.coordinates.get(i)
        if at is None:
            # of free joints without their own anchors the model has the same numbers in another order
            for turn in self.numbers.turns:
                if 0 <= i - turn.q < turn.width[0]:
                    if not _plain(turn):
                        raise Refused(f"the coordinates of {self.layout.joint_name[turn.joint]}")
                    at = turn.model_q + (0, 1, 2, 4, 5, 6, 3)[i - turn.q]
        if at is None:  # of what the physics does not move
            return self._cached(("q", i), lambda: self.once.let(f"(T)q_start[{i}]"))
        return self._cached(("q", i), lambda: self.lines.let(f"w.q[{at}]"))

    def speed(self, dof: int) -> Operand:
        """Joint velocity [m/s or rad/s]; of free joints as the layout has it."""
        at = self.numbers.speeds.get(dof)
        if at is not None:
            return self._cached(("v", dof), lambda: self.lines.let(f"w.v[{at}]"))
        turn = self._turning.get(dof)
        if turn is None:
            return 0.0
        if not _plain(turn):
            raise Refused(f"the velocities of {self.layout.joint_name[turn.joint]}")
        return self._cached(("twist", turn.body), lambda: self._twist(turn.body))[dof - turn.v]

    def _twist(self, body: int) -> Vector:
        """Velocity of a body's centre of mass, and its angular velocity."""
        place = self.tree.place(body)
        centre = self.body_point(body, self.layout.body_com[body].astype(float))
        linear, angular = self.tree.velocity(place, centre, self.speed)
        return [*linear, *angular]

    def acceleration(self, dof: int) -> Operand:
        """Mean acceleration of a joint during the step; what its drive is told where it takes accelerations."""
        if dof not in self.moving:
            return 0.0
        if self._driven[dof] >= 0:
            return f"c{self._driven[dof]}"
        return self._cached(("a", dof), lambda: self._difference(dof))

    def _difference(self, dof: int) -> str:
        now = self.speed(dof)
        return self.lines.let(f"({now} - {self.before(now)}) / dt")

    def acceleration_before(self, dof: int) -> Operand:
        """The same during the step before; before the first step, its own."""
        if dof not in self.moving:
            return 0.0
        if self._driven[dof] >= 0:
            return f"d{self._driven[dof]}"
        now = self.acceleration(dof)
        return self._cached(("b", dof), lambda: self.lines.let(f"h <= 0 ? {now} : {self.before(now)}"))

    def force(self, pair: int) -> Vector:
        """Mean contact force on the first of a watched pair during the step, in the world's frame [N]."""
        if not self.numbers.watched:
            return [0.0, 0.0, 0.0]
        return self._cached(("force", pair), lambda: [self.lines.let(f"w.pushed[{3 * pair + k}]") for k in range(3)])

    def sensor(self, index: int) -> str:
        """A number of the sensors at the last physics step of the control, in the sensor's own unit."""
        at = self.numbers.readings.places.index(index)
        return self._cached(("sensor", index), lambda: self.lines.let(f"shown[{at}]"))

    def free_start(self, body: int) -> None:
        """None: physics moves what is free."""
        return


@dataclass(frozen=True)
class BodyPlace(Place):
    """Place of a body of the world, or of a pose that is fixed to it."""

    body: int = -1


class Axes:
    """Axes between the world and a body, written when they are asked for."""

    def __init__(self, write: Callable[[], list[Axis]]):
        self._write = write

    def __iter__(self) -> Iterator[Axis]:
        return iter(self._write())


class PhysicsTree(KinematicsSource):
    """Places of bodies, as the world has them.

    Args:
        layout: Joints and bodies.
        lines: Takes the statements.
        rows: Row of the world in which each body is.
    """

    def __init__(self, layout: Layout, lines: Lines, rows: list[int]):
        super().__init__(layout, lines, _not_asked, _not_asked)
        self._rows = rows
        self._axes: dict[int, list[Axis]] = {}

    def place(self, body: int) -> Place:
        """Place of a body; -1 is the world."""
        if body not in self._places:
            row, let = self._rows[body], self.lines.let
            columns = [[let(f"w.bmat[{row}][{3 * k + axis}]") for k in range(3)] for axis in range(3)]
            origin = [let(f"w.bpos[{row}][{k}]") for k in range(3)]
            axes = Axes(lambda: self._chain(body))
            self._places[body] = BodyPlace(columns, origin, np.eye(3), np.zeros(3), axes, None, body)
        return self._places[body]

    def velocity(self, place: Place, point: Vector, speed: Callable[[int], Operand]) -> tuple[Vector, Vector]:
        """Velocity of a point that moves with a body, and the body's angular velocity."""
        body = getattr(place, "body", -1)
        if body < 0:
            return [0.0] * 3, [0.0] * 3
        row, let = self._rows[body], self.lines.let
        angular = [let(f"w.bang[{row}][{k}]") for k in range(3)]
        origin = self.place(body).origin
        carried = self.lines.cross(angular, self.lines.difference(point, origin))
        linear = [self.lines.sum(let(f"w.blin[{row}][{k}]"), carried[k]) for k in range(3)]
        return linear, angular

    def _chain(self, body: int) -> list[Axis]:
        """Axes that move a body, from the root on; like the layout's Jacobians without those of free joints."""
        if body < 0 or body in self._mocap:
            return []
        joint = self._joint[body]
        above = self._chain(int(self.layout.joint_parent[joint]))
        if joint not in self._axes:
            self._axes[joint] = self._of_joint(joint)
        return [*above, *self._axes[joint]]

    def _of_joint(self, joint: int) -> list[Axis]:
        layout, kind = self.layout, int(self.layout.joint_type[joint])
        if kind in (int(FREE), int(DISTANCE)):
            return []
        linear, angular = (int(n) for n in layout.joint_dof_dim[joint])
        if kind == int(BALL) or angular > 1:
            raise Refused(f"joint {layout.joint_name[joint]} turns about several axes")
        before, after = layout.joint_pose_parent[joint].astype(float), layout.joint_pose_child[joint].astype(float)
        parent, child = self.place(int(layout.joint_parent[joint])), self.place(int(layout.joint_child[joint]))
        frame, origin = Rotation.from_quat(before[3:]).as_matrix(), self.point(child, after[:3])
        first, out = int(layout.joint_qd_start[joint]), []
        for k in range(linear + angular):
            # the joint's own turn leaves its axis alone
            axis = known(frame @ layout.dof_axis[first + k].astype(float))
            out.append(Axis(first + k, k >= linear, self.lines.transform(parent.columns, axis), origin))
        return out


def _not_asked(index: int) -> str:
    """Joints move bodies within the physics, not here."""
    raise AssertionError(f"joint {index} was asked for")


def _plain(turn: Turn) -> bool:
    """Tell if a joint is free and without its own anchors."""
    return not turn.ball and bool((np.stack([turn.parent, turn.child]) == IDENTITY).all())


def cost_code(state: PhysicsState, terms: Sequence[TermSource]) -> AddedCode:
    """Statements that sum cost terms in the launch.

    Args:
        state: What the terms ask for.
        terms: The terms.
    """
    controls = range(state.layout.nu)
    then = (*state.kept.values(), *state.held.values())
    start = (
        POINTERS,
        *state.once.statements,
        *(term.start for term in terms),
        *(f"T {name} = (T)0.0f;" for name in then),
    )
    step = (
        TIMES,
        *(f"const T c{u} = w.c[{u}];" for u in controls),
        *state.lines.statements,
        *(f"if (!live) {name} = {value};" for value, name in state.held.items()),
        *(term.step for term in terms),
        *(f"{name} = {value};" for value, name in state.kept.items()),
    )
    before = (f"const T d{u} = h > 0 ? w.c[{u}] : (T)last_control[{u}];" for u in controls)
    return AddedCode(
        start="\n".join(start),
        before="\n".join(before),
        step="\n".join(step),
        end=sums(terms),
        first=-1 if state.kept or state.held else 0,
    )
