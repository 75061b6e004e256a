# SPDX-License-Identifier: Apache-2.0
"""Files of weights for ``learned_self_collision``, and a small arm that learns in seconds."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from small_scenes import make_scene
from studies.arms.learned.self_distance import SelfDistance

from warpmpc import Scene

ELBOW = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="stand"><geom type="capsule" size=".06" fromto="0 0 0 0 0 .5" mass="1"/>
    <body name="upper" pos="0 0 .6"><joint name="shoulder" axis="0 1 0" range="-2.5 2.5"/>
      <geom type="capsule" size=".04" fromto="0 0 .1 0 0 .4" mass="1"/>
      <body name="lower" pos="0 0 .5"><joint name="elbow" axis="0 1 0" range="-2.8 2.8"/>
        <geom type="capsule" size=".04" fromto="0 0 .1 0 0 .5" mass="1"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""
"""Two joints: the lower arm may hit the stand."""


def elbow_scene(folder: Path, *costs: dict, **sections) -> Scene:
    """A scene of the two-joint arm."""
    path = folder / "elbow.xml"
    path.write_text(ELBOW)
    drive = {"mode": "acceleration", "damping": 20.0, "limit": 3.0}
    data = {
        "robot": [{"name": "arm", "asset": str(path), "gravity_compensation": True, "drive": drive}],
        "ground": None,
        "goal": {"frame": "arm/lower", "position": (0.5, 0.0, 0.5)},
        "cost": costs or [{"term": "distance", "between": ["arm/lower", "goal"]}],
    }
    return make_scene(**{**data, **sections})


def random_network(distance: SelfDistance, rows: int, units: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Weights as a file holds them, such that both bounds of ReLU6 are met and half of the outputs are positive."""
    rng = np.random.default_rng(seed)
    sizes = [2 * len(distance.dofs), rows, units, 1]
    out: dict[str, np.ndarray] = {"joints": np.array(distance.names), "trained_for": np.array(distance.fingerprint)}
    for n, (a, b) in enumerate(itertools.pairwise(sizes), start=1):
        out[f"w{n}"] = rng.normal(0.0, 3.0 / np.sqrt(a), (a, b)).astype(np.float16)
        out[f"b{n}"] = rng.normal(0.0, 1.0, b).astype(np.float16)
    out["b3"] = np.float16(out["b3"] - np.median(network_output(out, distance.draw(100, rng))))
    return out


def network_output(weights: dict[str, np.ndarray], q: np.ndarray) -> np.ndarray:
    """Outputs for configurations ``[..., joints]`` in float64."""
    q = q.astype(np.float64)
    x = np.concatenate([np.sin(q), np.cos(q)], axis=-1)
    for n in (1, 2):
        x = np.clip(x @ weights[f"w{n}"].astype(np.float64) + weights[f"b{n}"].astype(np.float64), 0.0, 6.0)
    return (x @ weights["w3"].astype(np.float64))[..., 0] + float(weights["b3"][0])
