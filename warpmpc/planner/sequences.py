# SPDX-License-Identifier: Apache-2.0
"""Control sequences from a file, as knots of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..engine.timegrid import TimeGrid
from ..model.assets import resolve_asset
from ..model.npz import read_npz
from ..scene.errors import SceneError
from .splines import fitted_knots

if TYPE_CHECKING:
    from pathlib import Path

    from ..scene.schema import Scene

KEY = "planner.sequences"


def sequences(scene: Scene, knot_time: np.ndarray, nu: int) -> np.ndarray:
    """The sequences of a scene's file as knots ``[n, P, nu]``, none without one.

    A sequence has a control for every knot, or for every step of a rollout: then its knots are those whose spline
    comes nearest to it in the least-squares sense, which is the sequence itself where there are as many knots as steps.

    Args:
        knot_time: Times of the knots after the first ``[P]`` [s].

    Raises:
        SceneError: If the file is missing, cannot be read or has the wrong shape.
    """
    name = scene.planner.sequences
    if name is None:
        return np.zeros((0, len(knot_time), nu), dtype=np.float32)
    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(name, base=base, key=KEY, file=scene.path)
    values = _read(path, scene)
    grid, knots = TimeGrid.of(scene), len(knot_time)
    counts = dict.fromkeys((grid.steps, knots))
    if values.ndim == 2 and path.suffix == ".csv":
        lengths = [count for count in counts if count * nu == values.shape[1]]
        values = values.reshape(len(values), -1, nu) if lengths else values
    if values.ndim != 3 or not len(values) or values.shape[1] not in counts or values.shape[2] != nu:
        shapes = [f"[n, {count}, {nu}]" for count in counts]
        if path.suffix == ".csv":
            shapes = [f"lines of {count * nu} numbers" for count in counts]
        raise _error(scene, f"has the shape {list(values.shape)}", allowed=" or ".join(shapes))
    if not np.all(np.isfinite(values)):
        raise _error(scene, "has numbers that are not finite")
    if values.shape[1] == knots:
        return values.astype(np.float32)
    return fitted_knots(scene.planner.spline, knot_time, values, grid.t[:-1])


def _read(path: Path, scene: Scene) -> np.ndarray:
    """The numbers of a file."""
    try:
        match path.suffix:
            case ".npy":
                values = np.load(path, allow_pickle=False)
            case ".csv":
                values = np.loadtxt(path, delimiter=",", ndmin=2)
            case ".npz":
                with read_npz(path) as arrays:
                    if len(arrays.files) != 1:
                        raise _error(scene, f"holds {len(arrays.files)} arrays, not one")
                    values = arrays[arrays.files[0]]
            case _:
                raise _error(scene, "is no file of arrays", allowed=[".csv", ".npy", ".npz"])
        return np.asarray(values, dtype=np.float64)
    except SceneError:
        raise
    except (OSError, ValueError, TypeError, EOFError) as error:
        raise _error(scene, f"cannot be read as numbers: {error}") from error


def _error(scene: Scene, message: str, allowed: object = None) -> SceneError:
    return SceneError(message, key=KEY, file=scene.path, found=scene.planner.sequences, allowed=allowed)
