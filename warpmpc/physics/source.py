# SPDX-License-Identifier: Apache-2.0
"""The source of whole rollouts of one model: tables, baked functions, and the functions in ``native`` around them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from .base import BALL, BOX, CAPSULE, CYLINDER, ELLIPSOID, FREE, HFIELD, HINGE, MESH, PLANE, SLIDE, SPHERE, packed
from .coefficients import within
from .constraint_rows import ConstraintTables
from .dynamics import Dynamics
from .factor import MOST_OPERATIONS, couple, loop_tables, operations, write_products, write_solve
from .links import Links
from .meshes import field_tables, flat_geoms, mesh_tables, ring_size, ring_tables, touching_meshes
from .model import COLLIDES, CONVEX, FIELD
from .runtime.bake import CONTROL, literal, sincos
from .source_parts import Parts, floats, ints
from .tendons import with_angles
from .version import RULES

if TYPE_CHECKING:
    from .model import PairRow, PhysicsModel
    from .source_parts import AddedCode
    from .state_map import StateMap

POINTS = {(PLANE, CAPSULE): 2, (PLANE, BOX): 8, (CAPSULE, BOX): 2,
          (CAPSULE, CAPSULE): 2, (BOX, BOX): 8, (PLANE, CYLINDER): 4,
          (PLANE, MESH): 4}  # fmt: skip
"""Most contacts of two geoms; one where nothing is said."""
FACES = 4
"""The same of two flat shapes, by their faces."""
MOST_CONTACTS, GPU_CONTACTS, MOST_BYTES = 512, 64, 2**20
"""Contacts that there is room for at most (what touches at once is far less than what could), on a GPU, where a large
model has more; and bytes that more than these may take on a CPU."""
JOIN = 3
"""A pair joins a group of pairs with so many more degrees of freedom: fewer groups, hence fewer half-empty contacts."""


@dataclass(frozen=True)
class RolloutSource:
    """Writes the body of ``rollout(k: RolloutWork, group: int)``, with an evaluation's own inputs before these.

    Args:
        model: The model.
        state_map: Where the model keeps what is observed, driven, watched and recorded.
        lanes: Worlds in a vector on a CPU.
        shared: Whether on a GPU the lanes of a warp share a world; else every thread has its own.
        added: Statements that evaluate a rollout on the way, if there are any.
        knots: Most knots that a control depends on.
    """

    model: PhysicsModel
    state_map: StateMap
    lanes: int
    shared: bool
    added: AddedCode | None = None
    knots: int = 1

    def write(self) -> str:
        """The source."""
        return self.parts().whole()

    def parts(self) -> Parts:
        """Parts of the source."""
        dynamics = Dynamics(self.model, frozenset(self.state_map.kept), sensors=self.state_map.sensors)
        baked = (dynamics.write(), write_products(self.model), self._coupled())
        links, constraints = Links(dynamics), ConstraintTables(self.model)
        step = self._native("step").replace("SINCOS_HALF", sincos("half", "sine", "cosine"))
        step = step.replace("COLLISIONS", self._collisions())
        steps = [
            self._native("collide_common"),
            with_angles(self._native("wrap")),
            self._native("muscle"),
            *baked,
            self._native("links").replace("SINCOS_ANGLE", sincos("angle", "sine", "cosine", half=_HALF)),
            self._native("cones" if self.model.frictions > 1 else "pyramid"),
            self._native("contact"),
            *self._collision_sources(),
            self._native("constraints").replace("BIND", dynamics.bind),
            self._native("fluid"),
            self._native("solve")
            .replace("BLOCKS", self._blocks())
            .replace("PRIMAL", self._native("primal") if self.model.few else ""),
            self._native("watch"),
            *(self._native(name) for name in (("rays", "sense") if dynamics.sensing.sensors else ())),
            dynamics.sense,
            step,
        ]
        own = (constraints, dynamics.drive, dynamics.tendons, dynamics.fluid, dynamics.sensing)
        tables = [*self._tables(), *(text for part in own for text in part.tables())]
        columns = len(self.model.columns.values)  # all have been asked for
        defines = {**self._sizes, **links.sizes, **constraints.sizes, **dynamics.tendons.sizes, **dynamics.drive.sizes}
        defines |= dynamics.fluid.sizes | dynamics.sensing.sizes
        defines |= {"NPAR": max(1, columns), "PARAMETERS": columns, "LANES": self.lanes, **RULES}
        defines |= {"SHARED": int(self.shared), "SIZES_VARY": int(self._sizes_vary), "KNOTS_USED": self.knots}
        defines |= {"TERMS": int(self.added is not None), "FIRST": self.added.first if self.added else 0}
        defines |= self.state_map.sizes | {"MESHES": int(bool(touching_meshes(self.model)))}
        defines["TOLD"] = int(bool(defines["WATCHED"] or defines["SENSES_CONTACTS"]))
        return Parts(
            lanes=self.lanes,
            defines=defines,
            types=self._native("types"),
            tables=tables,
            warp_tables=links.tables(),
            world=[self._native(name) for name in ("simd", "world", "lanes")],
            steps=steps,
            joints=self._native("joints"),
            rollout=self._rollout(),
        )

    def _rollout(self) -> str:
        parts = {"STEP_CONTROL": CONTROL, "START": self._native("start"), "RECORD": self._native("record")}
        parts |= {"READ_BEFORE": self.state_map.readings.before, "READ_AFTER": self.state_map.readings.after}
        parts |= {f"TERMS_{name}": "" for name in ("START", "BEFORE", "STEP", "END")}
        if (own := self.added) is not None:
            texts = {"START": own.start, "BEFORE": own.before, "STEP": own.step, "END": own.end}
            parts |= {f"TERMS_{name}": text for name, text in texts.items()}
        return re.sub("|".join(sorted(parts, key=len, reverse=True)), lambda m: parts[m[0]], self._native("rollout"))

    def _native(self, name: str) -> str:
        return files(__package__).joinpath("native", f"{name}.h").read_text(encoding="utf-8")

    @cached_property
    def _groups(self) -> list[tuple[int, tuple[int, ...]]]:
        """Rows of each contact of a group of pairs, and its degrees of freedom."""
        groups: list[tuple[int, tuple[int, ...]]] = []
        for condim, dofs in sorted({(p.condim, p.dofs) for p in self.model.pairs}, key=lambda g: (-len(g[1]), g)):
            if not any(self._fits(condim, dofs, group) for group in groups):
                groups.append((condim, dofs))
        return groups

    def _fits(self, condim: int, dofs: tuple[int, ...], group: tuple[int, tuple[int, ...]]) -> bool:
        return group[0] == condim and set(dofs) <= set(group[1]) and len(group[1]) <= len(dofs) + JOIN

    def _group(self, pair: PairRow) -> int:
        return next(i for i, group in enumerate(self._groups) if self._fits(pair.condim, pair.dofs, group))

    def _couples(self, dofs: tuple[int, ...]) -> bool:
        """Return whether contacts of a group couple branches of the tree."""
        above = self.model.ancestors
        return any(j not in above[i] for i in dofs for j in dofs if j < i)

    def _coupled(self) -> str:
        """The solve for matrices that all groups have added to, unless it is in loops."""
        solve = "" if self._looped else write_solve("solve_coupled", self._coupled_rows)
        return "\n".join(("#if !COOPERATE", solve, "#endif"))

    @cached_property
    def _coupled_rows(self) -> list[list[int]]:
        constraints = (constraint.dofs for constraint in self.model.constraints)
        return couple(self.model, [*(dofs for _, dofs in self._groups), *constraints])

    @property
    def _looped(self) -> bool:
        return operations(self._coupled_rows) > MOST_OPERATIONS

    @cached_property
    def _sizes_vary(self) -> bool:
        sizes = self.model.array("geom_size")
        return any(self.model.columns.differ(size) for size in sizes.reshape(len(sizes), -1).T)

    @cached_property
    def _sizes(self) -> dict[str, object]:
        m, model = self.model.mj, self.model
        longest = max([1, *(len(dofs) for _, dofs in self._groups)])
        bound = sum(self._points(pair) for pair in model.pairs)
        turning = int(np.isin(m.jnt_type, (FREE, BALL)).sum())
        return {
            "NQ": m.nq,
            "NV": m.nv,
            "NU": max(1, m.nu),
            "NMOCAP": max(1, m.nmocap),
            "NG": max(1, m.ngeom),
            "NB": max(1, len(self.state_map.kept)),
            "NH": packed(m.nv, 0),
            "NLIMIT": max(1, len(model.limited)),
            "LIMITS": len(model.limited),
            "CAPACITY": self._room(bound, longest),
            "PAIRS": len(model.pairs),
            **self._row_sizes,
            "RING": ring_size(model),
            "FIELDS": sum(any(g in pair.geoms for pair in model.pairs) for g in model.fields),
            "HEIGHTS": len(model.fields),
            "LOOPED": int(self._looped),
            "NNZ": longest,
            "SOFT": 7 if model.powers else 4,
            "NTRIANGLE": packed(longest, 0),
            "FREE_JOINT": FREE,
            "BALL_JOINT": BALL,
            "SLIDE_JOINT": SLIDE,
            "TURNING": turning,
            "SCALARS": m.njnt - turning,
            **{f"GIVEN_{name}": at for name, at in self.model.given_at.items()},
            "TIMESTEP": literal(float(m.opt.timestep)),
        }

    def _room(self, bound: int, longest: int) -> str:
        """Contacts that there is room for, by the device."""
        least = GPU_CONTACTS * (max(1, 96 // longest) if self.model.large else 1)
        size = 4 * self.lanes * int(str(self._row_sizes["ROWS"])) * (longest + 3)
        gpu, cpu = (max(1, min(bound, MOST_CONTACTS, room)) for room in (least, max(least, MOST_BYTES // size)))
        return str(cpu) if cpu == gpu else f"BY_DEVICE({gpu}, {cpu})"

    def _points(self, pair: PairRow) -> int:
        """Most contacts of a pair."""
        if set(pair.geoms) <= self._flat:
            return POINTS.get(self._kind(pair), FACES)
        kind = self._kind(pair)
        return MOST_CONTACTS if kind[0] == HFIELD else POINTS.get(kind, 1)

    def _kind(self, pair: PairRow) -> tuple[int, int]:
        return tuple(int(self.model.mj.geom_type[g]) for g in pair.geoms)

    @cached_property
    def _flat(self) -> set[int]:
        return flat_geoms(self.model)

    @cached_property
    def _row_sizes(self) -> dict[str, object]:
        """Count of numbers that the rows of a contact take."""
        model, condims = self.model, {condim for condim, _ in self._groups}
        rows = max(condims, default=1)
        alike = len(condims) == 1
        return {
            "ROWS": rows,
            "ROWS_OF(c)": rows if alike else "group_rows[(c).group]",
            "FRICTIONS": model.frictions,
            "CURVE": packed(rows, 0) if model.elliptic else max(5, 2 * rows - 1),
            "PUSH": max(3, rows),
            "ELLIPTIC": int(model.elliptic),
            "SLIP_DAMPING": "pair_slip" if model.slips else "pair_damping",
            "CONE_SLOPE": literal(float(model.mj.opt.impratio) ** -0.5),
        }

    def _tables(self) -> list[str]:
        """Constant tables of pairs, groups, limits, geoms and joints."""
        m, model, pairs = self.model.mj, self.model, self.model.pairs
        index = model.columns.index
        groups = [self._group(pair) for pair in pairs]
        longest = int(self._sizes["NNZ"])
        dofs = np.zeros((len(self._groups), longest), int)
        entries = np.zeros((len(self._groups), packed(longest, 0)), int)
        for g, (_, chain) in enumerate(self._groups):
            dofs[g, : len(chain)] = chain
            for a, i in enumerate(chain):
                for b, j in enumerate(chain[: a + 1]):
                    entries[g, packed(a, b)] = packed(i, j)
        signs = np.zeros((len(pairs), longest))
        for n, pair in enumerate(pairs):
            chain = self._groups[groups[n]][1]
            signs[n, [chain.index(dof) for dof in pair.dofs]] = pair.signs
        limited, limits = model.limited, model.limits
        limit_dofs = [int(m.jnt_dofadr[j]) for j in limited]
        inverse = model.array("dof_invweight0")
        sizes = model.array("geom_size")
        size_at = [index(sizes[:, g, k]) for g in range(m.ngeom) for k in range(3)]
        scalar = [j for j in range(m.njnt) if m.jnt_type[j] in (SLIDE, HINGE)]
        turning = [j for j in range(m.njnt) if m.jnt_type[j] in (FREE, BALL)]
        return [
            ints("pair_group", groups),
            floats("pair_sign", signs),
            floats("pair_margin", [pair.margin for pair in pairs]),
            ints("pair_friction_at", [self._friction_at(pair) for pair in pairs]),
            ints("pair_inverse_at", [index(pair.inverse) for pair in pairs]),
            floats("pair_stiffness", [pair.rows.stiffness for pair in pairs]),
            floats("pair_damping", [pair.rows.damping for pair in pairs]),
            *([floats("pair_slip", [pair.slip for pair in pairs])] if model.slips else []),
            floats("pair_impedance", model.impedances([pair.rows for pair in pairs])),
            ints("group_count", [len(chain) for _, chain in self._groups]),
            ints("group_slides", [condim > 1 for condim, _ in self._groups]),
            ints("group_rows", [condim for condim, _ in self._groups]),
            ints("group_couples", [self._couples(chain) for _, chain in self._groups]),
            ints("group_dof", dofs),
            ints("group_entry", entries, "short"),
            ints("limit_dof", limit_dofs),
            ints("limit_q", [m.jnt_qposadr[j] for j in limited]),
            floats("limit_range", within(m.jnt_range[limited])),
            floats("limit_margin", m.jnt_margin[limited]),
            floats("limit_stiffness", [rows.stiffness for rows in limits]),
            floats("limit_damping", [rows.damping for rows in limits]),
            floats("limit_impedance", model.impedances(limits)),
            ints("limit_inverse_at", [index(inverse[:, dof]) for dof in limit_dofs]),
            ints("geom_size_at", size_at),
            ints("triangle_row", [i for i in range(longest) for _ in range(i + 1)], "short"),
            ints("dof_top", model.dof_top),
            ints("scalar_q", m.jnt_qposadr[scalar]),
            ints("scalar_dof", m.jnt_dofadr[scalar]),
            ints("turning_q", m.jnt_qposadr[turning]),
            ints("turning_dof", m.jnt_dofadr[turning]),
            ints("turning_free", m.jnt_type[turning] == FREE),
            floats("mocap_rest", model.mocap_rest),
            floats("rest_q", m.qpos0),
            ints("drive_free", (m.actuator_ctrllimited == 0) | model.off("CLAMPCTRL")),
            *self.state_map.tables(len(pairs), groups),
            *mesh_tables(model),
            *(loop_tables(self._coupled_rows) if self._looped else ()),
            *field_tables(model),
            *ring_tables(model, ring_size(model)),
        ]

    def _friction_at(self, pair: PairRow) -> list[int]:
        """Columns of a pair's coefficients of friction, -1 where all worlds are alike."""
        index = self.model.columns.index
        return [index(pair.friction[:, k]) if k + 1 < pair.condim else -1 for k in range(self.model.frictions)]

    def _blocks(self) -> str:
        return " ".join(f"BLOCK({n})" for n in sorted({len(dofs) for _, dofs in self._groups}))

    def _kinds(self) -> dict[tuple[int, int], list[int]]:
        """Numbers of the pairs of each kind."""
        m, out = self.model.mj, {}
        for n, pair in enumerate(self.model.pairs):
            out.setdefault(tuple(int(m.geom_type[g]) for g in pair.geoms), []).append(n)
        return out

    def _collision_sources(self) -> list[str]:
        found = self._kinds()
        sizes = {"manifold": "RING", "field": "FIELDS"}
        needed = [n for n, need in _SOURCES.items() if (self._sizes[sizes[n]] if n in sizes else need & set(found))]
        return [self._native(name) for name in needed]

    def _collisions(self) -> str:
        """Statements that look at all pairs, kind by kind."""
        out = []
        for kind, numbers in self._kinds().items():
            name = "_".join(_NAMES[k] for k in kind)
            firsts = ", ".join(str(self.model.pairs[n].geoms[0]) for n in numbers)
            seconds = ", ".join(str(self.model.pairs[n].geoms[1]) for n in numbers)
            out.append(
                f"{{ static const int first[] = {{{firsts}}}, second[] = {{{seconds}}};\n"
                f"NEAR_PAIRS({len(numbers)}, {numbers[0]}, {name}, {{ {_near(kind)} }}) }}"
            )
        return "\n".join(out)


_HALF = ("half_sine", "half_cosine")
_NAMES = {
    PLANE: "plane",
    SPHERE: "sphere",
    CAPSULE: "capsule",
    CYLINDER: "cylinder",
    BOX: "box",
    ELLIPSOID: "ellipsoid",
    MESH: "mesh",
    HFIELD: "hfield",
}
_BOXES = frozenset({(BOX, BOX)})
_SOURCES = {
    "collide_primitive": COLLIDES - CONVEX - _BOXES,
    "collide_box": _BOXES,
    "shapes": CONVEX | FIELD,
    "manifold": CONVEX,
    "collide_convex": CONVEX | FIELD,
    "field": FIELD,
}
"""Files with collision functions, each after those that it calls, and the kinds of pairs each is for."""


def _near(kind: tuple[int, int]) -> str:
    """The bounding test of a kind of pairs."""
    if kind[0] == PLANE:
        return "near = near_plane(w, pair, a, b);"
    if kind == (BOX, BOX):  # both ways: one box may be large
        return "near = near_box(w, pair, a, b); if (VANY(near)) near &= near_box(w, pair, b, a);"
    if kind[1] == BOX:
        return "near = near_box(w, pair, a, b);"
    return "near = near_spheres(w, pair, a, b);"
