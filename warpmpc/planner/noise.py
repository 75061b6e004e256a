# SPDX-License-Identifier: Apache-2.0
"""Sources of noise for the knots of all samples: standard normals, and what a shaping matrix makes of them."""

import numpy as np
import warp as wp

from ..kernels.planning.proposals import shape_noise_kernel
from ..kernels.planning.sampling import (
    advance_counter_kernel,
    random_normal_kernel,
    random_shift_kernel,
    scale_samples_kernel,
    started_normal_kernel,
    table_normal_kernel,
)
from ..launch import Launcher, step_lanes
from ..scene.schema import NoiseSource as NoiseKind


def low_discrepancy_table(kind: NoiseKind, *, samples: int, columns: int, seed: int) -> np.ndarray:
    """Scrambled Halton or Sobol points in [0, 1), ``[samples, columns]``, one independent table per seed."""
    from scipy.stats import qmc  # slow to import

    rng = np.random.default_rng(seed)
    if kind is NoiseKind.HALTON:
        points = qmc.Halton(columns, scramble=True, rng=rng).random(samples)
    elif kind is NoiseKind.SOBOL:
        # a whole net of 2^m points, of which the first are taken
        points = qmc.Sobol(columns, scramble=True, rng=rng).random_base2(max(samples - 1, 0).bit_length())[:samples]
    else:
        raise ValueError(f"{kind} has no table")
    return points.astype(np.float32)


class NoiseSource:
    """Standard normals ``z [E, S, P, nu]`` and shaped noise B z, drawn once or anew at every :meth:`advance`.

    Drawn once, noise is shaped once, too; the same Halton or Sobol table serves every environment and the plan step is
    deterministic; pseudo-random numbers differ between environments. Redrawn, the columns of a table are rotated at
    random per environment and draw (Cranley and Patterson 1976), or read from starts of their own (Wang and Hickernell
    2000), which needs no new normals; both keep its low discrepancy. Counters on the device make a replayed CUDA graph
    draw anew.

    Args:
        source: Halton or Sobol points through the inverse normal distribution, or pseudo-random normals.
        redraw: Draw anew at every launch, else keep the first draw.
        starts: Redraw a table by other starts instead of rotations.
        seed: Seed of table, rotations and pseudo-random numbers.
        spread: Factors (low, high) between which the samples' scale runs geometrically.
        shaping: Shaping matrix B ``[P, P]``, None for the identity.
        constant: Share of the samples whose noise is the same at every knot.
    """

    z: wp.array4d[float]
    """Standard normals of the last draw, scaled by ``spread``, ``[E, S, P, nu]``; the array stays the same one. Knots
    that the shaping matrix does not read are not drawn."""
    noise: wp.array4d[float]
    """Shaped noise B z, ``[E, S, P, nu]``: ``z`` itself where nothing is to be shaped."""

    def __init__(
        self,
        *,
        source: NoiseKind,
        redraw: bool = False,
        starts: bool = False,
        seed: int = 0,
        envs: int = 1,
        samples: int,
        knots: int,
        nu: int,
        spread: tuple[float, float] = (1.0, 1.0),
        shaping: np.ndarray | None = None,
        constant: float = 0.0,
        device: wp.DeviceLike = None,
    ):
        self.source = NoiseKind(source)
        self.redraw = redraw
        self.seed = seed
        self.spread = spread
        self.device = wp.get_device(device)
        self._launch = Launcher(self.device)
        self.z = wp.zeros((envs, samples, knots, nu), dtype=float, device=self.device)
        self._white, self._constant = shaping is None, constant
        plain = self._white and constant == 0.0
        self.noise = self.z if plain else wp.empty_like(self.z)
        matrix = np.zeros((knots, 1)) if shaping is None else shaping
        used = int(np.flatnonzero(matrix.any(axis=0)).max(initial=0)) + 1  # columns of zeros come after them
        self._shaping = wp.array(np.ascontiguousarray(matrix[:, :used]), dtype=float, device=self.device)
        self._drawn_knots = knots if shaping is None else used
        self._counter = wp.zeros(envs, dtype=int, device=self.device)
        self._table = None
        if self.source is not NoiseKind.RANDOM:
            columns = knots * nu
            table = low_discrepancy_table(self.source, samples=samples, columns=columns, seed=seed)
            self._table = wp.array(table, dtype=float, device=self.device)
            self._shift = wp.zeros((envs, columns), dtype=float, device=self.device)
        self._normal: wp.array | None = None
        self.draw(0, envs * samples)
        if starts and self._table is not None:
            self._keep_normals()

    def _keep_normals(self) -> None:
        """Take the normals of the table itself, before they are scaled; redraws read them from other starts on."""
        _, samples, knots, nu = self.z.shape
        plain = wp.zeros((1, samples, knots, nu), dtype=float, device=self.device)
        inputs = [self._table, self._shift, 0]
        self._launch(table_normal_kernel, (samples, self._drawn_knots, nu), inputs, [plain])
        self._normal = plain.reshape((samples, knots * nu))

    def advance(self, observed: wp.array[int]) -> None:
        """Go on to the next draw if the source redraws; capture-safe.

        Args:
            observed: Whether each environment is planned for ``[E]``; one that waits keeps its place in the sequence.
        """
        if not self.redraw:
            return
        self._launch(advance_counter_kernel, self._counter.shape, [observed], [self._counter])
        if self._table is not None:
            self._launch(random_shift_kernel, self._shift.shape, [self._counter, self.seed], [self._shift])

    def draw(self, first: int, count: int) -> None:
        """Write noise of some samples as the draw that is on has it; capture-safe."""
        dim = (count, self._drawn_knots, self.z.shape[3])
        if self._table is None:
            self._launch(random_normal_kernel, dim, [self._counter, self.seed, first], [self.z])
        elif self._normal is None:
            self._launch(table_normal_kernel, dim, [self._table, self._shift, first], [self.z])
        else:
            envs, samples, knots, nu = self.z.shape
            columns = self._drawn_knots * nu
            lanes = step_lanes(columns, self.device)
            inputs = [self._normal, self._shift, columns, first, lanes]
            self._launch(started_normal_kernel, (count, lanes), inputs, [self.z.reshape((envs, samples, knots * nu))])
        if self.spread != (1.0, 1.0):
            self._launch(scale_samples_kernel, count, [*self.spread, first], [self.z])
        if self.noise is not self.z:
            envs, samples, knots, nu = self.z.shape
            lanes, rows = step_lanes(knots, self.device), (envs, samples, knots * nu)
            inputs = [self.z.reshape(rows), self._shaping, int(self._white), self._constant, nu, first, lanes]
            self._launch(shape_noise_kernel, (count, lanes), inputs, [self.noise.reshape(rows)])

    def reset(self) -> None:
        """Start the draws over, as if just constructed; capture-safe."""
        self._counter.zero_()
        if self._table is not None:
            self._shift.zero_()
        self.draw(0, self.z.shape[0] * self.z.shape[1])
