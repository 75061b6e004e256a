# SPDX-License-Identifier: Apache-2.0
"""Numbers of MuJoCo models: which model it is, and what differs between models of one structure."""

from __future__ import annotations

import ctypes
import hashlib
import operator
import weakref
from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import mujoco
import numpy as np

from .fields import says_something

VARYING = (
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "tendon_invweight0",
    "geom_friction",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "actuator_acc0",
)
"""Arrays in which the worlds of a batch may differ; those that MuJoCo derives from the others among them."""
_VECTORS = ("opt.gravity", "opt.wind", "opt.magnetic", "opt.o_solref", "opt.o_solimp", "opt.o_friction")
"""Options that are arrays."""
_NUMBERS = operator.attrgetter(
    *(
        name
        for name in (*(f"opt.{own}" for own in dir(mujoco.MjOption) if not own.startswith("_")), "stat.meaninertia")
        if name not in _VECTORS and says_something(name)
    )
)
_NEAR = 64
"""Bytes between arrays of one piece of memory at most, by which MuJoCo aligns them."""


class _Views:
    """The memory of a model's arrays: those that may differ between worlds, and pieces with all others.

    Args:
        model: The model, which must live as long as the views are read.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = weakref.ref(model)
        self.varying = [getattr(model, name) for name in VARYING]
        self._varying = [_span(values) for values in self.varying]
        self._parts = SimpleNamespace(opt=model.opt, stat=model.stat)  # the model itself is not held
        self._vectors = [operator.attrgetter(name)(model) for name in _VECTORS]
        spans = sorted(
            _span(value)
            for name in dir(model)
            if not name.startswith(("_",) if _meshes_touch(model) else ("_", "mesh_"))
            if name not in VARYING and says_something(name)
            if isinstance(value := getattr(model, name), np.ndarray) and value.nbytes
        )
        pieces: list[list[int]] = []
        for at, size in spans:
            if pieces and 0 <= at - pieces[-1][1] < _NEAR:
                pieces[-1][1] = at + size
            else:
                pieces.append([at, at + size])
        self._pieces = [(start, end - start) for start, end in pieces]

    def fixed(self) -> tuple[list[bytes], tuple]:
        """Pieces of memory and options that may not differ between worlds."""
        vectors = [vector.tobytes() for vector in self._vectors]
        return [*vectors, *(ctypes.string_at(*piece) for piece in self._pieces)], _NUMBERS(self._parts)

    def differing(self, others: Sequence[_Views]) -> list[int]:
        """Indices of the arrays that may differ between worlds and are others in some of these models."""
        own = [ctypes.string_at(*span) for span in self._varying]
        return [n for n, one in enumerate(own) if any(ctypes.string_at(*o._varying[n]) != one for o in others)]


def _meshes_touch(m: mujoco.MjModel) -> bool:
    """Return whether some geom is a mesh that may touch anything: others are large, and not read."""
    may = (m.geom_contype | m.geom_conaffinity) != 0
    may[m.pair_geom1], may[m.pair_geom2] = True, True
    return bool((may & (m.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))).any())


def _span(values: np.ndarray) -> tuple[int, int]:
    """Address and size of an array [bytes]."""
    return values.__array_interface__["data"][0], values.nbytes


def _differing(model: mujoco.MjModel, other: mujoco.MjModel) -> Iterator[str]:
    """Names of what may not differ between worlds and is another in two models."""
    options = (f"opt.{name}" for name in dir(mujoco.MjOption))
    for name in (*dir(model), *options):
        if not name.startswith(("_", "opt._")) and name not in VARYING and says_something(name):
            values, others = (operator.attrgetter(name)(one) for one in (model, other))
            if isinstance(values, np.ndarray | float | int) and not np.array_equal(values, others):
                yield name


class _Known:
    """A copy of a model's numbers, and its key."""

    def __init__(self, views: _Views):
        self.pieces, self.options = views.fixed()
        out = hashlib.blake2b(repr(self.options).encode(), digest_size=16)
        for piece in self.pieces:
            out.update(piece)
        self.key = out.digest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Views):
            return NotImplemented
        return other.fixed() == (self.pieces, self.options)

    __hash__ = None


class ModelNumbers:
    """Tells models apart, at each look: their numbers may have been changed since the last."""

    def __init__(self) -> None:
        self._views: dict[int, _Views] = {}
        self._known: _Known | None = None

    def of(self, models: Sequence[mujoco.MjModel]) -> tuple[bytes, dict[str, np.ndarray] | str]:
        """Return a key of the first model, and what differs between all.

        Args:
            models: One for all worlds, or one for each.

        Returns:
            A key that other models share which can roll out in one batch, and the arrays that differ, ``[W, ...]``
            each; or in their place the names of what may not differ and does.
        """
        several = len({id(model) for model in models}) > 1
        views = [self._view(model) for model in (models if several else models[:1])]
        if self._known is None or self._known != views[0]:
            del self._views[id(models[0])]  # other geoms may touch now
            views[0] = self._view(models[0])
            self._known = _Known(views[0])
        arrays: dict[str, np.ndarray] | str = {}
        if several:
            other = next((model for model, view in zip(models, views, strict=True) if self._known != view), None)
            if other is not None:
                arrays = ", ".join(_differing(models[0], other))
            else:
                stacked = ((i, np.stack([v.varying[i] for v in views])) for i in views[0].differing(views[1:]))
                arrays = {VARYING[i]: values for i, values in stacked if (values != values[:1]).any()}
        out = hashlib.blake2b(self._known.key, digest_size=16)
        for name, values in zip(VARYING, views[0].varying, strict=True):
            out.update(b"" if name in arrays else values.tobytes())
        return out.digest(), arrays

    def _view(self, model: mujoco.MjModel) -> _Views:
        found = self._views.get(id(model))
        if found is None or found.model() is not model:
            self._views = {key: view for key, view in self._views.items() if view.model() is not None}
            found = self._views[id(model)] = _Views(model)
        return found
