# SPDX-License-Identifier: Apache-2.0
"""Source of cost terms over rollouts that were recorded, many worlds at once, beside the kernels of a stack."""

import re
from typing import Any

import numpy as np
import warp as wp
from evaluating import Evaluating
from scipy.spatial.transform import Rotation

from warpmpc import StepView
from warpmpc.cost.code.state import FrameCode, StateCode, TermCode
from warpmpc.engine.launched import term_source as write_term
from warpmpc.kernels.cost.view import TASK_BODY
from warpmpc.physics.runtime.bake import WIDE, Lines, Matrix, Operand, Vector, header, known, native_lanes, text


@wp.struct
class RecordWork:
    """Recorded rollouts by groups of L worlds, which lie side by side; slice t is the state after t controls."""

    joint_q: wp.array4d[float]  # [group, T+1, nq, L]
    joint_qd: wp.array4d[float]  # [group, T+1, nv, L]
    body_q: wp.array4d[float]  # [group, T+1, 7 nb, L]
    body_qd: wp.array4d[float]  # [group, T+1, 6 nb, L]
    force: wp.array4d[float]  # [group, T, 3 pairs, L] [N]
    control: wp.array4d[float]  # [group, T, nu, L]
    last: wp.array3d[float]  # [group, nu, L] control that acts when the rollouts begin
    weight: wp.array2d[float]  # [E, term]
    cost: wp.array4d[float]  # [group, term, T, L]


class RecordedState(StateCode):
    """Source of one recorded state, written into the lines of the one term that asks.

    Args:
        lines: Takes the statements.
    """

    def __init__(self, layout: Any, lines: Lines):
        super().__init__(layout, frozenset(range(layout.nv)))
        self.lines = self.once = lines

    def number(self, array: str, i: int) -> str:
        """A number of the present slice."""
        return self._cached((array, i), lambda: self.lines.let(f"VLOAD({array} + {i} * WIDTH)"))

    def coordinate(self, i: int) -> str:
        """Joint coordinate."""
        return self.number("q_now", i)

    def speed(self, dof: int) -> Operand:
        """Joint velocity."""
        return self.number("qd_now", dof)

    def force(self, pair: int) -> Vector:
        """Mean force of a watched pair during the control step [N]."""
        return [self.number("force_now", 3 * pair + i) for i in range(3)]

    def velocity(self, index: int) -> tuple[Vector, Vector]:
        """Velocity of a frame's origin, and its angular velocity."""
        return self.point_velocity(int(self.layout.frame_body[index]), self.layout.frame_pose[index][:3].astype(float))

    def _point(self, body: int, at: np.ndarray) -> Vector:
        if body < 0:
            return super()._point(body, at)
        columns, position = self._body(body)
        return self.lines.transform(columns, known(at), position)

    def body_columns(self, body: int) -> Matrix:
        """Columns of a body's rotation."""
        return self._body(body)[0]

    def point_velocity(self, body: int, at: np.ndarray) -> tuple[Vector, Vector]:
        """Velocity of a point of a body, and the body's angular velocity."""
        if body < 0:
            return [0.0] * 3, [0.0] * 3
        linear, angular = ([self.number("twist_now", 6 * body + first + i) for i in range(3)] for first in (0, 3))
        lever = self.lines.transform(self._body(body)[0], at - self.layout.body_com[body].astype(float))
        return [self.lines.sum(*pair) for pair in zip(linear, self.lines.cross(angular, lever), strict=True)], angular

    def _body(self, body: int) -> tuple[Matrix, Vector]:
        def make() -> tuple[Matrix, Vector]:
            numbers = [self.number("body_now", 7 * body + i) for i in range(7)]
            self.lines.add(f"const T pose_{numbers[0]}[7] = {{{', '.join(numbers)}}};")
            given = self._pose(f"pose_{numbers[0]}")
            return given.rotation, given.position

        return self._cached(("body", body), make)

    def _frame(self, index: int) -> FrameCode:
        body, at = int(self.layout.frame_body[index]), self.layout.frame_pose[index].astype(float)
        if body <= int(TASK_BODY):
            return super()._frame(index)
        columns: Matrix = [known(column) for column in np.eye(3)]
        position: Vector = [0.0] * 3
        if body >= 0:
            columns, position = self._body(body)
        turned = self.lines.times(columns, Rotation.from_quat(at[3:]).as_matrix())
        return FrameCode(turned, self.lines.transform(columns, known(at[:3]), position), None)


def write(evaluating: Evaluating, lanes: int) -> str:
    """The body of ``evaluate(s: StepView, p: Params, k: RecordWork, group: int, groups: int)``."""
    stack, body = evaluating.stack, []
    for i, (term, bound) in enumerate(stack.terms):
        lines = Lines(f"t{i}_")
        code = TermCode(RecordedState(evaluating.layout, lines), lines, f"p.p{i}")
        value = write_term(code, term, bound, stack.labels[i])
        if value is None:
            raise LookupError(f"{term.name} has no source for {evaluating.scene.cost[i].params}")
        put = f"VSTORE(cost + {i} * steps * WIDTH, {text(value)});"
        body.append(f"if (weight[{i}] != 0.0f) {{\n" + "\n".join((*lines.statements, put)) + "\n}")
    statements = "\n".join(body)
    names = (("q", "joint_q"), ("qd", "joint_qd"), ("body", "body_q"), ("twist", "body_qd"))
    now = [f"const float* {name}_now = {_slice(array, 't + 1')};" for name, array in names]
    now += [
        f"const float* {name}_now = {_slice(array, 't')};" for name, array in (("force", "force"), ("u", "control"))
    ]
    was = f"t > 0 ? {_slice('control', 't - 1')} : k.last.data + (size_t)group * k.last.shape[1] * WIDTH"
    controls = "\n".join(
        f"const T c{u} = VLOAD(u_now + {u} * WIDTH), d{u} = VLOAD(u_was + {u} * WIDTH);"
        for u in range(evaluating.layout.nu)
    )
    newline = "\n"
    return f"""{header(lanes)}
#if defined(__CUDA_ARCH__)
#define WIDTH 1
#else
#define WIDTH {lanes}
#endif
const int e = group / groups, steps = k.cost.shape[2];
const float* weight = k.weight.data + e * k.weight.shape[1];
for (int t = 0; t < steps; ++t) {{
const int at = t;
{newline.join(now)}
const float* u_was = {was};
{controls}
float* cost = k.cost.data + ((size_t)group * k.cost.shape[1] * steps + t) * WIDTH;
{statements}
}}
#undef WIDTH
"""


def _slice(array: str, t: str) -> str:
    return f"k.{array}.data + ((size_t)group * k.{array}.shape[1] + {t}) * k.{array}.shape[2] * WIDTH"


def make_kernel(source: str, params: Any, lanes: int) -> wp.Kernel:
    """The kernel of this source: one thread takes a group of worlds from the first step to the last."""
    options = {"cpu_compiler_flags": (wp.config.cpu_compiler_flags or "") + WIDE} if lanes == 16 else {}

    @wp.func_native(source)
    def evaluate(s: StepView, p: params, k: RecordWork, group: int, groups: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def native_kernel(s: StepView, p: params, groups: int, k: RecordWork):
        """One thread: all steps of one group."""
        evaluate(s, p, k, wp.tid(), groups)

    return native_kernel


_SCALAR = re.compile(r"\b(fmaxf|fminf|fabsf|sqrtf|rintf|floorf|exp2f)\(")
"""Functions of one float that Warp's compiler for CPUs knows by another name."""


class SourceEvaluator:
    """Costs of the rollouts of an :class:`Evaluating` by their source, all its terms in one kernel.

    Args:
        evaluating: Whose rollouts, and whose terms.
        lanes: Worlds in a number; 1 for what a GPU does.

    Raises:
        LookupError: If a term has none.
    """

    def __init__(self, evaluating: Evaluating, lanes: int | None = None):
        self.evaluating = evaluating
        self.lanes = native_lanes() if lanes is None else lanes
        source = write(evaluating, max(self.lanes, 4))
        if self.lanes == 1:
            source = _SCALAR.sub(r"__builtin_\1(", source.replace("#if defined(__CUDA_ARCH__)", "#if 1"))
        self.kernel = make_kernel(source, evaluating.stack.code.params, self.lanes)
        self.groups = -(-evaluating.shape.rollouts // self.lanes)
        self.read()

    def read(self) -> None:
        """Take the rollouts over."""
        evaluating, out = self.evaluating, self.evaluating.trajectory
        self.work = work = RecordWork()
        flat = {name: getattr(out, name).numpy() for name in ("joint_q", "joint_qd", "body_q", "body_qd")}
        flat |= {"force": out.contact_force.numpy(), "control": evaluating.control.numpy()}
        for name, values in flat.items():
            setattr(work, name, wp.array(self._grouped(values), dtype=float, device="cpu"))
        last = np.repeat(evaluating.state.last_control.numpy(), evaluating.shape.rollouts, axis=0)
        work.last = wp.array(self._grouped(last[None])[:, 0], dtype=float, device="cpu")
        terms, steps = len(evaluating.stack.terms), evaluating.shape.horizon
        work.cost = wp.zeros((evaluating.shape.envs * self.groups, terms, steps, self.lanes), dtype=float, device="cpu")

    def _grouped(self, values: np.ndarray) -> np.ndarray:
        """``[T, W, ...]`` as ``[group, T, n, L]``; the last world of an environment fills its last group up."""
        shape = self.evaluating.shape
        values = values.reshape(len(values), shape.envs, shape.rollouts, -1)
        chosen = np.minimum(np.arange(self.groups * self.lanes), shape.rollouts - 1)
        values = values[:, :, chosen].reshape(len(values), shape.envs * self.groups, self.lanes, -1)
        return np.ascontiguousarray(values.transpose(1, 0, 3, 2), dtype=np.float32)

    def launch(self) -> None:
        """Evaluate the terms."""
        self.work.weight = self.evaluating.state.weight
        inputs = [self.evaluating.evaluator.view, self.evaluating.stack.params, self.groups]
        wp.launch(self.kernel, self.evaluating.shape.envs * self.groups, inputs, [self.work], device="cpu")

    def cost(self) -> np.ndarray:
        """Cost of every term, step and world without its weight ``[term, T, W]``; zero without weight."""
        self.launch()
        shape, cost = self.evaluating.shape, self.work.cost.numpy()
        cost = cost.reshape(shape.envs, self.groups, *cost.shape[1:]).transpose(2, 3, 0, 1, 4)
        cost = cost.reshape(*cost.shape[:3], -1)[..., : shape.rollouts]
        return cost.reshape(*cost.shape[:2], -1).astype(np.float64)
