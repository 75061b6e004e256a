# SPDX-License-Identifier: Apache-2.0
"""Source of the forces of bias, springs, dampers and actuators (MuJoCo, "Computation: Passive forces", "Actuation").

Arguments of the functions of muscles (``native/muscle.h``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BALL, FREE, packed
from .coefficients import UNLIMITED, bounds, coefficient, negative, powers, within
from .constraint_rows import small_rotation
from .runtime.bake import Lines, Operand, Vector, function, literal, text
from .source_parts import floats, ints
from .transmission import Reach, Transmission
from .version import BOUNDED_FORCES_DO_NOT_DAMP

if TYPE_CHECKING:
    from .base import Structure
    from .frames import Sites
    from .tendons import Tendons

LEAST = 1e-15


def gain_numbers(model: Structure, actuator: int) -> str:
    """Length at the start of the range, inverse optimum length, and so on, of an active muscle."""
    start, over, first, p, force = _scale(model, actuator, "gain")
    fast = over / np.maximum(LEAST, p[:, 6])
    return _joined(model, start, over, first, p[:, 4], p[:, 5], fast, p[:, 8], force)


def bias_numbers(model: Structure, actuator: int) -> str:
    """The same of a passive one."""
    start, over, first, p, force = _scale(model, actuator, "bias")
    return _joined(model, start, over, first, p[:, 5], p[:, 7] * force)


def _scale(model: Structure, a: int, kind: str) -> tuple[np.ndarray, ...]:
    """Start of the range, inverse optimum length, start over it, all parameters, peak force; ``[W]`` each."""
    p, limits = model.array(f"actuator_{kind}prm")[:, a], model.array("actuator_lengthrange")[:, a]
    force = np.where(p[:, 2] < 0.0, p[:, 3] / np.maximum(LEAST, model.array("actuator_acc0")[:, a]), p[:, 2])
    optimum = (limits[:, 1] - limits[:, 0]) / np.maximum(LEAST, p[:, 1] - p[:, 0])
    return limits[:, 0], 1.0 / np.maximum(LEAST, optimum), p[:, 0], p, force


def _joined(model: Structure, *values: np.ndarray) -> str:
    return ", ".join(text(model.columns.operand(value)) for value in values)


TRN = mujoco.mjtTrn
DYN = mujoco.mjtDyn
GAIN = mujoco.mjtGain
BIAS = mujoco.mjtBias


class ForceSource:
    """Writes ``drive``.

    Args:
        model: The model.
        sites: Takes sites that actuators pull at.
        tendons: Lengths and lever arms.
        kept: Whether lengths, speeds and forces of actuators are kept.
    """

    def __init__(self, model: Structure, sites: Sites, tendons: Tendons, *, kept: bool = False):
        self._kept = kept
        self.model, self.mj, self.sites, self.tendons = model, model.mj, sites, tendons
        self.transmission = Transmission(model, sites, tendons)
        self._pulled: dict[int, tuple[Reach, Operand, Operand]] = {}
        """Actuators on tendons with limits of force, which are looked at before the others."""
        m = self.mj
        self._stages = m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)
        self._force: dict[int, list] = {i: [] for i in range(m.nv)}
        self._damped: dict[int, list] = {i: [] for i in range(m.nv)}
        self._spread: dict[tuple[int, int], list] = {}
        """What the implicit step adds to entries (row, column < row) of the mass matrix, over the time step."""
        if self.model.implicit and self.model.fluid:  # which adds to all of them
            self._spread = {(i, j): [] for i in range(m.nv) for j in self.model.ancestors[i]}
        self._acts: dict[int, tuple[float, np.ndarray]] = {}
        """How much an activation changes in a step of Euler's, over its exact change; and its bounds."""

    @property
    def spreads(self) -> dict[tuple[int, int], int]:
        """Numbers of the entries that the implicit step adds to, once all is written."""
        return {entry: n for n, entry in enumerate(self._spread)}

    def damps(self, dof: int, *, actuators: bool = False) -> bool:
        """Return whether an implicit step damps a degree of freedom, or actuators and tendons do it; once written."""
        own = self.model.dampings[dof, 0] != 0.0
        return len(self._damped[dof]) > (int(own) if actuators else 0)

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {
            "SPREAD": len(self._spread),
            "ACTS": self.mj.na,
            "MUSCLES": int(any(int(muscle) in kinds for kinds, muscle in self._kinds())),
            "RUNGE_KUTTA": int(self._stages),
            "SKEWED": int(self.model.skewed),
        }

    def _kinds(self) -> tuple:
        m = self.mj
        return (
            (m.actuator_gaintype, GAIN.mjGAIN_MUSCLE),
            (m.actuator_biastype, BIAS.mjBIAS_MUSCLE),
            (m.actuator_dyntype, DYN.mjDYN_MUSCLE),
        )

    def tables(self) -> list[str]:
        """Definitions of tables."""
        out = [ints("spread_place", [packed(i, j) for i, j in self._spread], "short")] if self._spread else []
        if self._stages and self._acts:
            rows = [self._acts[i] for i in range(self.mj.na)]
            out += [floats("act_plain", [row[0] for row in rows]), floats("act_range", [row[1] for row in rows])]
        return out

    def write(self) -> str:
        """Forces of everything but constraints, and what velocity damps of them within an implicit step."""
        m, lines = self.mj, Lines("d")
        shares, bounded = self._shares(lines), []
        for a in range(m.nu):
            if not self.model.drives(a):
                self._rest(lines, a)
                if self._kept:
                    self._keep(lines, a, self.transmission.reach(lines, a), 0.0)
                continue
            reach, value, rate = self._unbounded(lines, a)
            value, rate = self._bounded(lines, a, value, rate, shares)
            if self._kept:
                self._keep(lines, a, reach, value)
            for dof, arm in reach.arms:
                self._force[dof].append((value, arm))
            if self.model.implicit and rate != 0.0:
                if BOUNDED_FORCES_DO_NOT_DAMP and self._limit(a) is not None:
                    bounded.append((self._limit(a), rate, reach.arms))
                else:
                    self._resist(lines, rate, reach.arms)
        for joint, rate, arms in bounded:
            dof = int(m.jnt_dofadr[joint])
            carried = self._carried(lines, dof) if m.jnt_actgravcomp[joint] else 0.0
            total = lines.sum(*self._force[dof], carried)
            self._resist(lines, slope_within(lines, total, m.jnt_actfrcrange[joint], rate), arms)
        pulls = self._pulls(lines)
        for i in range(m.nv):
            joint = int(m.dof_jntid[i])
            driven = lines.sum(*self._force[i])
            limited = bool(m.jnt_actfrclimited[joint]) and i == int(m.jnt_dofadr[joint])  # of several the first alone
            off = self.model.off("ACTUATION") or not m.nu
            carried = self._carried(lines, i) if m.jnt_actgravcomp[joint] and (limited or off) else 0.0
            if limited and (self._force[i] or carried != 0.0) and not off:
                driven = clamp(lines, lines.sum(driven, carried), m.jnt_actfrcrange[joint])
            if self._kept:
                lines.add(f"w.joint_force[{i}] = {text(driven)};")
            driven = lines.sum(driven, (-1.0, carried))  # which is in the bias
            terms: list = [driven, (-1.0, lines.let(f"w.bias[{i}]"))]
            damping, slope = coefficient(lines, self.model.dampings[i], f"w.v[{i}]", damper=True)
            drawn = self.model.drawn_damping(i)
            damping, slope = lines.sum(damping, drawn), lines.sum(slope, drawn)
            if damping != 0.0:
                terms.append((negative(lines, damping), f"w.v[{i}]"))
            if damping != 0.0 and not self._stages and (self.model.implicit or not self.model.off("EULERDAMP")):
                self._damped[i].append(slope)
            lines.add(f"w.fs[{i}] = {text(lines.sum(*terms, *pulls[i]))};")
            rate = lines.sum(*self._damped[i])
            lines.add(f"w.damp[{i}] = {text(rate)} * {literal(float(m.opt.timestep))};")
        for n, terms in enumerate(self._spread.values()):
            lines.add(f"w.spread[{n}] = {text(lines.sum(*terms))} * {literal(float(m.opt.timestep))};")
        return function("drive", lines)

    def _unbounded(self, lines: Lines, a: int) -> tuple[Reach, Operand, Operand]:
        """Target of an actuator, its force, and that one's derivative by speed, without limits."""
        if a in self._pulled:
            return self._pulled[a]
        reach = self.transmission.reach(lines, a)
        return reach, *self._actuator(lines, a, reach)

    def _keep(self, lines: Lines, a: int, reach: Reach, force: Operand) -> None:
        """Length, speed and force of an actuator, for sensors."""
        for name, x in (("length", reach.length), ("speed", reach.speed), ("force", (force, 1.0))):
            lines.add(f"w.actuator_{name}[{a}] = {text(lines.sum(x))};")

    def _shares(self, lines: Lines) -> dict[int, str]:
        """What limits of tendons leave of the forces of all actuators on each."""
        m, total = self.mj, {}
        for a in np.flatnonzero(m.actuator_trntype == int(TRN.mjTRN_TENDON)):
            tendon = int(m.actuator_trnid[a, 0])
            if m.tendon_actfrclimited[tendon] and self.model.drives(a):
                self._pulled[int(a)] = found = self._unbounded(lines, int(a))
                total.setdefault(tendon, []).append(found[1])
        out = {}
        for tendon, forces in total.items():
            force = lines.let(text(lines.sum(*forces)))
            within_limits = text(clamp(lines, force, m.tendon_actfrcrange[tendon]))
            out[tendon] = lines.let(f"VSELECT({force} == 0.0f, (T)1.0f, {within_limits} / {force})")
        return out

    def _carried(self, lines: Lines, dof: int) -> Operand:
        """Force of gravity compensation on a degree of freedom, which its joint's actuators are to have."""
        m, model, terms = self.mj, self.model, []
        for b in range(1, m.nbody):
            if not model.lift(b) or dof not in model.body_dofs[b]:
                continue
            frame, mass = self.sites.index(b, m.body_ipos[b]), model.columns.operand(model.array("body_mass")[:, b])
            weight = [lines.sum((-model.lift(b), lines.sum((mass, g)))) for g in model.gravity]
            terms.append(lines.dot(self.sites.lever(lines, frame, dof), weight))
        return lines.sum(*terms)

    def _pulls(self, lines: Lines) -> dict[int, list]:
        """Forces of springs and tendons on every degree of freedom."""
        m = self.mj
        out: dict[int, list] = {i: [] for i in range(m.nv)}
        for t in range(m.ntendon):
            (force, slope), arms = self.tendons.force(lines, t), self.tendons.arms(t)
            if self.tendons.heavy(t):
                force = lines.sum(force, (-float(self.model.line_armatures[t]), f"w.tendon_curving[{t}]"))
            for dof, arm in arms if force != 0.0 else ():
                out[dof].append((force, arm))
            if self.model.implicit and slope != 0.0:
                self._resist(lines, negative(lines, slope), arms)
        springs = powers(m, "jnt_stiffness")
        for j in np.flatnonzero(springs.any(axis=1)) if not self.model.off("SPRING") else ():
            stiffness, q, dof = float(springs[j, 0]), int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            kind = int(m.jnt_type[j])
            if springs[j, 1:].any():
                away = lines.sum(f"w.q[{q}]", -float(m.qpos_spring[q]))
                out[dof].append((negative(lines, coefficient(lines, springs[j], away, damper=False)[0]), away))
                continue
            if kind == FREE:
                for k in range(3):
                    out[dof + k] += [(-stiffness, f"w.q[{q + k}]"), stiffness * float(m.qpos_spring[q + k])]
                q, dof = q + 3, dof + 3
            if kind in (FREE, BALL):
                turned = small_rotation(lines, f"spring{j}", q, m.qpos_spring[q : q + 4])
                for k in range(3):
                    out[dof + k].append((-stiffness, turned[k]))
            else:
                out[dof] += [(-stiffness, f"w.q[{q}]"), stiffness * float(m.qpos_spring[q])]
        return out

    def _limit(self, a: int) -> int | None:
        """Joint of an actuator that limits the sum of its actuators."""
        joint, kind = int(self.mj.actuator_trnid[a, 0]), int(self.mj.actuator_trntype[a])
        on_joint = kind in (int(TRN.mjTRN_JOINT), int(TRN.mjTRN_JOINTINPARENT))
        return joint if on_joint and self.mj.jnt_actfrclimited[joint] else None

    def _resist(self, lines: Lines, rate: Operand, arms: list[tuple[int, Operand]]) -> None:
        """A force's derivative by the speed that it acts on, within the mass matrix's pattern."""
        for i, a in arms:
            for j, b in arms:
                if j == i:
                    square = a * a if isinstance(a, float) else lines.sum((a, a))
                    self._damped[i].append(
                        (rate, -square) if isinstance(square, float) else self._less(lines, rate, square)
                    )
                elif j in self.model.ancestors[i]:
                    both = lines.sum((a, b))
                    self._spread.setdefault((i, j), []).append(self._less(lines, rate, both))

    def _less(self, lines: Lines, a: Operand, b: Operand) -> Operand:
        return lines.sum((-1.0, lines.sum((a, b))))

    def _actuator(self, lines: Lines, a: int, reach: Reach) -> tuple[Operand, Operand]:
        """Force of an actuator, and its derivative by its speed."""
        m = self.mj
        raw: Operand = f"w.ctrl[{a}]"
        control = raw
        if m.actuator_ctrllimited[a] and not self.model.off("CLAMPCTRL"):
            control = clamp(lines, control, m.actuator_ctrlrange[a])
        if m.actuator_actnum[a]:
            raw = control = self._activation(lines, a, control, reach)
        if reach.period:
            control = self._nearest(lines, control, reach)
        factor, slope = self._gain(lines, a, reach)
        terms: list = [(factor, control)]
        rate: list = [(slope, raw)] if slope != 0.0 else []  # MuJoCo differentiates at the control that is not clamped
        kind = int(m.actuator_biastype[a])
        if kind == int(BIAS.mjBIAS_AFFINE):
            bias = self._numbers("actuator_biasprm", a)
            terms += [bias[0], times(lines, bias[1], reach.length), times(lines, bias[2], reach.speed)]
            rate.append(bias[2])
        elif kind == int(BIAS.mjBIAS_MUSCLE):
            length = text(lines.sum(reach.length))
            terms.append(lines.let(f"muscle_bias({length}, {bias_numbers(self.model, a)})"))
        return lines.sum(*terms), lines.sum(*rate)

    def _bounded(
        self, lines: Lines, a: int, force: Operand, slope: Operand, shares: dict[int, str]
    ) -> tuple[Operand, Operand]:
        """A force within the limits of its tendon and its own, and its derivative."""
        m = self.mj
        if int(m.actuator_trntype[a]) == int(TRN.mjTRN_TENDON) and int(m.actuator_trnid[a, 0]) in shares:
            share = shares[int(m.actuator_trnid[a, 0])]
            force = lines.sum((force, share))
            if BOUNDED_FORCES_DO_NOT_DAMP and slope != 0.0:
                slope = lines.let(f"VSELECT(VABS({share} - 1.0f) > 1e-6f, (T)0.0f, {text(slope)})")
        if m.actuator_forcelimited[a] and bounds(m.actuator_forcerange[a]) and isinstance(force, str):
            slope = slope_within(lines, force, m.actuator_forcerange[a], slope)
            force = clamp(lines, force, m.actuator_forcerange[a])
        return force, slope

    def _gain(self, lines: Lines, a: int, reach: Reach) -> tuple[Operand, Operand]:
        """Factor of an actuator's input, and its derivative by speed."""
        kind = int(self.mj.actuator_gaintype[a])
        if kind == int(GAIN.mjGAIN_MUSCLE):
            length, speed = text(lines.sum(reach.length)), text(lines.sum(reach.speed))
            slope = f"slope{a}"
            lines.add(f"T {slope};")
            return lines.let(f"muscle_gain({length}, {speed}, {gain_numbers(self.model, a)}, {slope})"), slope
        gain = self._numbers("actuator_gainprm", a)
        if kind != int(GAIN.mjGAIN_AFFINE):
            return gain[0], 0.0
        parts = times(lines, gain[1], reach.length), times(lines, gain[2], reach.speed)
        return lines.sum(gain[0], *parts), gain[2]

    def _rest(self, lines: Lines, a: int) -> None:
        """Activations of an actuator that is off: they stay, but for their bounds where its group alone is off."""
        m, first = self.mj, int(self.mj.actuator_actadr[a])
        limits = m.actuator_actrange[a] if m.actuator_actlimited[a] and not self.model.off("ACTUATION") else UNLIMITED
        for i in range(first, first + int(m.actuator_actnum[a])):
            self._acts[i] = 1.0, within(limits)
            lines.add(f"w.act_next[{i}] = {text(clamp(lines, f'w.act[{i}]', limits))};")

    def _numbers(self, name: str, a: int) -> Vector:
        """First parameters of an actuator's gain or bias."""
        return [self.model.columns.operand(self.model.array(name)[:, a, k]) for k in range(3)]

    def _nearest(self, lines: Lines, target: Operand, reach: Reach) -> Operand:
        """The same rotation as a target, less than half a turn from the length."""
        away = lines.sum(target, (-1.0, lines.sum(reach.length)))
        turns = lines.let(f"VROUND({text(away)} * {literal(1.0 / reach.period)})")
        return lines.sum(target, (-reach.period, turns))

    def _activation(self, lines: Lines, a: int, control: Operand, reach: Reach) -> Operand:
        """Input of an actuator with its own state, whose next value is kept for the end of the step."""
        m, i = self.mj, int(self.mj.actuator_actadr[a])
        kind, tau, step = int(m.actuator_dyntype[a]), max(float(m.actuator_dynprm[a, 0]), 1e-15), float(m.opt.timestep)
        before, share, plain = f"w.act[{i}]", step / tau, 1.0
        if kind == int(DYN.mjDYN_INTEGRATOR):
            after = lines.sum(before, (step, control))
        elif kind == int(DYN.mjDYN_MUSCLE):
            times_of = ", ".join(literal(float(x)) for x in m.actuator_dynprm[a, :3])
            after = lines.sum(before, (step, lines.let(f"muscle_rate({text(control)}, {before}, {times_of})")))
        else:
            if kind == int(DYN.mjDYN_FILTEREXACT):
                share = float(-np.expm1(-share))
                plain = step / tau / share
            after = lines.sum(before, (share, lines.sum(control, (-1.0, before))))
        limits = m.actuator_actrange[a] if m.actuator_actlimited[a] else UNLIMITED
        bounded = clamp(lines, after, limits)
        self._acts[i] = plain, within(limits)
        kept = self._nearest(lines, bounded, reach) if reach.period and not self._stages else bounded
        lines.add(f"w.act_next[{i}] = {text(after if self._stages else kept)};")
        after = bounded
        return after if m.actuator_actearly[a] else before


def times(lines: Lines, factor: Operand, value: tuple[Operand, Operand]) -> tuple[Operand, Operand]:
    """A factor times a product of two."""
    a, b = value
    if isinstance(a, float) and isinstance(factor, float):
        return factor * a, b
    return factor, lines.sum((a, b))


def slope_within(lines: Lines, force: Operand, limits: np.ndarray, slope: Operand) -> Operand:
    """Derivative of a force, none at its limits: there it does not depend on velocity."""
    if slope == 0.0 or not bounds(limits) or not isinstance(force, str):
        return slope
    low, high = (literal(x) for x in within(limits))
    return lines.let(f"VSELECT(({force} > {low}) & ({force} < {high}), {text(slope)}, (T)0.0f)")


def clamp(lines: Lines, value: Operand, limits: np.ndarray) -> Operand:
    """A value within known limits."""
    if isinstance(value, float):
        return float(np.clip(value, *limits))
    if not bounds(limits):
        return value
    low, high = (literal(x) for x in within(limits))
    return lines.let(f"VMIN(VMAX({value}, (T){low}), (T){high})")
