# SPDX-License-Identifier: Apache-2.0
"""Source of sensors that are read within a step: forces, accelerations, contacts, energies, distances along rays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BALL, FREE, rotation
from .coefficients import narrow, within
from .constraint_rows import ball_angle, relative_turn, small_rotation, tied_sites
from .equalities import CONNECT, WELD, ends
from .frames import Frame
from .runtime.bake import Lines, Operand, Vector, literal, text
from .sensor_tables import ContactSensors, Rays

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .frames import Sites
    from .model import PhysicsModel
    from .tendons import Tendons

SENSOR = mujoco.mjtSensor
_ACCELERATION = int(mujoco.mjtStage.mjSTAGE_ACC)


class Sensing:
    """Writes ``sense``, which fills ``w.sensed`` with what sensors of these kinds read, one after the other.

    Args:
        model: The model.
        sites: Takes frames of sensors and centres of bodies.
        tendons: Lengths of tendons.
        count: How many sensors are read, the first ones.
    """

    def __init__(self, model: PhysicsModel, sites: Sites, tendons: Tendons, *, count: int):
        self.model, self.mj, self.sites, self.tendons = model, model.mj, sites, tendons
        self.sensors = [] if model.off("SENSOR") else within_step(model.mj, count)
        self.kinds = {SENSOR(int(self.mj.sensor_type[n])) for n in self.sensors}
        self.drives = bool(self.kinds & _DRIVES)
        """Whether lengths, speeds and forces of actuators are kept."""
        self._contacts, self._rays = ContactSensors(model, sites), Rays(model, sites)
        self._lines, self._welds = Lines("z"), 0
        self._moving: dict[frozenset[int], tuple[Vector, Vector]] = {}
        self._pushes: dict[int, tuple[int, Vector, Vector]] = {}
        self._wrenches: dict[int, tuple[Vector, Vector]] = {}

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        m = self.mj
        return {
            "SENSED": int(sum(m.sensor_dim[n] for n in self.sensors)),
            "SENSES_FORCES": int(any(m.sensor_needstage[n] == _ACCELERATION for n in self.sensors)),
            "SENSES_CONTACTS": int(bool(self.kinds & _CONTACTS)),
            "SENSES_DRIVES": int(self.drives),
            **self._rays.sizes,
        }

    def tables(self) -> list[str]:
        """Definitions of tables."""
        return [*self._contacts.tables(), *self._rays.tables()]

    def write(self) -> str:
        """Source of the function."""
        lines, at = self._lines, 0
        for n in self.sensors:
            values = _WRITERS[SENSOR(int(self.mj.sensor_type[n]))](self, n, at)
            for k, value in enumerate(values):
                lines.add(f"w.sensed[{at + k}] = {text(value)};")
            at += int(self.mj.sensor_dim[n])
        if not self.sensors:
            return "INLINE void sense(World&, I) {}"
        first = [*(["settle(w, alone);"] if self.kinds & _MOVED else []), *(["look(w);"] if self.sizes["RAYS"] else [])]
        return "\n".join(("FN void sense(World& w, I alone) {", *first, *lines.statements, "}"))

    def _of(self, n: int) -> int:
        return int(self.mj.sensor_objid[n])

    def tendon_length(self, n: int, at: int) -> Sequence[Operand]:
        """Length of a tendon."""
        return [f"w.tendon_length[{self._of(n)}]"]

    def tendon_speed(self, n: int, at: int) -> Sequence[Operand]:
        """Speed of a tendon."""
        return [f"w.tendon_speed[{self._of(n)}]"]

    def actuator_length(self, n: int, at: int) -> Sequence[Operand]:
        """Length of an actuator."""
        return [f"w.actuator_length[{self._of(n)}]"]

    def actuator_speed(self, n: int, at: int) -> Sequence[Operand]:
        """Speed of an actuator."""
        return [f"w.actuator_speed[{self._of(n)}]"]

    def actuator_force(self, n: int, at: int) -> Sequence[Operand]:
        """Force of an actuator."""
        return [f"w.actuator_force[{self._of(n)}]"]

    def joint_force(self, n: int, at: int) -> Sequence[Operand]:
        """Force of all actuators on a joint."""
        return [f"w.joint_force[{int(self.mj.jnt_dofadr[self._of(n)])}]"]

    def tendon_force(self, n: int, at: int) -> Sequence[Operand]:
        """Force of all actuators on a tendon."""
        m = self.mj
        pulls = (m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)) & (m.actuator_trnid[:, 0] == self._of(n))
        return [self._lines.sum(*(f"w.actuator_force[{a}]" for a in np.flatnonzero(pulls)))]

    def joint_limit(self, n: int, at: int) -> Sequence[Operand]:
        """Distance to a joint's limit less the margin, its speed, or the limit's force; zero away from it."""
        m, lines, j, kind = self.mj, self._lines, self._of(n), self.mj.sensor_type[n]
        dof, q, margin = int(m.jnt_dofadr[j]), int(m.jnt_qposadr[j]), float(m.jnt_margin[j])
        if m.jnt_type[j] == BALL:
            row = self._row("ball", j)
            if row is None or kind == int(SENSOR.mjSENS_JOINTLIMITFRC):
                return [0.0 if row is None else f"constraint_force(w, {row})"]
            axis, turn = ball_angle(lines, f"limit{n}", q)
            left = lines.sum(float(m.jnt_range[j].max()), (-1.0, turn))
            speed = lines.sum(*((-1.0, lines.sum((x, f"w.v[{dof + k}]"))) for k, x in enumerate(axis)))
            return self._at_limit(kind == int(SENSOR.mjSENS_JOINTLIMITPOS), left, speed, margin)
        both = self._row("narrow", j)
        if j not in self.model.limited and both is None:
            return [0.0]
        if kind == int(SENSOR.mjSENS_JOINTLIMITFRC):
            return [f"limit_force(w, {dof})" if both is None else self._limit_force(both, two=True)]
        limits = within(m.jnt_range[j])
        return self._between(kind == int(SENSOR.mjSENS_JOINTLIMITPOS), f"w.q[{q}]", f"w.v[{dof}]", limits, margin)

    def tendon_limit(self, n: int, at: int) -> Sequence[Operand]:
        """The same of a tendon's limit."""
        m, t, kind = self.mj, self._of(n), self.mj.sensor_type[n]
        row = self._row("limit", t)
        if row is None or kind == int(SENSOR.mjSENS_TENDONLIMITFRC):
            two = narrow(m.tendon_range[t], float(m.tendon_margin[t]))
            return [0.0 if row is None else self._limit_force(row, two=two)]
        length, speed, limits = f"w.tendon_length[{t}]", f"w.tendon_speed[{t}]", within(m.tendon_range[t])
        return self._between(
            kind == int(SENSOR.mjSENS_TENDONLIMITPOS), length, speed, limits, float(m.tendon_margin[t])
        )

    def _limit_force(self, row: int, *, two: bool) -> str:
        """Force of the first limit that holds."""
        first = f"constraint_force(w, {row})"
        other = f"constraint_force(w, {row + 1})"
        return f"VSELECT(w.constraint_weight[{row}] > 0.0f, {first}, {other})" if two else first

    def _between(self, wanted: bool, value: str, speed: str, limits: np.ndarray, margin: float) -> Sequence[Operand]:
        """Distance or speed at the first of two limits that holds."""
        lines = self._lines
        above = lines.let(f"{value} - {literal(float(limits[0]))}")
        below = lines.let(f"{literal(float(limits[1]))} - {value}")
        low = f"{above} < {literal(margin)}"
        rate = lines.let(f"VSELECT({low}, {speed}, -{speed})")
        return self._at_limit(wanted, lines.let(f"VSELECT({low}, {above}, {below})"), rate, margin)

    def _at_limit(self, wanted: bool, left: Operand, speed: Operand, margin: float) -> Sequence[Operand]:
        value = self._lines.sum(left, -margin) if wanted else speed
        return [f"VSELECT({text(left)} < {literal(margin)}, {text(value)}, (T)0.0f)"]

    def _row(self, kind: str, index: int) -> int | None:
        """First row of a constraint, None if there is none."""
        row = 0
        for constraint in self.model.constraints:
            if (constraint.kind, constraint.index) == (kind, index):
                return row
            row += len(constraint.inverse)
        return None

    def kinetic(self, n: int, at: int) -> Sequence[Operand]:
        """Energy of motion."""
        return ["kinetic(w)"]

    def potential(self, n: int, at: int) -> Sequence[Operand]:
        """Energy of weights and springs."""
        m, lines = self.mj, self._lines
        terms: list = []
        for body in np.flatnonzero(m.body_mass):
            at_centre = self.sites.point(self.sites.index(body, m.body_ipos[body]))
            height = lines.sum((-1.0, lines.dot(at_centre, self.model.gravity)))
            terms.append((self._mass(int(body)), height))
        if not self.model.off("SPRING"):
            for j in np.flatnonzero(np.ravel(m.jnt_stiffness)):
                stiffness, q, kind = float(np.ravel(m.jnt_stiffness)[j]), int(m.jnt_qposadr[j]), int(m.jnt_type[j])
                away: Vector = []
                if kind in (FREE, BALL):
                    if kind == FREE:
                        away = [lines.sum(f"w.q[{q + k}]", -float(m.qpos_spring[q + k])) for k in range(3)]
                        q += 3
                    away += small_rotation(lines, f"energy{j}", q, m.qpos_spring[q : q + 4])
                else:
                    away = [lines.sum(f"w.q[{q}]", -float(m.qpos_spring[q]))]
                terms += [(0.5 * stiffness, lines.sum((x, x))) for x in away]
            for t in np.flatnonzero(m.tendon_stiffness):
                low, high = (literal(float(x)) for x in within(m.tendon_lengthspring[t]))
                length = f"w.tendon_length[{t}]"
                away = [lines.let(f"{length} - VMIN(VMAX({length}, (T){low}), (T){high})")]
                terms.append((0.5 * float(m.tendon_stiffness[t]), lines.sum((away[0], away[0]))))
        return [lines.sum(*terms)]

    def _mass(self, body: int) -> Operand:
        return self.model.columns.operand(self.model.array("body_mass")[:, body])

    def _driven(self, body: int) -> tuple[Vector, Vector]:
        """What joints' accelerations add to a body's angular one, and to the linear one at its tree's point."""
        lines, dofs = self._lines, self.model.body_dofs[body]
        if not dofs:
            return [0.0] * 3, [0.0] * 3
        if dofs not in self._moving:
            own = sorted(dofs - self.model.body_dofs[int(self.mj.body_parentid[body])])
            above = self._driven(int(self.mj.body_parentid[body]))
            angular = [
                lines.sum(above[0][k], *((f"w.cw[{i}][{k}]", f"w.x[{i}]") for i in own if not self.model.slides(i)))
                for k in range(3)
            ]
            linear = [lines.sum(above[1][k], *((f"w.cl[{i}][{k}]", f"w.x[{i}]") for i in own)) for k in range(3)]
            self._moving[dofs] = angular, linear
        return self._moving[dofs]

    def _acceleration(self, site: int) -> tuple[Vector, Vector]:
        """Angular acceleration of a site, and its linear one less gravity."""
        lines, sites, body = self._lines, self.sites, self.sites.all[site].body
        less = [lines.sum((-1.0, x)) for x in self.model.gravity]
        if not self.model.moves(body):
            return [0.0] * 3, less
        angular, linear = self._driven(body)
        top = self.model.dof_top[min(self.model.body_dofs[body])]
        arm = lines.difference(sites.point(site), [f"w.ref[{top}][{k}]" for k in range(3)])
        parts = zip(sites.falling(site), linear, lines.cross(angular, arm), less, strict=True)
        turning = [lines.sum(a, b) for a, b in zip(sites.turning(site), angular, strict=True)]
        return turning, [lines.sum(*part) for part in parts]

    def acceleration(self, n: int, at: int) -> Sequence[Operand]:
        """Acceleration of a frame less gravity, linear or angular; zero of what no joint moves."""
        m, kind = self.mj, SENSOR(int(self.mj.sensor_type[n]))
        frame = Frame.of(m, int(m.sensor_objtype[n]), self._of(n))
        if not self.model.moves(frame.body):
            return [0.0] * 3
        site = self.sites.index(frame.body, frame.at, frame.turn)
        angular, linear = self._acceleration(site)
        if kind == SENSOR.mjSENS_ACCELEROMETER:
            return [self._lines.dot(column, linear) for column in self.sites.columns(site)]
        return linear if kind == SENSOR.mjSENS_FRAMELINACC else angular

    def _push(self, body: int) -> tuple[int, Vector, Vector]:
        """Site of a body's centre of mass, the force that its motion takes, and the torque about it."""
        m, lines, model = self.mj, self._lines, self.model
        if body not in self._pushes:
            site = self.sites.index(body, m.body_ipos[body], rotation(m.body_iquat[body]))
            turning, falling = self._acceleration(site)
            mass = self._mass(body)
            torque: Vector = [0.0] * 3
            if model.moves(body):
                columns, spin = self.sites.columns(site), self.sites.spin(site)
                inertia = [model.columns.operand(model.array("body_inertia")[:, body, k]) for k in range(3)]

                def turned(vector: Vector) -> Vector:
                    own = [
                        lines.sum((i, lines.dot(column, vector))) for i, column in zip(inertia, columns, strict=True)
                    ]
                    return [lines.sum(*((own[k], columns[k][i]) for k in range(3))) for i in range(3)]

                gyroscopic = lines.cross(spin, turned(spin))
                torque = [lines.sum(a, b) for a, b in zip(turned(turning), gyroscopic, strict=True)]
            self._pushes[body] = site, [lines.sum((mass, x)) for x in falling], torque
        return self._pushes[body]

    def wrench(self, n: int, at: int) -> Sequence[Operand]:
        """Force or torque between a site's body with all below it and the body above, in the site's axes."""
        m, lines, site = self.mj, self._lines, self._of(n)
        own = self.sites.index(m.site_bodyid[site], m.site_pos[site], rotation(m.site_quat[site]))
        if own not in self._wrenches:
            subtree = self.model.subtree(int(m.site_bodyid[site]))
            about = self.sites.point(own)
            forces: list[Vector] = []
            torques: list[Vector] = []
            for body in subtree:
                if m.body_mass[body] > 0.0:
                    centre, force, torque = self._push(body)
                    forces.append(force)
                    torques += [torque, lines.cross(lines.difference(self.sites.point(centre), about), force)]
            subtree = [body for body in subtree if body]  # what pushes the world is not told
            outer = [*self._contacts.on(lines, subtree, about, f"wrench{own}"), *self._ties(subtree, about)]
            for force, torque in outer:
                forces.append([lines.sum((-1.0, x)) for x in force])
                torques.append([lines.sum((-1.0, x)) for x in torque])
            self._wrenches[own] = tuple(
                [lines.dot(column, [lines.sum(*(v[k] for v in vectors)) for k in range(3)]) for column in
                 self.sites.columns(own)]
                for vectors in (forces, torques)
            )  # fmt: skip
        return self._wrenches[own][SENSOR(int(m.sensor_type[n])) == SENSOR.mjSENS_TORQUE]

    def _ties(self, subtree: Sequence[int], about: Vector) -> list[tuple[Vector, Vector]]:
        """Forces of connects and welds on a subtree, and their torques about a point."""
        m, lines, out = self.mj, self._lines, []
        for constraint in self.model.constraints:
            e = constraint.index
            if constraint.kind != "equality" or int(m.eq_type[e]) not in (CONNECT, WELD):
                continue
            bodies, row = ends(m, e), self._row("equality", e)
            if row is None or not set(bodies) & set(subtree):
                continue
            pair = tied_sites(m, self.sites, e)
            force = [lines.let(f"constraint_force(w, {row + k})") for k in range(3)]
            torque = self._twist(e, pair, row) if int(m.eq_type[e]) == WELD else [0.0] * 3
            for body, site, sign in zip(bodies, pair, (1.0, -1.0), strict=True):
                if body in subtree:
                    moment = lines.cross(lines.difference(self.sites.point(site), about), force)
                    turning = [lines.sum((sign, a), (sign, b)) for a, b in zip(torque, moment, strict=True)]
                    out.append(([lines.sum((sign, x)) for x in force], turning))
        return out

    def _twist(self, e: int, pair: Sequence[int], row: int) -> Vector:
        """Torque of a weld on its first body, from the forces along its rows (:meth:`.ConstraintRows._turned`)."""
        lines, half = self._lines, 0.5 * float(self.mj.eq_data[e, 10])
        self._welds += 1
        part, real = relative_turn(lines, self.sites, pair, f"weld{self._welds}")
        push = [lines.let(f"constraint_force(w, {row + 3 + k})") for k in range(3)]
        swept = zip(push, lines.cross(part, push), strict=True)
        own = [lines.sum((half, lines.sum((real, a), b))) for a, b in swept]
        columns = self.sites.columns(pair[1])
        return [lines.sum(*((own[k], columns[k][i]) for k in range(3))) for i in range(3)]

    def touch(self, n: int, at: int) -> Sequence[Operand]:
        """Normal forces of contacts in the zone of a site."""
        return [self._contacts.touch(n)]

    def contact(self, n: int, at: int) -> Sequence[Operand]:
        """Contacts between objects."""
        self._lines.add(self._contacts.tell(n, at))
        return []

    def ray(self, n: int, at: int) -> Sequence[Operand]:
        """Distance from a site to the nearest geom along its z axis."""
        self._rays.add(n, at)
        return []

    def inside_site(self, n: int, at: int) -> Sequence[Operand]:
        """One where a frame is within the shape of a site, else zero."""
        m, site = self.mj, int(self.mj.sensor_refid[n])
        frame = Frame.of(m, int(m.sensor_objtype[n]), self._of(n))
        own = self.sites.point(self.sites.index(frame.body, frame.at))
        zone = self.sites.index(m.site_bodyid[site], m.site_pos[site], rotation(m.site_quat[site]))
        away = [
            self._lines.dot(c, self._lines.difference(own, self.sites.point(zone))) for c in self.sites.columns(zone)
        ]
        point, size = (", ".join(text(x) for x in v) for v in (away, m.site_size[site].tolist()))
        return [f"VSELECT(inside({int(m.site_type[site])}, V3{{{point}}}, V3{{{size}}}), (T)1.0f, (T)0.0f)"]


def within_step(m: mujoco.MjModel, count: int | None = None) -> list[int]:
    """Sensors, of the first ``count`` or of all, that are read within a step."""
    return [n for n in range(m.nsensor if count is None else count) if SENSOR(int(m.sensor_type[n])) in _WRITERS]


def _named(*names: str) -> list[mujoco.mjtSensor]:
    return [getattr(SENSOR, f"mjSENS_{name}") for name in names]


_MOVED = frozenset(_named("ACCELEROMETER", "FRAMELINACC", "FRAMEANGACC", "FORCE", "TORQUE"))
_CONTACTS = frozenset(_named("TOUCH", "CONTACT", "FORCE", "TORQUE"))
_DRIVES = frozenset(_named("ACTUATORPOS", "ACTUATORVEL", "ACTUATORFRC", "JOINTACTFRC", "TENDONACTFRC"))
_WRITERS: dict[mujoco.mjtSensor, Callable[[Sensing, int, int], Sequence[Operand]]] = {
    SENSOR.mjSENS_TENDONPOS: Sensing.tendon_length,
    SENSOR.mjSENS_TENDONVEL: Sensing.tendon_speed,
    SENSOR.mjSENS_ACTUATORPOS: Sensing.actuator_length,
    SENSOR.mjSENS_ACTUATORVEL: Sensing.actuator_speed,
    SENSOR.mjSENS_ACTUATORFRC: Sensing.actuator_force,
    SENSOR.mjSENS_JOINTACTFRC: Sensing.joint_force,
    SENSOR.mjSENS_TENDONACTFRC: Sensing.tendon_force,
    **dict.fromkeys(_named("JOINTLIMITPOS", "JOINTLIMITVEL", "JOINTLIMITFRC"), Sensing.joint_limit),
    **dict.fromkeys(_named("TENDONLIMITPOS", "TENDONLIMITVEL", "TENDONLIMITFRC"), Sensing.tendon_limit),
    SENSOR.mjSENS_E_POTENTIAL: Sensing.potential,
    SENSOR.mjSENS_E_KINETIC: Sensing.kinetic,
    **dict.fromkeys(_named("ACCELEROMETER", "FRAMELINACC", "FRAMEANGACC"), Sensing.acceleration),
    **dict.fromkeys(_named("FORCE", "TORQUE"), Sensing.wrench),
    SENSOR.mjSENS_TOUCH: Sensing.touch,
    SENSOR.mjSENS_CONTACT: Sensing.contact,
    SENSOR.mjSENS_RANGEFINDER: Sensing.ray,
    SENSOR.mjSENS_INSIDESITE: Sensing.inside_site,
}
"""Sensors that are read within a step."""
