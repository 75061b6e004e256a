# SPDX-License-Identifier: Apache-2.0
"""Sources of noise for the knots of all samples: standard normals, and what a shaping matrix makes of them.

Shaping matrices B ``[P, P]``: noise ε = σ ⊙ (B z) that is correlated over the knots of a plan.

With ``normalize`` the rows have unit length, so that every knot's noise has standard deviation σ whatever the shape.
Matrices are float32 arrays, ready to be copied to the device.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy.interpolate import make_interp_spline

from ..kernels.planner.proposals import shape_noise_kernel
from ..kernels.planner.sampling import (
    advance_counter_kernel,
    random_normal_kernel,
    random_shift_kernel,
    scale_samples_kernel,
    started_normal_kernel,
    table_normal_kernel,
)
from ..physics.runtime.launch import Launcher, step_lanes
from ..scene.schema import NoiseShape
from ..scene.schema import NoiseSource as NoiseKind

if TYPE_CHECKING:
    from ..scene.schema import Noise


def low_discrepancy_table(kind: NoiseKind, *, samples: int, columns: int, seed: int) -> np.ndarray:
    """Scrambled Halton or Sobol points in [0, 1), ``[samples, columns]``, one independent table per seed."""
    rng = np.random.default_rng(seed)
    if kind is NoiseKind.HALTON:
        points = _halton(samples, columns, rng.spawn(1)[0])
    elif kind is NoiseKind.SOBOL:
        from scipy.stats import qmc  # slow to import

        # a whole net of 2^m points, of which the first are taken
        points = qmc.Sobol(columns, scramble=True, rng=rng).random_base2(max(samples - 1, 0).bit_length())[:samples]
    else:
        raise ValueError(f"{kind} has no table")
    return points.astype(np.float32)


def _halton(samples: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    """Halton points, ``[samples, columns]``, whose digits are permuted (Owen 2017).

    Number by number those of ``scipy.stats.qmc``, whose import takes half a second.
    """
    points = np.zeros((samples, columns))
    for column, base in enumerate(_primes(columns)):
        permutations = np.tile(np.arange(base), (math.ceil(54 / math.log2(base)) - 1, 1))
        for permutation in permutations:
            rng.shuffle(permutation)
        rest, place = np.arange(samples), 1.0 / base
        for permutation in permutations:
            points[:, column] += permutation[rest % base] * place
            place /= base
            rest //= base
    return points


def _primes(count: int) -> list[int]:
    """The first prime numbers."""
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % prime for prime in found):
            found.append(number)
        number += 1
    return found


class NoiseSource:
    """Standard normals ``z [E, S, P, nu]`` and shaped noise B z, drawn once or anew at every :meth:`advance`.

    Drawn once, noise is shaped once, too; the same Halton or Sobol table serves every environment and the plan step is
    deterministic; pseudo-random numbers differ between environments. Redrawn, the columns of a table are rotated at
    random per environment and draw (Cranley and Patterson 1976), or read from their own starts (Wang and Hickernell
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


def shaping_matrix(noise: Noise, knots: int) -> np.ndarray:
    """The shaping matrix B ``[P, P]`` a scene asks for."""
    match noise.shape:
        case NoiseShape.IDENTITY:
            return identity(knots)
        case NoiseShape.BSPLINE:
            return bspline(knots, noise.knots)
        case NoiseShape.COMB:
            return comb(knots, *noise.comb)
        case NoiseShape.COLOURED:
            return coloured(knots, noise.exponent)


def schedule(noise: Noise, knots: int, iterations: int) -> np.ndarray:
    """Factor on σ in every iteration at every knot ``[n, P]``.

    With ``anneal = [β1, β2]`` it is exp(-i/(β1 N) - (H-h)/(β2 H)): later iterations and nearer knots are searched more
    finely (DIAL-MPC, Xue et al. 2024); else it is one.
    """
    if noise.anneal is None:
        return np.ones((iterations, knots), dtype=np.float32)
    first, second = noise.anneal
    i, h = np.arange(iterations)[:, None] / iterations, np.arange(1, knots + 1)[None] / knots
    return np.exp(-i / first - (1.0 - h) / second).astype(np.float32)


def identity(knots: int) -> np.ndarray:
    """White noise, every knot on its own."""
    return np.eye(knots, dtype=np.float32)


def bspline(knots: int, noise_knots: int | None = None, *, normalize: bool = True) -> np.ndarray:
    """Smooth noise: the cubic B-spline through few noise knots, evaluated at all knots (Pezzato et al. 2025).

    The noise knots are spread evenly from the first knot to the last. Only the first ``noise_knots`` rows of z are
    used; the other columns of B are zero.

    Args:
        noise_knots: Number of noise knots n, half of P if None (Pezzato et al. 2025; Bhardwaj et al.
            2021 take a quarter); fewer than four lower the degree to n - 1.
        normalize: Scale the rows to unit length.

    Returns:
        Matrix ``[P, P]`` of rank n.
    """
    count = max(knots // 2, 1) if noise_knots is None else noise_knots
    if not 1 <= count <= knots:
        raise ValueError(f"noise_knots must be between 1 and {knots}, got {count}")
    matrix = np.zeros((knots, knots))
    if count == 1:
        matrix[:, 0] = 1.0
    else:
        spline = make_interp_spline(np.arange(count), np.eye(count), k=min(3, count - 1))
        matrix[:, :count] = spline(np.linspace(0.0, count - 1.0, knots))
    return _finish(matrix, normalize)


def comb(knots: int, c1: float = 0.3, c2: float = 0.3, c3: float = 0.4, *, normalize: bool = True) -> np.ndarray:
    """Filtered noise u_h = c1 z_h + c2 u_{h-1} + c3 u_{h-2}, zero before the first knot (Bhardwaj et al. 2021).

    Returns:
        Lower-triangular matrix ``[P, P]``.
    """
    response = np.zeros(knots)
    for h in range(knots):
        response[h] = c1 if h == 0 else c2 * response[h - 1] + (c3 * response[h - 2] if h > 1 else 0.0)
    lag = np.subtract.outer(np.arange(knots), np.arange(knots))
    return _finish(np.where(lag >= 0, response[np.abs(lag)], 0.0), normalize)


def coloured(knots: int, exponent: float, *, normalize: bool = True) -> np.ndarray:
    """Coloured noise of power spectrum 1/f^α: 0 is white, 1 pink, 2 brown (iCEM, Pinneri et al. 2020).

    The covariance is that of a periodic process twice as long as the plan, its spectrum flat below its lowest
    frequency, so the first and the last knot are not tied together. B is the Cholesky factor of that covariance.

    Returns:
        Lower-triangular matrix ``[P, P]``.
    """
    frequency = np.maximum(np.abs(np.fft.fftfreq(2 * knots)), 1.0 / (2 * knots))
    covariance = np.fft.ifft(frequency**-exponent).real
    covariance /= covariance[0] if normalize else 1.0
    lag = np.abs(np.subtract.outer(np.arange(knots), np.arange(knots)))
    return _finish(np.linalg.cholesky(covariance[lag]), normalize)


def _finish(matrix: np.ndarray, normalize: bool) -> np.ndarray:
    """Scale the rows to unit length if asked to, and round to float32."""
    if normalize:
        length = np.linalg.norm(matrix, axis=1, keepdims=True)
        if np.any(length <= 0.0):
            raise ValueError("a knot without noise cannot be normalized")
        matrix = matrix / length
    return matrix.astype(np.float32)
