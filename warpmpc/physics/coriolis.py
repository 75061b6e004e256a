# SPDX-License-Identifier: Apache-2.0
"""Source of the derivatives of bias forces by velocity, and of the accelerations of MuJoCo's integrator ``implicit``.

With axes S, their rates of change, and velocity V, momentum and inertia of every body about its tree's point, the
derivative of the bias of degree of freedom i by the velocity of j above it is S_i · (2 B S_j + I (dS_j/dt before joint
j + after it)), B and I of everything from i on; that of j by i likewise (Singh, Russell and Wensing 2022, "Efficient
analytical derivatives of rigid-body dynamics using spatial vector algebra"). Of 2 B = V ×* I - I V × + (I V) ×* there
remain two blocks, which only axes that turn meet: C = [ω]J - J[ω] - [Jω] - 2 [m][v] for the torque and twice S × p for
the force, with J the inertia, m the mass times the centre, v and p the linear velocity and momentum.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .base import packed
from .factor import less
from .runtime.bake import Lines, Operand, Vector, text

if TYPE_CHECKING:
    from .model import PhysicsModel


class Coriolis:
    """Writes the derivatives of one tree.

    Args:
        model: The model.
        lines: Takes the statements.
    """

    def __init__(self, model: PhysicsModel, lines: Lines):
        self.model, self.lines = model, lines
        self._rates: dict[int, tuple[Vector, Vector]] = {}

    def moved(
        self, dofs: range, before: tuple, after: tuple, turns: dict[int, Vector], slides: dict[int, Vector]
    ) -> None:
        """Keep how the axes of a joint change, before and after its own motion, added up."""
        lines = self.lines
        spin, speed = (_sum(lines, before[k], after[k]) for k in (0, 1))
        for i in dofs:
            swept = _sum(lines, lines.cross(spin, slides[i]), lines.cross(speed, turns[i]))
            self._rates[i] = lines.cross(spin, turns[i]), swept

    def swirl(self, inertia: list[Operand], motion: tuple, turned: Vector, push: Vector) -> list[Operand]:
        """C by rows and p of one body, from its inertia, its motion, J ω and p."""
        lines, (spin, speed) = self.lines, motion[:2]
        xx, yy, zz, xy, xz, yz, *moment = inertia[:9]
        crossed = [lines.cross(spin, column) for column in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])]
        x, y, z = turned
        bent: list[Vector] = [[0.0, z, _less(lines, y)], [_less(lines, z), 0.0, x], [y, _less(lines, x), 0.0]]
        along = lines.dot(moment, speed)
        out = []
        for i in range(3):
            for j in range(3):
                twice = lines.sum((speed[i], moment[j]))
                rest = [(2.0, along)] if i == j else []
                out.append(lines.sum(crossed[j][i], crossed[i][j], bent[i][j], (-2.0, twice), *rest))
        return [*out, *push]

    def write(
        self, i: int, axis: tuple[Vector, Vector], momentum: tuple[Vector, Vector], weight: tuple, swirl: Vector,
        axes: tuple[dict[int, Vector], dict[int, Vector]],
    ) -> None:  # fmt: skip
        """Write the derivatives between a degree of freedom and those above.

        Args:
            i: The degree of freedom.
            axis: Its axis, turning and sliding.
            momentum: Angular and linear momentum of everything from it on that moves at its axis.
            weight: Functions of the inertia of all this: angular and linear momentum of any motion.
            swirl: C and p of all this.
            axes: Those of all degrees of freedom.
        """
        lines, above = self.lines, self.model.ancestors[i]
        (turn, slide), (torque, force), (rate, sweep) = axis, momentum, self._rates[i]
        rows, push = [swirl[3 * k : 3 * k + 3] for k in range(3)], swirl[9:]
        more, pull = weight(rate, sweep)
        up = [lines.sum(lines.dot(row, turn), x) for row, x in zip(rows, more, strict=True)]
        swept = lines.cross(turn, push)
        out = [lines.sum((2.0, x), y) for x, y in zip(swept, pull, strict=True)]
        back = lines.cross(push, slide)
        down = [lines.sum(lines.dot([row[k] for row in rows], turn), (2.0, back[k])) for k in range(3)]
        lines.add(f"w.skew[{i}] = {text(lines.sum(*zip(turn, up, strict=True), *zip(slide, out, strict=True)))};")
        first = first_above(self.model, i)
        for n, j in enumerate(above):
            turns, slides = axes[0][j], axes[1][j]
            upper = lines.sum(*zip(turns, up, strict=True), *zip(slides, out, strict=True))
            parts = (turns, down), (torque, self._rates[j][0]), (force, self._rates[j][1])
            lower = lines.sum(*(pair for a, b in parts for pair in zip(a, b, strict=True)))
            lines.add(f"w.skew_up[{first + n}] = {text(upper)}; w.skew_down[{first + n}] = {text(lower)};")


def first_above(model: PhysicsModel, i: int) -> int:
    """Number of the first of the pairs of a degree of freedom and those above."""
    return sum(len(chain) for chain in model.ancestors[:i])


def write_skewed_solve(model: PhysicsModel, spread: dict[tuple[int, int], int]) -> str:
    """Source of ``solve_skewed``, by elimination along the trees from the last degree of freedom on, without pivots."""
    if not model.skewed:
        return ""
    nv, above, step = model.mj.nv, model.ancestors, "TIMESTEP"
    out = ["FN void solve_skewed(World& w) {"]
    for i in range(nv):
        out.append(f"T a{i}_{i} = w.mm[{packed(i, i)}] + w.damp[{i}] + {step} * w.skew[{i}], x{i} = w.fs[{i}];")
        for n, j in enumerate(above[i]):
            more = f" + w.spread[{spread[i, j]}]" if (i, j) in spread else ""
            at = first_above(model, i) + n
            out.append(f"const T m{i}_{j} = w.mm[{packed(i, j)}]{more};")
            out.append(f"T a{i}_{j} = m{i}_{j} + {step} * w.skew_down[{at}];")
            out.append(f"T a{j}_{i} = m{i}_{j} + {step} * w.skew_up[{at}];")
    for k in reversed(range(nv)):
        out.append(f"const T d{k} = 1.0f / a{k}_{k};")
        for i in above[k]:
            out.append(f"const T f{i}_{k} = a{i}_{k} * d{k};")
            out += [less(f"a{i}_{j}", f"f{i}_{k}", f"a{k}_{j}") for j in above[k]]
            out.append(less(f"x{i}", f"f{i}_{k}", f"x{k}"))
    for k in range(nv):
        out += [less(f"x{k}", f"a{k}_{j}", f"x{j}") for j in sorted(above[k])]
        out.append(f"w.search[{k}] = x{k} *= d{k};")
    return "\n".join(("#if !COOPERATE", *out, "}", "#endif"))


def _sum(lines: Lines, *vectors: Vector) -> Vector:
    return [lines.sum(*parts) for parts in zip(*vectors, strict=True)]


def _less(lines: Lines, x: Operand) -> Operand:
    return lines.sum((-1.0, x))
