# SPDX-License-Identifier: Apache-2.0
"""Source of what actuators drive: lengths, speeds and lever arms (MuJoCo, "Computation: Transmission")."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from .base import BALL, FREE, rotation
from .constraint_rows import rotation_vector, small_rotation
from .frames import scaled
from .runtime.bake import Lines, Operand, Vector, text

if TYPE_CHECKING:
    from .base import Structure
    from .frames import Sites
    from .tendons import Tendons

TRN, DYN, GAIN, BIAS = mujoco.mjtTrn, mujoco.mjtDyn, mujoco.mjtGain, mujoco.mjtBias
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


class Reach(NamedTuple):
    """Target of an actuator."""

    length: tuple[Operand, Operand]
    """Two factors of its length."""
    speed: tuple[Operand, Operand]
    arms: list[tuple[int, Operand]]
    """Degrees of freedom, and the generalized force of a force of one."""
    period: float = 0.0
    """Of lengths that are the same rotation, where a setpoint is taken next to the length; else zero."""


class Transmission:
    """Writes what actuators drive.

    Args:
        model: The model.
        sites: Takes sites that actuators pull at.
        tendons: Lengths and lever arms.
    """

    def __init__(self, model: Structure, sites: Sites, tendons: Tendons):
        self.model, self.mj, self.sites, self.tendons = model, model.mj, sites, tendons

    def reach(self, lines: Lines, a: int) -> Reach:
        """Target of an actuator."""
        m, kind, (target, other) = self.mj, int(self.mj.actuator_trntype[a]), map(int, self.mj.actuator_trnid[a])
        gear = [float(x) for x in m.actuator_gear[a]]
        if kind == int(TRN.mjTRN_TENDON):
            arms = [(dof, lines.sum((gear[0], arm))) for dof, arm in self.tendons.arms(target)]
            return Reach((gear[0], f"w.tendon_length[{target}]"), (gear[0], f"w.tendon_speed[{target}]"), arms)
        if kind == int(TRN.mjTRN_SITE):
            return self._site(lines, target, gear) if other < 0 else self._between(lines, a, target, other, gear)
        if kind == int(TRN.mjTRN_SLIDERCRANK):
            return self._crank(lines, a, target, other, gear[0])
        dof, joint = int(m.jnt_dofadr[target]), int(m.jnt_type[target])
        if joint in (FREE, BALL):
            return self._turning(lines, a, target, gear, kind == int(TRN.mjTRN_JOINTINPARENT))
        return Reach((gear[0], f"w.q[{int(m.jnt_qposadr[target])}]"), (gear[0], f"w.v[{dof}]"), [(dof, gear[0])])

    def _turning(self, lines: Lines, a: int, joint: int, gear: list[float], parent: bool) -> Reach:
        """A ball or free joint; torques in the frame of the child, or of the parent."""
        m, dof, q = self.mj, int(self.mj.jnt_dofadr[joint]), int(self.mj.jnt_qposadr[joint])
        free = m.jnt_type[joint] == FREE
        push, twist = (gear[:3], gear[3:]) if free else ([], gear[:3])
        if parent:
            twist = self._turned_back(lines, q + 3 if free else q, twist)
        arms = [(dof + k, x) for k, x in enumerate([*push, *twist])]
        if free or not self._measured(a):
            return self._along(arms, lines)
        length = lines.dot(small_rotation(lines, f"turn{a}", q, UNTURNED), twist)
        return self._along(arms, lines, length, self._period(a, gear[:3]))

    def _turned_back(self, lines: Lines, q: int, v: list[float]) -> Vector:
        """A known vector by the inverse of the rotation at a coordinate."""
        w, *u = (f"w.q[{q + k}]" for k in range(4))
        scale = lines.let(f"-2.0f / ({w} * {w} + {' + '.join(f'{x} * {x}' for x in u)})")
        swept = scaled(lines, lines.cross(u, v), scale)
        return [lines.sum(x, (w, y), (-1.0, z)) for x, y, z in zip(v, swept, lines.cross(u, swept), strict=True)]

    def _site(self, lines: Lines, site: int, gear: list[float]) -> Reach:
        """A force and a torque at a site, along its axes."""
        sites, body, frame = self.sites, int(self.mj.site_bodyid[site]), self._frame(site)
        columns = sites.columns(frame)
        push, twist = (lines.transform(columns, gear[k : k + 3]) for k in (0, 3))
        arms = []
        for dof in sorted(self.model.body_dofs[body]):
            terms = [*zip(push, sites.lever(lines, frame, dof), strict=True)] if any(gear[:3]) else []
            arms.append((dof, lines.sum(*terms, *zip(twist, sites.axis(dof), strict=True))))
        return self._along(arms, lines)

    def _between(self, lines: Lines, a: int, site: int, reference: int, gear: list[float]) -> Reach:
        """Place and rotation of a site in the frame of another, along the other's axes."""
        sites, frames = self.sites, [self._frame(site), self._frame(reference)]
        own, columns = (sites.columns(n) for n in frames)
        push, twist = (lines.transform(columns, gear[k : k + 3]) for k in (0, 3))
        length: list = []
        if any(gear[:3]):
            length += zip(lines.difference(*(sites.point(n) for n in frames)), push, strict=True)
        if any(gear[3:]) and self._measured(a):
            entries = ", ".join(text(lines.dot(x, y)) for x in columns for y in own)
            x, y, z, s = (f"between{a}{axis}" for axis in "xyzs")
            lines.add(f"T {x}, {y}, {z}, {s}; {{ const T r[9] = {{{entries}}}; quaternion(r, {x}, {y}, {z}, {s}); }}")
            length += zip(rotation_vector(lines, f"between{a}", [x, y, z], s), gear[3:], strict=True)
        arms = []
        for dof, frame, sign in self._apart((site, reference), frames):
            terms = [*zip(push, sites.lever(lines, frame, dof), strict=True)] if any(gear[:3]) else []
            arm = lines.sum(*terms, *zip(twist, sites.axis(dof), strict=True))
            arms.append((dof, lines.sum((sign, arm))))
        return self._along(arms, lines, lines.sum(*length), 0.0 if any(gear[:3]) else self._period(a, gear[3:]))

    def _crank(self, lines: Lines, a: int, crank: int, slider: int, gear: float) -> Reach:
        """The way of a slider that a rod holds at a crank."""
        sites, frames = self.sites, [self._frame(crank), self._frame(slider)]
        axis, rod = sites.columns(frames[1])[2], float(self.mj.actuator_cranklength[a])
        apart = lines.difference(*(sites.point(n) for n in frames))
        along = lines.dot(apart, axis)
        left = lines.let(text(lines.sum((along, along), rod * rod, (-1.0, lines.dot(apart, apart)))))
        root = lines.let(f"VSQRT(VMAX({left}, (T)0.0f))")
        over = lines.let(f"VSELECT({left} > 0.0f, 1.0f / VMAX({root}, (T)1e-20f), (T)0.0f)")
        share = lines.sum(1.0, (-1.0, lines.sum((along, over))))
        push = [lines.sum((share, x), (over, y)) for x, y in zip(axis, apart, strict=True)]
        turned = scaled(lines, lines.cross(axis, apart), share)
        arms = []
        for dof, frame, sign in self._apart((crank, slider), frames):
            terms = [*zip(push, sites.lever(lines, frame, dof), strict=True)]
            if frame == frames[1]:
                terms += [(-1.0, lines.dot(turned, sites.axis(dof)))]
            arms.append((dof, lines.sum((sign * gear, lines.sum(*terms)))))
        return self._along(arms, lines, lines.sum((gear, lines.sum(along, (-1.0, root)))))

    def _apart(self, pair: tuple[int, int], frames: list[int]) -> list[tuple[int, int, float]]:
        """Degrees of freedom that move one of two sites and not the other: that site's frame, and a sign."""
        first, second = (self.model.body_dofs[self.mj.site_bodyid[s]] for s in pair)
        rows = [(dof, frames[0], 1.0) for dof in first - second]
        return sorted(rows + [(dof, frames[1], -1.0) for dof in second - first])

    def _frame(self, site: int) -> int:
        m = self.mj
        return self.sites.index(m.site_bodyid[site], m.site_pos[site], rotation(m.site_quat[site]))

    def _along(self, arms: list, lines: Lines, length: Operand = 0.0, period: float = 0.0) -> Reach:
        """A target whose speed is what its arms make of velocities."""
        arms = [(dof, arm) for dof, arm in arms if arm != 0.0]
        speed = lines.sum(*((arm, f"w.v[{dof}]") for dof, arm in arms))
        return Reach((1.0, length), (1.0, speed), arms, period)

    def _measured(self, a: int) -> bool:
        """Return whether the length of an actuator matters."""
        m = self.mj
        kinds = (
            (int(m.actuator_gaintype[a]), m.actuator_gainprm[a], (GAIN.mjGAIN_FIXED, GAIN.mjGAIN_AFFINE)),
            (int(m.actuator_biastype[a]), m.actuator_biasprm[a], (BIAS.mjBIAS_NONE, BIAS.mjBIAS_AFFINE)),
        )
        fed = any(kind != int(plain) and (kind != int(affine) or p[1]) for kind, p, (plain, affine) in kinds)
        return fed or bool((m.sensor_type == int(mujoco.mjtSensor.mjSENS_ACTUATORPOS)).any())

    def _period(self, a: int, gear: list[float]) -> float:
        """Length of a whole turn of an actuator that servoes a rotation to its input."""
        m = self.mj
        servoes = (
            m.actuator_gaintype[a] == int(GAIN.mjGAIN_FIXED)
            and m.actuator_biastype[a] == int(BIAS.mjBIAS_AFFINE)
            and m.actuator_gainprm[a, 0] == -m.actuator_biasprm[a, 1]
            and m.actuator_dyntype[a] in (int(DYN.mjDYN_NONE), int(DYN.mjDYN_INTEGRATOR))
        )
        return 2.0 * np.pi * float(np.linalg.norm(gear)) if servoes else 0.0
