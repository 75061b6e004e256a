# SPDX-License-Identifier: Apache-2.0
"""Source of whole rollouts without physics: controls, motion, kinematics and terms of all steps in one go.

On a CPU a call takes as many samples as the SIMD type has lanes from the first step to the last, with states in
registers. On a GPU a warp takes one sample, a lane one step: sums over time are scans over the lanes.

Source of the joints' motion under their drives (Bhardwaj et al. 2021, Eq. 7).

Step after step on a CPU, by scans over the lanes of a warp on a GPU, where every lane has a step.
Names as in :mod:`.state`; ``live`` says whether there is such a step, ``q_in``, ``v_in``, ``a_in`` and ``c_in`` carry
states and controls from one block of lanes to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..cost.code.state import POINTERS, TIMES, TermSource, sums
from ..kernels.engine.launch import TAPS
from ..kernels.planner.splines import LINEAR, ZERO
from ..physics.runtime.bake import CONTROL, Lines, Operand, header, text

if TYPE_CHECKING:
    from ..cost.code.state import StateCode
    from ..scene.model.layout import Layout

WARP = 32
"""Lanes of a warp."""
_UP = "__shfl_up_sync(0xffffffffu, {0}, {1})"
_SCAN = f"for (int m = 1; m < {WARP}; m <<= 1) {{ const float y = {_UP.format('x', 'm')}; if (lane >= m) x += y; }}"


@dataclass(frozen=True)
class DrivenJoint:
    """Joint that one drive moves."""

    row: int
    """Its row of the matrix from controls to targets."""
    dof: int
    coordinate: int
    mode: str
    """``acceleration``, ``velocity`` or ``position``."""


def targets(name: str, control: str, matrix: np.ndarray) -> list[str]:
    """Statements that define what controls ask of the joints: ``{name}0``, ``{name}1``, ..."""
    lines = Lines(f"{name}_")
    for d, row in enumerate(matrix):
        value = lines.sum(*((float(row[u]), f"{control}{u}") for u in np.flatnonzero(row)))
        lines.add(f"const T {name}{d} = {text(value)};")
    return lines.statements


def start_cpu(drives: list[DrivenJoint], controls: int) -> str:
    """Statements before the first step."""
    out = []
    for d in drives:
        out.append(f"T q{d.coordinate} = (T)q_start[{d.coordinate}], v{d.dof} = (T)qd_start[{d.dof}];")
        out.append(f"T a{d.dof} = (T)0.0f, b{d.dof} = (T)0.0f;")
    out += [f"T d{u}, now{u} = (T)last_control[{u}];" for u in range(controls)]
    return "\n".join(out)


def motion_cpu(drives: list[DrivenJoint], matrix: np.ndarray) -> str:
    """The joints one step on, from the step's controls."""
    out = [f"d{u} = now{u}; if (live) now{u} = c{u};" for u in range(matrix.shape[1])]
    out += [*targets("goal", "c", matrix), *targets("earlier", "d", matrix), "if (live) {"]
    for d in drives:
        q, v, a, b, goal = f"q{d.coordinate}", f"v{d.dof}", f"a{d.dof}", f"b{d.dof}", f"goal{d.row}"
        if d.mode == "acceleration":
            out.append(f"{a} = {goal}; {b} = earlier{d.row}; {v} += {a} * dt;")
        else:
            speed = goal if d.mode == "velocity" else f"({goal} - {q}) / dt"
            out.append(f"{{ const T speed = {speed}, pace = (speed - {v}) / dt;")
            out.append(f"{b} = h == 0 ? pace : {a}; {a} = pace; {v} = speed; }}")
        out.append(f"{q} += {v} * dt;")
    return "\n".join((*out, "}"))


def start_gpu(drives: list[DrivenJoint], controls: int) -> str:
    """Statements before the first block of steps."""
    out = []
    for d in drives:
        out.append(f"T q_in{d.coordinate} = q_start[{d.coordinate}], v_in{d.dof} = qd_start[{d.dof}];")
        out.append(f"T a_in{d.dof} = 0.0f;")
    out += [f"T c_in{u} = 0.0f;" for u in range(controls)]
    return "\n".join(out)


def motion_gpu(drives: list[DrivenJoint], matrix: np.ndarray) -> str:
    """The joints at every lane's step."""
    out = []
    for u in range(matrix.shape[1]):
        out.append(f"float {before(f'd{u}', f'c{u}', f'c_in{u}')} if (h <= 0) d{u} = last_control[{u}];")
        out.append(carry(f"c_in{u}", f"c{u}"))
    out += [*targets("goal", "c", matrix), *targets("earlier", "d", matrix)]
    for d in drives:
        q, v, a, b, goal = f"q{d.coordinate}", f"v{d.dof}", f"a{d.dof}", f"b{d.dof}", f"goal{d.row}"
        q_in, v_in, a_in = f"q_in{d.coordinate}", f"v_in{d.dof}", f"a_in{d.dof}"
        if d.mode == "position":
            out.append(f"const float {q} = live ? {goal} : {q_in};")
            out.append(f"float {before('x' + q, q, q_in)}")
            out.append(f"const float {v} = live ? ({q} - x{q}) / dt : {v_in};")
        else:
            if d.mode == "velocity":
                out.append(f"const float {v} = live ? {goal} : {v_in};")
            else:
                out.append(f"float {v}; {{ float x = live ? {goal} * dt : 0.0f;\n{_SCAN}\n{v} = {v_in} + x; }}")
            out.append(f"float {q}; {{ float x = live ? {v} * dt : 0.0f;\n{_SCAN}\n{q} = {q_in} + x; }}")
        if d.mode == "acceleration":
            out.append(f"const float {a} = live ? {goal} : 0.0f, {b} = earlier{d.row};")
        else:
            out.append(f"float {before('x' + v, v, v_in)} const float {a} = live ? ({v} - x{v}) / dt : 0.0f;")
            out.append(f"float {before(b, a, a_in)} if (h <= 0) {b} = {a};")
        out += [carry(q_in, q), carry(v_in, v), carry(a_in, a)]
    return "\n".join(out)


def before(name: str, value: str, carried: str) -> str:
    """Definition of a value one step before, from the lane below."""
    return f"{name} = {_UP.format(value, 1)}; if (lane == 0) {name} = {carried};"


def carry(name: str, value: str) -> str:
    """Keep the last lane's value for the next block."""
    return f"{name} = {own(value, WARP - 1)};"


def own(value: str, lane: int) -> str:
    """The value of one lane, for all of them."""
    return f"__shfl_sync(0xffffffffu, {value}, {lane})"


@dataclass(frozen=True)
class RolloutSource:
    """Writes the source of rollouts.

    Args:
        state: What the terms asked for.
        terms: Terms that are summed in the launch.
        spline: Kind of spline from knots to controls.
        knots: Knots of a sample.
        lanes: Samples in a vector on a CPU.
        records: Whether all states are written down, for terms on the record.
    """

    state: StateCode
    terms: tuple[TermSource, ...]
    spline: int
    knots: int
    lanes: int
    records: bool

    def write(self) -> str:
        """The body of ``rollout(s: StepView, p: Params, k: KinematicWork, sums: TermSums, group: int)``."""
        record = "\n".join(self._record()) if self.records else ""  # may ask the state for more
        once = "\n".join(self.state.once.statements)
        shared = "\n".join(self.state.lines.statements)
        totals = "\n".join(term.start for term in self.terms)
        step = "\n".join((*(term.step for term in self.terms), record))
        kept, held = self.state.kept, self.state.held
        first = -1 if self.records or kept or held else 0  # the observed state is recorded, or asked for later
        return f"""{header(self.lanes)}
const int samples = k.knots.shape[1], knots = k.knots.shape[2], controls = k.knots.shape[3];
const int steps = sums.dt.shape[0];
#if defined(__CUDA_ARCH__)
const int lane = threadIdx.x & {WARP - 1}, row = group;
const int e = row / samples;
{POINTERS}
{_THETA}
{once}
{totals}
{start_gpu(self._drives, self._layout.nu)}
{"".join(f"float in_{value} = 0.0f;" for value in kept)}{"".join(f"float {name} = 0.0f;" for name in held.values())}
for (int block = {first}; block < steps; block += {WARP}) {{
const int h = block + lane;
const bool live = h >= 0 && h < steps, seen = h < steps;
const int at = h < 0 ? 0 : (h < steps ? h : steps - 1);
{TIMES}
{CONTROL}
{self._controls("theta[tap[{tap}] * controls + {u}]")}
{motion_gpu(self._drives, self._layout.actuator_matrix)}
{shared}
{"".join(f"float {before(name, value, f'in_{value}')} {carry(f'in_{value}', value)}" for value, name in kept.items())}
{"".join(f"{{ const float x = {own(value, 0)}; if (block < 0) {name} = x; }}" for value, name in held.items())}
{step}
}}
{self._sum_gpu()}
__syncwarp(); // what other lanes recorded is read next
#else
const int groups = (samples + {self.lanes - 1}) / {self.lanes};
const int e = group / groups, from = (group % groups) * {self.lanes};
const int row = e * samples + from, count = samples - from < {self.lanes} ? samples - from : {self.lanes};
{POINTERS}
{_THETA}
T knot[{self.knots * self._layout.nu}]; // of these samples, side by side
for (int l = 0; l < {self.lanes}; ++l) {{
const float* own = theta + (l < count ? l : count - 1) * knots * controls;
for (int i = 0; i < {self.knots * self._layout.nu}; ++i) knot[i][l] = own[i];
}}
{once}
{totals}
{start_cpu(self._drives, self._layout.nu)}
{"".join(f"T {name} = (T)0.0f;" for name in (*kept.values(), *held.values()))}
for (int h = {first}; h < steps; ++h) {{
const bool live = h >= 0, seen = true;
const int at = h < 0 ? 0 : h;
{TIMES}
{CONTROL}
{self._controls("knot[tap[{tap}] * controls + {u}]")}
{motion_cpu(self._drives, self._layout.actuator_matrix)}
{shared}
{"".join(f"if (h < 0) {name} = {value};" for value, name in held.items())}
{step}
{"".join(f"{name} = {value};" for value, name in kept.items())}
}}
{sums(self.terms)}
#endif
"""

    @property
    def _layout(self) -> Layout:
        return self.state.layout

    @property
    def _drives(self) -> list[DrivenJoint]:
        layout = self._layout
        return [
            DrivenJoint(row, int(dof), int(layout.dof_coord[dof]), mode)
            for row, (dof, mode) in enumerate(zip(layout.actuator_dof, layout.actuator_mode, strict=True))
        ]

    def _controls(self, knot: str) -> str:
        """Controls ``c0``, ``c1``, ... of the step."""
        taps = {int(ZERO): 1, int(LINEAR): 2}.get(self.spline, int(TAPS))
        out = []
        for u in range(self._layout.nu):
            knots = (f"share[{tap}] * {knot.format(tap=tap, u=u)}" for tap in range(taps))
            out.append(f"const T c{u} = VMIN(VMAX({' + '.join(knots)}, k.lower.data[{u}]), k.upper.data[{u}]);")
        return "\n".join(out)

    def _sum_gpu(self) -> str:
        out = []
        for term in self.terms:
            total = f"total{term.index}"
            out.append(
                f"for (int m = {WARP // 2}; m > 0; m >>= 1) {total} += __shfl_xor_sync(0xffffffffu, {total}, m);\n"
                f"if (lane == 0) {term.end('row')}"
            )
        return "\n".join(out)

    def _record(self) -> list[str]:
        """Write the state down as slice h + 1 of the record, and the controls that led to it."""
        layout, rows = self._layout, []
        for array, width, first, values in self._recorded():
            rows.append(f"{{ float* to = (float*)k.{array}.data + slice * {width} + {first};")
            rows += [f"PUT({n}, {width}, {text(value)})" for n, value in enumerate(values)]
            rows.append("}")
        put = "{ const T x = VALUE; for (int l = 0; l < count; ++l) to[(size_t)l * WIDTH + N] = x[l]; }"
        cuda = "#if defined(__CUDA_ARCH__)\n#define PUT(N, WIDTH, VALUE) to[N] = VALUE;\n#else\n"
        defined = f"#undef PUT\n{cuda}#define PUT(N, WIDTH, VALUE) {put}\n#endif"
        controls = [f"{{ float* to = (float*)k.control.data + ((size_t)at * worlds + row) * {layout.nu};"]
        controls += [f"PUT({u}, {layout.nu}, c{u})" for u in range(layout.nu)]
        slice_ = "const size_t slice = (size_t)(h + 1) * worlds + row;"
        return [defined, "if (seen) {", slice_, *rows, "if (live)", *controls, "}", "}"]

    def _speed(self, dof: int) -> Operand:
        """A joint velocity for the record, whose first slice holds what was observed, of undriven joints too."""
        value = self.state.speed(dof)
        return value if isinstance(value, str) else f"(h < 0 ? (T)qd_start[{dof}] : (T)0.0f)"

    def _recorded(self) -> list[tuple[str, int, int, list[Operand]]]:
        """Arrays of the record, numbers of a world in them, the first one written, and the numbers."""
        state, tree, layout = self.state, self.state.tree, self._layout
        out = [
            ("record_q", layout.nq, 0, [state.coordinate(i) for i in range(layout.nq)]),
            ("record_qd", layout.nv, 0, [self._speed(dof) for dof in range(layout.nv)]),
        ]
        for body in range(layout.nb):
            place = tree.place(body)
            centre = tree.point(place, layout.body_com[body].astype(float))
            linear, angular = tree.velocity(place, centre, state.speed)
            pose = [*tree.position(place), *tree.quaternion(place)]
            out.append(("record_body_q", 7 * layout.nb, 7 * body, pose))
            out.append(("record_body_qd", 6 * layout.nb, 6 * body, [*linear, *angular]))
        return out


_THETA = """const int worlds = sums.total.shape[1];
const float* theta = (const float*)k.knots.data + (size_t)row * knots * controls;"""
