# SPDX-License-Identifier: Apache-2.0
"""Learned collision of links with a point cloud: a small network for each link looks at distances around it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from ...kernels.cost.view import StepView
from ...kernels.geometry.volume import Volume, voxel_distance
from ...physics.runtime.files import read_npz
from ...scene.errors import SceneError
from ...scene.model.spheres import link_fingerprint
from ..binding import Binding
from ..code import learned as source
from ..keys import TermKeys, term
from ..resources.cloud import PointClouds
from .cloud import cloud_name
from .learned import UNITS, Units, filled
from .spheres import link_body

PROBES = wp.constant(128)
"""Most points that a network looks at."""

Probes = wp.types.vector(length=PROBES, dtype=float)


@dataclass(frozen=True)
class CheckerWeights:
    """Content of a file of ``tools/study.py train_cloud_checker``: one network N → H → U → 1 for each of L links."""

    links: tuple[str, ...]
    trained_for: tuple[str, ...]
    voxel: float
    reach: float
    probes: np.ndarray  # [L, N, 3]
    middle: np.ndarray  # [L, 3]
    near: np.ndarray  # [L]
    weights: tuple[np.ndarray, np.ndarray, np.ndarray]  # [L, N, H], [L, H, U], [L, U, 1]
    biases: tuple[np.ndarray, np.ndarray, np.ndarray]  # [L, H], [L, U], [L, 1]

    @classmethod
    def load(cls, path: Path) -> "CheckerWeights":
        """Read a file.

        Raises:
            ValueError: If it holds something else, or numbers that are not finite.
        """
        plain = ("probes", "middle", "near")
        with read_npz(path) as data:
            layers = [f"{x}{n}" for x in "wb" for n in (1, 2, 3)]
            missing = {"links", "trained_for", "voxel", "reach", *plain, *layers} - {*data.files}
            if missing:
                raise ValueError(f"it lacks {', '.join(sorted(missing))}")
            names = (tuple(map(str, data[key])) for key in ("links", "trained_for"))
            lengths = (float(data[key]) for key in ("voxel", "reach"))
            arrays = (data[key].astype(np.float32) for key in plain)
            weights, biases = (tuple(data[f"{x}{n}"].astype(np.float32) for n in (1, 2, 3)) for x in "wb")
            found = cls(*names, *lengths, *arrays, weights, biases)
        links, probes, rows, units = len(found.links), found.probes.shape[1], *(b.shape[-1] for b in biases[:2])
        sizes = (probes, rows), (rows, units), (units, 1), (rows,), (units,), (1,)
        wanted, shapes = [(links, *size) for size in sizes], [a.shape for a in (*weights, *biases)]
        if shapes != wanted or found.probes.shape != (links, probes, 3) or len(found.trained_for) != links:
            raise ValueError(f"its weights have the shapes {shapes}")
        if probes > int(PROBES) or units > int(UNITS):
            raise ValueError(f"more than {PROBES} points, or {UNITS} units in the second row")
        if not all(np.isfinite(a).all() for a in (*weights, *biases, found.probes, found.middle, found.near)):
            raise ValueError("numbers that are not finite")
        return found

    def arrays(self, link: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Parameters ``first``, ``second`` and ``last`` of one link."""
        return filled(*(tuple(a[link] for a in layer) for layer in (self.weights, self.biases)))


class LearnedCloudCollision(TermKeys):
    """Contact of a robot's links with a point cloud, as networks guess it: 1 if one of them says so, else 0."""

    of: str | None = None
    """Robot; may be left out where it is the only one."""
    cloud: str | None = None
    """Cloud of the scene; may be left out where there is but one."""
    weights: str
    """File of ``tools/study.py train_cloud_checker`` (.npz), beside the scene or in its assets."""
    probability: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = 0.5
    """Probability of contact from which on a pose costs 1: less keeps further away."""

    derived = {
        "volume": Volume,
        "logit": float,  # log-odds of the probability
        "reach": float,  # distances beyond it look alike [m]
        "body": wp.array[int],  # [L]
        "probe": wp.array2d[wp.vec3],  # [L, N] in the bodies' frames [m]
        "middle": wp.array[wp.vec3],  # [L]
        "near": wp.array[float],  # [L] distance of the middle from the cloud below which the network is asked [m]
        "first": wp.array2d[float],  # [L · H, N + 1] weights, and the bias
        "second": wp.array2d[float],  # [L · (H + 1), U], the last row of each link the biases
        "last": wp.array2d[float],  # [L, U + 1], the last one the bias
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Read the networks, and find their links and the cloud's volume."""
        robot, weights = b.only_robot(self.of), b.weights(self.weights, CheckerWeights.load)
        bodies = [link_body(name, robot.bodies, b, f"{b.key}.weights") for name in weights.links]
        again = "train new ones with tools/study.py train_cloud_checker"
        other = [
            name
            for name, body, known in zip(weights.links, bodies, weights.trained_for, strict=True)
            if link_fingerprint(b.layout, body) != known
        ]
        if other:
            raise b.error(f"were trained for other shapes of these links: {again}", "weights", found=other)
        seen = b.resources.get(PointClouds).request(p, cloud_name(b, self.cloud))
        if abs(seen.voxel - weights.voxel) > 1e-6:
            message = f"are for a cloud of voxels of {weights.voxel:g} m, not {seen.voxel:g} m: {again}"
            raise b.error(message, "weights", found=self.weights)
        if seen.reach < weights.reach:
            message = f"is shorter than that of the weights, {weights.reach:g} m"
            raise SceneError(message, key=f"cloud.{seen.name}.reach", file=b.file, found=seen.reach)
        p.logit = float(np.log(self.probability / (1.0 - self.probability)))
        p.reach = weights.reach
        layers = zip(*(weights.arrays(i) for i in range(len(bodies))), strict=True)
        first, second, last = (np.stack(layer) for layer in layers)
        p.body, p.near = b.array(bodies, int), b.array(weights.near, float)
        p.middle = b.array(weights.middle, wp.vec3)
        p.probe = wp.array(weights.probes, dtype=wp.vec3, device=b.device)
        p.first, p.second = (b.array(a.reshape(-1, a.shape[-1]), float) for a in (first, second))
        p.last = b.array(last, float)


@wp.func
def link_logit(s: StepView, p: LearnedCloudCollision.Params, link: int, pose: wp.transform) -> float:
    """Log-odds that a link touches what the cloud shows, as its network says."""
    probes = p.probe.shape[1]
    inputs = Probes()
    for i in range(probes):
        at = wp.transform_point(pose, p.probe[link, i])
        inputs[i] = wp.min(voxel_distance(p.volume, s.e, at), p.reach)
    links = p.body.shape[0]
    rows = p.first.shape[0] // links
    units = p.second.shape[1]
    sums = Units()
    for u in range(units):
        sums[u] = p.second[link * (rows + 1) + rows, u]
    for h in range(rows):
        x = p.first[link * rows + h, probes]
        for i in range(probes):
            x += p.first[link * rows + h, i] * inputs[i]
        x = wp.clamp(x, 0.0, 6.0)
        for u in range(units):
            sums[u] += x * p.second[link * (rows + 1) + h, u]
    out = p.last[link, units]
    for u in range(units):
        out += p.last[link, u] * wp.clamp(sums[u], 0.0, 6.0)
    return out


@term("learned_cloud_collision", LearnedCloudCollision, source=source.learned_cloud_collision)
def learned_cloud_collision(s: StepView, p: LearnedCloudCollision.Params) -> float:
    """Collision of links with a point cloud by a network, 1 or 0; it is not evaluated far from the cloud.

    The binary environment collision of Bhardwaj et al. 2021, Eq. 11, with a learned checker as theirs.
    """
    most = p.logit - 1.0
    for link in range(p.body.shape[0]):
        pose = s.body_q[s.t, s.w, p.body[link]]
        if voxel_distance(p.volume, s.e, wp.transform_point(pose, p.middle[link])) < p.near[link]:
            most = wp.max(most, link_logit(s, p, link, pose))
    return wp.where(most > p.logit, 1.0, 0.0)
