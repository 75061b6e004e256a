# SPDX-License-Identifier: Apache-2.0
"""Learned collision with a cloud against float64 in every engine, and weights that do not fit."""

import numpy as np
import pytest
from arms import arm_scene
from evaluating import Evaluating
from scipy.spatial.transform import Rotation
from small_scenes import layout_of

from warpmpc import Controller, SceneError, State, Task
from warpmpc.cost.stack import CostStack
from warpmpc.scene.model.spheres import link_fingerprint
from warpmpc.scene.model.trajectory import BatchSize

LINKS = ("panda_link5", "panda_link7")
CLOUD = {"name": "seen", "low": (-0.9, -0.9, -0.2), "high": (1.1, 0.9, 1.2), "reach": 0.2}
SHAPE = BatchSize(1, 16, 1, 4)
GOAL = {"frame": "arm/panda_link7", "position": (0.5, 0.3, 0.4)}


def written(folder, sizes=(96, 64, 32), **changes):
    """A file of random weights for two links of a Panda, and what is in it."""
    layout, (probes, rows, units), n = layout_of(arm_scene("panda")), sizes, len(LINKS)
    rng = np.random.default_rng(0)
    bodies = [layout.body_name.index(f"arm/{name}") for name in LINKS]
    data = {
        "links": np.array(LINKS),
        "trained_for": np.array([link_fingerprint(layout, body) for body in bodies]),
        "voxel": 0.025,
        "reach": 0.15,
        "probes": rng.normal(0.0, 0.08, (n, probes, 3)).astype(np.float32),
        "middle": rng.normal(0.0, 0.02, (n, 3)).astype(np.float32),
        "near": np.array([0.2, 0.22], dtype=np.float32),
    }
    ends = (probes, rows, units, 1)
    for i in range(3):
        size = (30.0 if i == 0 else 3.0) / np.sqrt(ends[i])
        data[f"w{i + 1}"] = rng.normal(0.0, size, (n, *ends[i : i + 2])).astype(np.float16)
        data[f"b{i + 1}"] = rng.normal(0.0, 0.3, (n, ends[i + 1])).astype(np.float16)
    seen = rng.uniform(0.0, 0.15, (200, probes))
    data["b3"] = np.array([[-np.median(network(data, seen, link))] for link in range(n)]) + data["b3"]
    data |= changes
    np.savez(folder / "checker.npz", **data)
    return folder / "checker.npz", data


def network(data: dict, x: np.ndarray, link: int) -> np.ndarray:
    """Outputs ``[n]`` for what is seen ``[n, N]`` in float64."""
    for i in (1, 2):
        x = np.clip(x @ data[f"w{i}"][link].astype(np.float64) + data[f"b{i}"][link], 0.0, 6.0)
    return (x @ data["w3"][link].astype(np.float64) + data["b3"][link].astype(np.float64))[:, 0]


def term(path, **keys) -> dict:
    return {"term": "learned_cloud_collision", "weights": str(path), **keys}


def points() -> np.ndarray:
    """Points on a sheet and a ball in reach of the arm."""
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(3000, 3))
    ball = [0.4, 0.2, 0.5] + 0.15 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    sheet = np.column_stack([rng.uniform(0.1, 0.8, 6000), rng.uniform(-0.6, 0.0, 6000), np.full(6000, 0.3)])
    return np.concatenate([ball, sheet]).astype(np.float32)


def logits(data: dict, volume: np.ndarray, body_q: np.ndarray, link: int) -> np.ndarray:
    """Log-odds of a link at poses ``[n, 7]`` in float64, -inf where its network is not asked."""
    turn, at = Rotation.from_quat(body_q[:, 3:]).as_matrix(), body_q[:, :3].astype(np.float64)
    top = np.array(volume.shape[::-1]) - 1e-3

    def look(local: np.ndarray) -> np.ndarray:
        world = at[:, None] + np.einsum("nij,pj->npi", turn, local.astype(np.float64))
        x, y, z = np.moveaxis(np.clip((world - CLOUD["low"]) / 0.025, 0.0, top).astype(int), -1, 0)
        return volume[z, y, x].astype(np.float64)

    out = network(data, np.minimum(look(data["probes"][link]), float(data["reach"])), link)
    return np.where(look(data["middle"][link][None])[:, 0] < data["near"][link], out, -np.inf)


def reference(data, volume, body_q, layout, probability) -> np.ndarray:
    """What poses ``[..., nb, 7]`` cost."""
    flat = body_q.reshape(-1, *body_q.shape[-2:])
    bodies = [layout.body_name.index(f"arm/{name}") for name in LINKS]
    found = np.array([logits(data, volume, flat[:, body], i) for i, body in enumerate(bodies)])
    return (found > np.log(probability / (1.0 - probability))).any(axis=0).reshape(body_q.shape[:-2])


@pytest.mark.parametrize("sizes", [(96, 64, 32), (20, 12, 5)])
@pytest.mark.parametrize("probability", [0.5, 0.2])
def test_the_term_is_what_the_networks_say(probability, sizes, tmp_path, device):
    path, data = written(tmp_path, sizes)
    j = Evaluating(arm_scene("panda", cloud=[CLOUD], cost=[term(path, probability=probability)]), SHAPE, device=device)
    j.task["seen"] = points()
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (5, SHAPE.worlds, j.layout.nq)).astype(np.float32)
    j.trajectory.joint_q.assign(q)
    j.stack.kinematics(j.trajectory.joint_q, j.trajectory.joint_qd, j.trajectory.body_q, j.trajectory.body_qd)
    j.observe()
    found = j.cost()[0]
    volume = next(iter(j.stack.resources)).volumes["seen"].distance[0]
    wanted = reference(data, volume, j.trajectory.body_q.numpy()[1:], j.layout, probability)
    assert (found != wanted).mean() < 0.03  # a probe on the border of two voxels
    assert 0.05 < wanted.mean() < 0.95


@pytest.mark.parametrize("sizes", [(96, 64, 32), (20, 12, 5)])
def test_baked_networks_say_the_same(sizes, tmp_path, device):
    path, data = written(tmp_path, sizes)
    cost = [{"term": "distance", "between": ["goal", "arm/panda_link7"]}, term(path, weight=3.0)]
    planner = {"samples": 37, "horizon": 11, "noise": {"sigma": 0.8}}
    scene = arm_scene("panda", cloud=[CLOUD], cost=cost, planner=planner, goal=GOAL, success={"distance": 0.1})
    mpc = Controller(scene, engine="kinematic", device=device, seed=0)
    mpc.task["seen"] = points()
    hits = 0.0
    for seed in range(4):
        mpc.step(State(np.random.default_rng(seed).uniform(-1.5, 1.5, mpc.layout.nq), np.zeros(mpc.layout.nv)))
        assert not mpc.engine.records
        rolled = mpc.engine.rollouts(range(mpc.shape.worlds)).body_q.numpy()[1:]
        volume = next(iter(mpc.costs.resources)).volumes["seen"].distance[0]
        stage = reference(data, volume, rolled, mpc.layout, 0.5)
        wanted = (3.0 * stage * mpc.plan_step.grid.discount[:, None]).sum(axis=0)
        hits += stage.mean()
        assert np.isclose(mpc.engine.total.numpy()[1], wanted, atol=1e-4).mean() > 0.8  # all but borders of voxels
    assert 0.2 < hits < 3.8


@pytest.mark.parametrize(
    ("change", "cloud", "said"),
    [
        ({"trained_for": np.array(["0", "1"])}, CLOUD, "other shapes of these links"),
        ({"voxel": 0.05}, CLOUD, "voxels of 0.05 m, not 0.025 m"),
        ({}, {**CLOUD, "reach": 0.1}, "shorter than that of the weights"),
        ({"w2": np.zeros((2, 64, 31))}, CLOUD, "its weights have the shapes"),
        ({"b1": np.full((2, 64), np.nan)}, CLOUD, "not finite"),
        ({"links": np.array(["panda_link5", "foot"])}, CLOUD, "no such link"),
    ],
)
def test_weights_that_do_not_fit_are_refused(change, cloud, said, tmp_path):
    path, _ = written(tmp_path, **change)
    scene = arm_scene("panda", cloud=[cloud], cost=[term(path)])
    with pytest.raises(SceneError, match=said):
        CostStack(scene, layout_of(scene), Task(scene))
