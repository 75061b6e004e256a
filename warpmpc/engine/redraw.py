# SPDX-License-Identifier: Apache-2.0
"""Physical properties that rollouts draw anew in every plan, put where each engine reads them, on its device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ..kernels.engine.randomize import (
    FRICTION_COLUMN,
    PYRAMID_COLUMN,
    ColumnTables,
    column_kernel,
    copy_numbers_kernel,
    put_numbers_kernel,
)
from ..physics.runtime.launch import Launcher
from ..scene.errors import SceneError
from ..scene.model.drawn_model import DrawnModel
from ..scene.model.properties import extremes

if TYPE_CHECKING:
    from collections.abc import Sequence

    import mujoco_warp

    from ..physics.model import PairRow, PhysicsModel
    from ..scene.model.mujoco_model import MujocoWorld
    from ..scene.model.properties import Properties
    from ..scene.model.trajectory import BatchSize

CHANGE = 0.1
"""Share of a number by which it is changed to see which columns follow from it."""


def drawn_rows(world: MujocoWorld, properties: Properties) -> np.ndarray:
    """Numbers of a model at the ends of what may be drawn, the first row nominal ``[n, numbers]``."""
    return DrawnModel(world, extremes(properties)).values.numpy()


class Redraw(ABC):
    """Draws anew and puts the numbers where they are read.

    Args:
        drawn: The numbers.
    """

    def __init__(self, drawn: DrawnModel):
        self._drawn, self._launch = drawn, Launcher(drawn.device)

    def __call__(self) -> None:
        """Draw anew; capture-safe."""
        self._drawn.redraw()
        self._put()

    def reset(self) -> None:
        """Forget every earlier plan: the next one draws what the first one drew."""
        self._drawn.reset()

    @abstractmethod
    def _put(self) -> None:
        """Put the numbers where they are read."""


class RedrawnModels(Redraw):
    """Models of MuJoCo's C engine, one for each draw.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        models: The models, whose numbers are written in place.
    """

    def __init__(self, world: MujocoWorld, properties: Properties, models: Sequence[mujoco.MjModel]):
        super().__init__(DrawnModel(world, properties))
        self._models = models
        place, address = [], []
        vary = np.ptp(drawn_rows(world, properties), axis=0) > 0.0
        for name, numbers in self._drawn.place.items():
            own = np.flatnonzero(vary[numbers])
            place += (numbers.start + own).tolist()
            first = np.array([getattr(model, name).ctypes.data for model in models], dtype=np.uint64)
            address.append(first[:, None] + 8 * own.astype(np.uint64))
        self._place = wp.array(place, dtype=int, device="cpu")
        self._address = wp.array(np.hstack(address), dtype=wp.uint64, device="cpu")

    def _put(self) -> None:
        inputs = [self._drawn.values, self._place, self._address]
        self._launch(put_numbers_kernel, len(self._models), inputs, [])


class RedrawnWorlds(Redraw):
    """Numbers of the worlds of a batch, each with the draw that it has.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        shape: Sizes of the batch.
        device: Warp device.
    """

    def __init__(self, world: MujocoWorld, properties: Properties, shape: BatchSize, device: str):
        super().__init__(DrawnModel(world, properties, device))
        self._draw = wp.array(properties.of_worlds(shape), dtype=int, device=device)


class RedrawnArrays(RedrawnWorlds):
    """Arrays of a model of MuJoCo Warp.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        shape: Sizes of the batch.
        device: Warp device.
    """

    def __init__(self, world: MujocoWorld, properties: Properties, shape: BatchSize, device: str):
        super().__init__(world, properties, shape, device)
        vary = np.ptp(drawn_rows(world, properties), axis=0) > 0.0
        self.names = tuple(name for name, numbers in self._drawn.place.items() if vary[numbers].any())
        """Arrays that differ between worlds."""
        self._arrays: list[tuple[int, wp.array]] = []

    def bind(self, model: mujoco_warp.Model) -> None:
        """Take the arrays of a model, which has them for every world, and fill them."""
        worlds = len(self._draw)
        for name in self.names:
            array, numbers = getattr(model, name), self._drawn.place[name]
            shape = (worlds, numbers.stop - numbers.start)
            flat = wp.array(ptr=array.ptr, dtype=float, shape=shape, device=array.device)
            self._arrays.append((numbers.start, flat))
        self._model = model
        self._put()

    def _put(self) -> None:
        for first, array in self._arrays:
            self._launch(copy_numbers_kernel, array.shape, [self._drawn.values, self._draw, first], [array])


class RedrawnColumns(RedrawnWorlds):
    """Columns of the engine ``fused``.

    How a column follows from the numbers of a model is found by changing one number after the other: it is their sum,
    each times a constant, but for frictions of contacts that are the larger of two, and for what regularizes pyramids.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        shape: Sizes of the batch.
        device: Warp device.
    """

    def __init__(self, world: MujocoWorld, properties: Properties, shape: BatchSize, device: str):
        super().__init__(world, properties, shape, device)
        ends = drawn_rows(world, properties)
        vary = np.flatnonzero(np.ptp(ends, axis=0) > 0.0)
        _, first, group = np.unique(ends[:, vary], axis=1, return_index=True, return_inverse=True)
        self._vary = vary[first]
        """Numbers that may be drawn, one of those that are alike."""
        changed = np.tile(ends[0], (len(self._vary), 1))
        self._step = CHANGE * ends[0][self._vary]
        changed[np.ravel(group), vary] += self._step[np.ravel(group)]
        self._rows = np.vstack([ends[:1], changed, ends[1:]])
        every = self._drawn.arrays(self._rows)
        self.arrays = {name: values for name, values in every.items() if np.ptp(values, axis=0).any()}
        """Arrays of the model ``[n, ...]``, nominal, with one number changed, and at the ends of what may be drawn."""

    def bind(self, model: PhysicsModel, par: wp.array) -> None:
        """Fill the columns ``[columns, W]`` of a model with :attr:`arrays` whose source is written.

        Raises:
            SceneError: If a column does not follow from draws in a way that is known here.
        """
        self._par, columns = par, model.columns.values
        self._count, n = len(columns), len(self._vary)
        constant, shares, kind, friction = [], [], [], []
        for values in columns:
            slope = (values[1 : n + 1] - values[0]) / self._step
            sum_of = dict(zip(self._vary[slope != 0.0].tolist(), slope[slope != 0.0].tolist(), strict=True))
            base = values[0] - self._rows[0][self._vary] @ slope
            of, places = 0, (0, 0)
            if not np.allclose(base + self._rows[:, self._vary] @ slope, values, rtol=1e-9, atol=1e-12):
                of, places, sum_of = self._contact(model, values)
                base = 0.0
            constant.append(base)
            shares.append(sum_of)
            kind.append(of)
            friction.append(places)
        self._tables = self._upload(constant, shares, kind, friction, float(model.mj.opt.impratio))
        self._put()

    def _put(self) -> None:
        if self._count:
            inputs = [self._tables, self._drawn.values, self._draw]
            self._launch(column_kernel, (self._count, len(self._draw)), inputs, [self._par])

    def _upload(
        self, constant: list[float], shares: list[dict], kind: list[int], friction: list[tuple], impratio: float
    ) -> ColumnTables:
        def array(values: object, dtype: type = int) -> wp.array:
            return wp.array(np.array(values), dtype=dtype, device=self._par.device)

        out = ColumnTables()
        out.constant, out.kind = array(constant, wp.float64), array(kind)
        out.entry = array(np.cumsum([0, *(len(row) for row in shares)]))
        out.place = array([place for row in shares for place in row])
        out.share = array([share for row in shares for share in row.values()], wp.float64)
        out.friction, out.impratio = array(np.reshape(friction, (-1, 2))), impratio
        return out

    def _contact(self, model: PhysicsModel, values: np.ndarray) -> tuple[int, tuple[int, int], dict[int, float]]:
        """Kind of a column that is a contact's, the numbers whose larger is its friction, and what is summed up."""
        m, place = model.mj, self._drawn.place
        for pair in model.pairs:
            if any(np.array_equal(pair.friction[:, k], values) for k in range(2)):
                return int(FRICTION_COLUMN), self._frictions(model, pair), {}
            if np.array_equal(pair.inverse, values):
                weights: dict[int, float] = {}
                for geom in pair.geoms:
                    at = place["body_invweight0"].start + 2 * int(m.geom_bodyid[geom])
                    weights[at] = weights.get(at, 0.0) + 1.0
                return int(PYRAMID_COLUMN), self._frictions(model, pair), weights
        raise SceneError(
            "the engine fused cannot draw anew what a fluid's drag follows from: leave out redraw",
            key="randomize",
            allowed=["mujoco", "mujoco_warp"],
        )

    def _frictions(self, model: PhysicsModel, pair: PairRow) -> tuple[int, int]:
        """Numbers whose larger is the sliding friction of a pair."""
        m, place, geoms = model.mj, self._drawn.place, pair.geoms
        told = [p for p in range(m.npair) if {int(m.pair_geom1[p]), int(m.pair_geom2[p])} == set(geoms)]
        if told:
            return (place["pair_friction"].start + 5 * told[0],) * 2
        highest = max(int(m.geom_priority[g]) for g in geoms)
        at = [place["geom_friction"].start + 3 * g for g in geoms if m.geom_priority[g] == highest]
        return at[0], at[-1]
