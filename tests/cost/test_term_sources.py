# SPDX-License-Identifier: Apache-2.0
"""Source of cost terms says what their Warp functions say, many worlds at once and one alone."""

import functools

import numpy as np
import pytest
import warp as wp
from push_scenes import block
from rollouts import OBSTACLES, Rollouts
from scipy.spatial.transform import Rotation
from small_scenes import BOX
from term_sources import SourceEvaluator

from warpmpc.physics.runtime.bake import native_lanes
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(2, 21, 2, 5)  # a number of worlds that fills no register; 420 states
BLOCKS = [block(position=(0.0, 0.7)), block("post", size=(0.3, 0.3, 0.4), position=(-0.7, 0.4), yaw=0.7)]
OBJECTS = [
    BOX,
    {**BOX, "name": "bar", "size": (0.5, 0.3, 0.2), "position": (0.6, -1.0, 0.1)},
    {**BOX, "name": "can", "shape": "cylinder", "size": (0.2, 0.2), "position": (-0.6, -1.0, 0.1)},
]
ANYWHERE = [
    {"term": "distance", "between": ["base/tip", "box"]},
    {"term": "distance", "between": ["box", "base/tip"], "lead": 0.7, "near": 0.5},
    {"term": "yaw", "of": "box"},
    {"term": "yaw", "of": "box", "near": 0.7, "smooth": 0.2},
    {"term": "contact_force", "between": ["box", "obstacles"]},
    {"term": "push_alignment", "pusher": "base/tip", "object": "box"},
    {"term": "push_alignment", "pusher": "base/tip", "object": "box", "near": 0.4, "slack": 0.5},
    {"term": "obstacle_clearance", "of": "base/tip", "radius": 0.1, "least": 0.03},
    {"term": "obstacle_clearance", "of": "box", "to": "centre"},
    {"term": "outline_clearance", "of": "base/tip", "within": 0.8},
    {"term": "outline_clearance", "of": "box", "within": 0.5},
    {"term": "outline_distance", "of": "base/tip", "object": "box", "inside": 3.0},
    {"term": "approach", "hand": "base/tip", "object": "box", "width": 1.2, "rise": 0.8},
    {"term": "finger_alignment", "hand": "base/tip", "object": "box"},
    {"term": "gripper", "hand": "base/tip", "object": "box", "near": 1.8, "fingers": ["base/x", "base/yaw"]},
]
"""Terms of bodies that are anywhere and turned anyhow."""
PUSH = {"pusher": "base/tip", "object": "box"}
FOOTPRINT = {**PUSH, "term": "push_path", "width": 0.2, "length": 0.3}
LEVEL = [
    {"term": "distance", "between": ["base/tip", "box"], "metric": "geodesic"},
    {"term": "distance", "between": ["box", "goal"], "metric": "geodesic", "near": 0.4, "lead": 0.2},
    {"term": "yaw", "of": "box", "near": 0.3},
    {"term": "push_alignment", **PUSH, "metric": "geodesic", "near": 0.2},
    {**FOOTPRINT},
    {**FOOTPRINT, "tolerance": 0.04, "steer": 0.6, "turn": 0.7, "lead": 0.05},
    {**FOOTPRINT, "tolerance": 0.04, "lead": 0.3, "through": True},
    {**FOOTPRINT, "object": "bar", "tolerance": 0.03, "steer": 2.0, "behind": 0.3},
    {**FOOTPRINT, "object": "can", "tolerance": 0.05, "steer": 0.5},
    {"term": "obstacle_clearance", "of": "base/tip", "radius": 0.1, "least": 0.03},
    {"term": "outline_clearance", "of": "box", "within": 0.2},
    {"term": "outline_clearance", "of": "base/tip", "within": 0.3},
    {"term": "outline_distance", "of": "base/tip", "object": "box", "inside": 0.5},
    {"term": "outline_distance", "of": "base/tip", "object": "can"},
    {"term": "approach", "hand": "base/tip", "object": "box", "width": 0.05, "rise": 0.1},
]
"""Terms of a push in the plane."""


COM = {"centre_of_mass": "base"}
SPACE = [
    {"term": "position_residual", "of": ["base/tip", "base/centre"], "relative_to": ["box", "goal", "wall"]},
    {"term": "position_residual", "of": COM, "lead": 0.2, "relative_to": "box", "axes": "xy", "target": ["a", 0.3]},
    {"term": "velocity_residual", "of": [COM, "base/tip"], "relative_to": "box", "target": ["a", "b", 0.1]},
    {"term": "velocity_residual", "of": COM, "heading": "base/tip", "axes": "xy", "target": ["a", "b"]},
    {"term": "position_residual", "of": "base/tip", "relative_to": "box", "heading": "box", "target": [0.2, "a", 0.1]},
    {"term": "velocity_residual", "of": "box", "heading": "goal", "axes": "y", "norm": {"kind": "l2", "p": 0.1}},
    {"term": "angular_velocity_residual", "of": ["base/tip", "base/centre"], "relative_to": "box", "axes": "yz"},
    {"term": "momentum_residual", "of": "base", "target": ["a", 0.0, 0.2]},
    {"term": "angular_momentum_residual", "of": "base", "axes": "xz", "target": "b"},
    {"term": "angular_momentum_residual", "of": "base", "norm": {"kind": "l2", "p": 0.1}},
    {"term": "rotation_residual", "of": "base/tip"},
    {"term": "rotation_residual", "of": "box", "to": "base/tip", "axes": "xz", "norm": {"kind": "l2", "p": 0.1}},
    {"term": "posture_residual", "target": "a", "norm": {"kind": "smooth_abs", "p": 0.2}},
    {"term": "joint_velocity_residual", "joints": ["x", "yaw"], "target": [0.2, "b"]},
    {"term": "control_residual", "norm": {"kind": "cosh", "p": 0.9}},
    {"term": "control_residual", "controls": ["base/yaw"], "target": "b"},
    {"term": "contact_residual", "between": ["box", "obstacles"], "least": 1.5, "target": 1.0},
    {"term": "contact_force_residual", "between": ["base", "box"], "axes": "yz", "target": [0.5, "a"]},
    {"term": "gait_residual", "feet": ["base/tip", "box"], "phases": [0.1, 0.6], "cadence": 7.0, "height": [0.9, "a"]},
    *(
        {"term": "position_residual", "of": "base/tip", "axes": "yz", "target": ["b", 0.0], "norm": norm}
        for norm in (
            {"kind": "l22", "p": 0.3, "q": 3.0},
            {"kind": "l22", "p": 0.7, "q": 1.4},
            {"kind": "l2", "p": 0.1},
            {"kind": "cosh", "p": 0.9},
            {"kind": "power", "p": 2.0},
            {"kind": "power", "p": 3.5},
            {"kind": "power", "p": 1.0},
            {"kind": "smooth_abs", "p": 0.1},
            {"kind": "smooth_abs2", "p": 0.2, "q": 4.0},
            {"kind": "smooth_abs2", "p": 0.4, "q": 1.5},
            {"kind": "rectify", "p": 0.1},
        )
    ),
]
"""Residuals, and the norms."""


def kind(cost: dict) -> str:
    return "-".join(
        str(cost[key]) for key in ("term", "object", "metric", "near", "steer", "to", "inside", "norm") if key in cost
    )


def level(r: Rollouts) -> None:
    """Put the bodies on the floor: anywhere, and where formulas change over."""
    rng, goal = np.random.default_rng(5), r.goal.copy()
    goal[:, :2] = [0.0, 0.1], [-0.4, -0.3]
    goal[:, 3:] = Rotation.from_euler("zx", [[0.0, 0.0], [2.2, 0.02]]).as_quat()
    r.goal = goal
    r.set_goal(goal)
    box, bar, can, base = (r.layout.frame_body[r.layout.frame(name)] for name in ("box", "bar", "can", "base/tip"))
    body_q = r.trajectory.body_q.numpy()
    shape = body_q.shape[:2]
    own = np.repeat(goal, SHAPE.rollouts, axis=0)
    for body, spread in ((box, 0.7), (base, 1.0)):
        body_q[:, :, body, :3] = rng.normal(size=(*shape, 3)) * [spread, spread, 0.05]
        turns = Rotation.from_euler("zxy", rng.normal(size=(shape[0] * shape[1], 3)) * [2.0, 0.01, 0.01])
        body_q[:, :, body, 3:] = turns.as_quat().reshape(*shape, 4)
    # at the goal, turned by whole and half quarters and by little
    body_q[1, :, box] = own
    angles = np.arange(SHAPE.worlds) * np.pi / 4
    body_q[1, :, box, 3:] = (
        Rotation.from_quat(own[:, 3:]) * Rotation.from_euler("z", angles[:, None] + 1e-3)
    ).as_quat()
    body_q[2, ::2, box, :2] = own[::2, :2] + 0.03 * rng.normal(size=(SHAPE.worlds // 2, 2))
    # the pusher around the box, beside the circle where the term's walk begins (it jumps there), and on top of it
    circle = (
        np.hypot(0.15, 0.25) + rng.choice([0.1, 0.4], SHAPE.worlds) + rng.choice([-1e-5, 1e-5, 1e-4, 0.1], SHAPE.worlds)
    )
    circle[:4] = 0.02
    around = np.stack([np.cos(angles + 0.3), np.sin(angles + 0.3)], axis=1)
    body_q[3, :, base, :2] = body_q[3, :, box, :2] + circle[:, None] * around
    body_q[3, :, base, :2] -= Rotation.from_quat(body_q[3, :, base, 3:]).apply([0.2, 0.0, 0.0])[:, :2]
    # on the border of the grid, on its cells, and far beyond
    paths = r.stack.terms[0][1].paths
    rows, columns = paths.length.shape[1:]
    low, high = np.array(paths.origin), np.array(paths.origin) + paths.cell * np.array([columns - 1, rows - 1])
    places = [low, high, [low[0], high[1]], low - 0.3, high + [0.3, -0.5], high + 100.0, low - [1e4, 0.0]]
    places += [low + paths.cell * np.array([3, 7]), [0.0, 0.7], [0.0, 0.3], [-0.7, 0.4]]
    for i, place in enumerate(places):
        body_q[4, 2 * i, box, :2] = place
        body_q[4, 2 * i + 1, base, :2] = place
        body_q[5, i, base, :2] = body_q[5, i, box, :2] = place
    body_q[:, :, [bar, can]] = body_q[:, :, [box]]
    r.trajectory.body_q.assign(body_q)
    r.observe()


@functools.cache
def evaluated(where: str) -> Rollouts:
    """Rollouts, and the terms that judge them."""
    costs, obstacles = {"anywhere": (ANYWHERE, OBSTACLES), "level": (LEVEL, BLOCKS), "space": (SPACE, OBSTACLES)}[where]
    objects, scalar = OBJECTS if where == "level" else OBJECTS[:1], {"a": 0.4, "b": -0.7}
    r = Rollouts(*costs, obstacles=obstacles, objects=objects, shape=SHAPE, seed=len(costs), scalar=scalar)
    r.state.start.assign([1.03, 17.31])  # gaits follow the clock
    if where == "level":
        level(r)
    return r


@functools.cache
def sourced(where: str, lanes: int) -> np.ndarray:
    """Costs by the source ``[term, T, W]``."""
    return SourceEvaluator(evaluated(where), lanes).cost()


@functools.cache
def plain(where: str) -> np.ndarray:
    """What the Warp functions say ``[term, T, W]``."""
    r = evaluated(where)
    return np.stack([r.cost(i) for i in range(len(r.stack.terms))])


CASES = [
    (where, i, kind(cost))
    for where, costs in (("anywhere", ANYWHERE), ("level", LEVEL), ("space", SPACE))
    for i, cost in enumerate(costs)
]


@pytest.mark.parametrize("lanes", sorted({1, native_lanes()}))
@pytest.mark.parametrize(("where", "term"), [case[:2] for case in CASES], ids=[f"{c[0]}-{c[2]}" for c in CASES])
def test_terms_of_the_source_cost_what_their_functions_say(where, term, lanes):
    expected = plain(where)[term]
    assert np.ptp(expected) > 0.1
    # far away places are known less exactly
    far = np.abs(evaluated(where).trajectory.body_q.numpy()[1:]).max(axis=(2, 3))
    found = sourced(where, lanes)[term]
    wrong = ~(np.abs(found - expected) <= 1e-5 * np.abs(expected) + 2e-6 * np.maximum(far, 1.0))
    assert not wrong.any(), (np.argwhere(wrong), found[wrong], expected[wrong])


@pytest.mark.skipif(
    90 not in wp.get_cuda_supported_archs(), reason="needs Warp built with NVRTC: pip install warp-lang"
)
@pytest.mark.parametrize(("where", "use_ptx"), [("anywhere", False), ("level", True), ("space", True)])
def test_the_same_source_compiles_for_a_gpu(where, use_ptx, tmp_path):
    module = SourceEvaluator(evaluated(where)).kernel.module
    assert wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=use_ptx)


@pytest.mark.parametrize("where", ["anywhere", "level", "space"])
def test_a_world_that_diverged_changes_no_other(where):
    evaluating = evaluated(where)
    evaluator = SourceEvaluator(evaluating)
    clean = evaluator.cost()
    array = evaluating.trajectory.body_q
    states = array.numpy().copy()
    for w, value in ((0, np.nan), (5, np.inf), (30, -np.inf), (50, 1e30)):
        poisoned = states.copy()
        poisoned[1:, w] = value
        array.assign(poisoned)
        evaluator.read()
        others = np.delete(np.arange(SHAPE.worlds), w)
        np.testing.assert_array_equal(evaluator.cost()[..., others], clean[..., others])
    array.assign(states)
