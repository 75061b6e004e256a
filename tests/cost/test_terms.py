# SPDX-License-Identifier: Apache-2.0
"""Every built-in cost term against float64 on random rollouts, and terms that users write."""

import numpy as np
import pytest
import warp as wp
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from small_scenes import BOX, DISC, WALL, compiled, make_scene

import warpmpc
from warpmpc import SceneError
from warpmpc.cost.builtin import BUILTIN
from warpmpc.cost.push_path import ANGLES
from warpmpc.cost.stack import CostStack
from warpmpc.engine.trajectory import Shape, Trajectory
from warpmpc.scene.draw import signed_distance

TURN = (0.2, -0.4, 0.1, 0.9)
OBSTACLES = [
    {**WALL, "rotation": TURN},
    {"name": "ball", "shape": "sphere", "size": (0.3,), "position": (-1.0, 0.5, 0.1)},
    {"name": "can", "shape": "cylinder", "size": (0.2, 0.6), "position": (0.0, -1.0, 0.3), "rotation": TURN},
    {"name": "pill", "shape": "capsule", "size": (0.1, 0.5), "position": (0.5, 1.0, 0.2), "rotation": (0, 0.6, 0, 0.8)},
    {"name": "slope", "shape": "plane", "position": (0.0, 0.0, -2.0), "rotation": TURN},
]
SHAPE = Shape(2, 3, 2, 5)


class Rollouts:
    """Random rollouts of a small scene, judged by its cost terms."""

    def __init__(self, *costs: dict, seed: int = 0, terms=(), scale: float = 1.0, obstacles=OBSTACLES):
        robot = {**DISC, "drive": {**DISC["drive"], "limit": (1.0, 2.0, 0.5)}}
        self.scene = make_scene(
            robot=[robot], object=[BOX], obstacle=obstacles, cost=costs, goal={"object": "box", "position": (1, 2, 0.5)}
        )
        self.layout = compiled(self.scene).layout
        self.stack = CostStack(self.scene, self.layout, terms=terms)
        self.t, self.w = SHAPE.horizon, SHAPE.worlds
        rng = np.random.default_rng(seed)
        self.trajectory = Trajectory.allocate(SHAPE, self.layout, len(self.stack.pairs), "cpu")
        for array in vars(self.trajectory).values():
            if array.dtype is not int and array.size:
                array.assign(scale * rng.normal(size=array.numpy().shape).astype(np.float32))
        turns = Rotation.random(self.trajectory.body_q.size, rng=rng).as_quat()
        body_q = self.trajectory.body_q.numpy()
        body_q[..., 3:] = turns.reshape(*body_q.shape[:-1], 4)
        self.control = wp.array(rng.normal(size=(self.t, self.w, 3)), dtype=float, device="cpu")
        self.stack.attach(self.trajectory, self.control, SHAPE)
        self.goal = np.concatenate([rng.normal(size=(2, 3)), Rotation.random(2, rng=rng).as_quat()], axis=1)
        self.stack.set_goal(self.goal)
        self.stack.aim(self.goal)
        self.stack.last_control.assign(rng.normal(size=(2, 3)).astype(np.float32))

    def cost(self, term: int = 0) -> np.ndarray:
        """Weighted cost of every step and world, ``[T, W]``."""
        self.stack.launch()
        return self.stack.cost.numpy()[term].astype(np.float64)

    def pose(self, frame: str) -> tuple[np.ndarray, Rotation]:
        """Position ``[T, W, 3]`` and rotation of a frame after every control, in float64."""
        index = self.layout.frame(frame)
        body = self.layout.frame_body[index]
        local = self.layout.frame_pose[index].astype(np.float64)
        if body == -2:
            base = np.broadcast_to(np.repeat(self.goal, SHAPE.rollouts, axis=0), (self.t, self.w, 7))
        elif body == -1:
            base = np.broadcast_to([0, 0, 0, 0, 0, 0, 1.0], (self.t, self.w, 7))
        else:
            base = self.trajectory.body_q.numpy()[1:, :, body].astype(np.float64)
        turn = Rotation.from_quat(base[..., 3:].reshape(-1, 4))
        position = base[..., :3] + turn.apply(local[:3]).reshape(self.t, self.w, 3)
        return position, turn * Rotation.from_quat(local[3:])

    def each(self, values: np.ndarray) -> np.ndarray:
        """Values of flattened steps and worlds as ``[T, W]``."""
        return np.asarray(values).reshape(self.t, self.w)


def heading(r: Rotation) -> np.ndarray:
    x = r.apply([1.0, 0.0, 0.0])
    return np.arctan2(x[:, 1], x[:, 0])


def on_circle(a: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * a)))


def distance(r: Rollouts, planar: bool) -> np.ndarray:
    d = r.pose("base/tip")[0] - r.pose("box")[0]
    return np.linalg.norm(d[..., : 2 if planar else 3], axis=-1)


def yaw(r: Rollouts, near: float) -> np.ndarray:
    (p, a), (q, b) = r.pose("box"), r.pose("goal")
    error = r.each(on_circle(heading(a) - heading(b)))
    return error * (np.exp(-np.linalg.norm((p - q)[..., :2], axis=-1) / near) if near else 1.0)


def alignment(r: Rollouts, near: float) -> np.ndarray:
    pusher, box, goal = (r.pose(f)[0][..., :2] for f in ("base/tip", "box", "goal"))
    u, v = pusher - box, goal - box
    cos = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return (cos + 1.0) * (1.0 - np.exp(-np.linalg.norm(v, axis=-1) / near) if near else 1.0)


def clearance(r: Rollouts, to: str, radius: float, least: float) -> np.ndarray:
    position = r.pose("base/tip")[0].reshape(-1, 3)
    total = np.zeros(len(position))
    for obstacle in r.scene.obstacle:
        for i, p in enumerate(position):
            d = signed_distance(obstacle, tuple(p)) if to == "surface" else np.linalg.norm(p - obstacle.position)
            total[i] += 1.0 / max(d - radius, least)
    return r.each(total)


def coasting(r: Rollouts, lead: float) -> np.ndarray:
    """Where the box would be after coasting for a time."""
    body = int(r.layout.frame_body[r.layout.frame("box")])
    velocity = r.trajectory.body_qd.numpy()[1:, :, body, :3].astype(np.float64)
    return r.pose("box")[0] + lead * velocity.reshape(r.pose("box")[0].shape)


def push_path(r: Rollouts, turn: float, radius: float, tolerance: float, steer: float, lead: float = 0.0) -> np.ndarray:
    """The least over seven ways to a circle about the box, in the goal's frame; within the tolerance it is nearer."""
    (pusher, _), (_, box_turn), (goal, goal_turn) = (r.pose(name) for name in ("base/tip", "box", "goal"))
    box = coasting(r, lead)
    back = np.exp(-1j * heading(goal_turn))
    off, to = (back * ((a - b).reshape(-1, 3) @ [1.0, 1j, 0.0]) for a, b in ((box, goal), (pusher, box)))
    at = np.column_stack([off.real, off.imag])
    apart, error = np.abs(to), np.angle(np.exp(1j * (heading(box_turn) - heading(goal_turn))))
    # a box that is still turned may be farther away
    play = (tolerance * (1.0 + 3.0 * np.minimum(np.abs(error), 1.0) * (steer > 0.0)))[:, None]
    far = np.abs(at) >= 2.5 * play
    at = np.where(far, at, np.sign(at) * np.maximum(np.abs(at) - play, 0.0) * 2.5 / 1.5)

    params, _ = r.stack._push_paths[0]
    table, cell = params.value.numpy().astype(np.float64), params.cell
    tables = [
        RegularGridInterpolator([np.arange(n) for n in (17, *v.shape[1:])], np.concatenate([v, v[:1]])) for v in table
    ]
    envs = np.tile(np.repeat([0, 1], SHAPE.rollouts), r.t)
    origin = params.origin.numpy()[envs]
    reach = cell * (np.array(table.shape[:1:-1]) - 1.0)
    inside = np.clip(at, origin, origin + reach)

    def value(angle: np.ndarray) -> np.ndarray:
        side = np.interp(angle % (2.0 * np.pi), [*ANGLES, 2.0 * np.pi], np.arange(17))
        index = np.column_stack([side, ((inside - origin) / cell)[:, ::-1]])
        return np.where(envs == 0, tables[0](index), tables[1](index)) + np.linalg.norm(at - inside, axis=1)

    # from the middle of the box's own side, or beside it; another quarter turn makes another side the same
    quarter = 0.5 * np.pi * np.round(error / (0.5 * np.pi))
    side = np.angle(to) - (error - quarter) + np.clip((1.0 + steer) * error, -0.3, 0.3)
    least = value(side) + turn * np.maximum(apart - radius, 0.0)
    for part in np.array([-1.0, -2 / 3, -1 / 3, 1 / 3, 2 / 3, 1.0]):
        angle = part * np.arccos(np.minimum(radius / apart, 1.0))
        way = np.linalg.norm(np.stack([apart - radius * np.cos(angle), radius * np.sin(angle)]), axis=0)
        other = value(side + angle) + turn * way
        least = np.where(apart > radius, np.minimum(least, other), least)
    # near the goal the pusher goes to where it turns the box back: beside the middle of one of its broad sides (± x)
    off = np.angle(to) - error + 0.4 * np.sign(error)
    astray = np.abs(off - np.pi * np.round(off / np.pi)) * np.minimum(np.abs(error) / 0.3, 1.0)
    near = np.maximum(1.0 - np.linalg.norm(at, axis=1) / 0.2, 0.0)
    return r.each(least + (steer > 0.0) * 0.4 * turn * near * np.minimum(apart, radius) * astray)


def leading_distance(r: Rollouts, lead: float) -> np.ndarray:
    ahead = coasting(r, lead)
    return np.linalg.norm(ahead - r.pose("base/tip")[0], axis=-1)


def outline_distance(r: Rollouts, inside: float) -> np.ndarray:
    (tip, _), (box, turn) = r.pose("base/tip"), r.pose("box")
    local = np.abs(turn.inv().apply((tip - box).reshape(-1, 3)))[:, :2]
    beyond = local - 0.5 * np.array(r.scene.object[0].size[:2])
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return r.each(np.where(outside > 0.0, outside, -inside * beyond.max(axis=1)))


RING = np.array([(np.cos(a), np.sin(a), 0.0) for a in np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)])
CORNERS = 0.5 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def seen_from_above(obstacle) -> np.ndarray:
    """Corners of an obstacle's outline, counter-clockwise, 32 or more for a round one, ``[n, 2]``."""
    turn, size = Rotation.from_quat(obstacle.rotation), obstacle.size
    if obstacle.shape == "box":
        points = turn.apply(CORNERS * size)
    elif obstacle.shape == "cylinder":
        points = turn.apply(np.concatenate([size[0] * RING + [0, 0, z * size[1]] for z in (-0.5, 0.5)]))
    else:
        half = size[1] / 2 if obstacle.shape == "capsule" else 0.0
        points = np.concatenate([size[0] * RING + turn.apply([0, 0, z]) for z in (-half, half)])
    points = points[:, :2] + obstacle.position[:2]
    return points[ConvexHull(points).vertices]


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """Distance between two convex outlines, negative by their depth: of the origin from their Minkowski difference."""
    points = (b[:, None] - a).reshape(-1, 2)
    hull = ConvexHull(points)
    if (hull.equations[:, 2] < 0.0).all():
        return hull.equations[:, 2].max()
    corners = points[hull.vertices]
    edge = np.roll(corners, -1, axis=0) - corners
    part = np.clip(-(corners * edge).sum(-1) / (edge**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(corners + part[:, None] * edge, axis=1).min()


def outline_clearance(r: Rollouts, of: str, own: np.ndarray, within: float) -> np.ndarray:
    """Nearness of a body with its own corners ``[n, 2]`` to every obstacle but a plane."""
    position, turn = r.pose(of)
    obstacles = [seen_from_above(o) for o in r.scene.obstacle if o.shape != "plane"]
    total = []
    for at, yaw in zip(position.reshape(-1, 3)[:, :2], heading(turn), strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        body = at + own @ [[c, s], [-s, c]]
        total.append(sum(max(0.0, 1.0 - gap(body, obstacle) / within) for obstacle in obstacles))
    return r.each(total)


def joint_limit(r: Rollouts, margin: float) -> np.ndarray:
    q = r.trajectory.joint_q.numpy()[1:, :, :2].astype(np.float64)  # yaw has no limits
    return (np.maximum(np.abs(q) - (100.0 - margin), 0.0) ** 2).sum(-1)


def rate(r: Rollouts) -> np.ndarray:
    u = r.control.numpy().astype(np.float64)
    before = np.concatenate([np.repeat(r.stack.last_control.numpy(), SHAPE.rollouts, axis=0)[None], u[:-1]])
    return (((u - before) / [1.0, 2.0, 0.5]) ** 2).sum(-1)


CASES = {
    "distance": ({"between": ["base/tip", "box"]}, lambda r: distance(r, False)),
    "planar distance": (
        {"term": "distance", "between": ["base/tip", "box"], "planar": True},
        lambda r: distance(r, True),
    ),
    "yaw": ({"of": "box"}, lambda r: yaw(r, 0.0)),
    "near yaw": ({"term": "yaw", "of": "box", "near": 0.7}, lambda r: yaw(r, 0.7)),
    "push_alignment": ({"pusher": "base/tip", "object": "box"}, lambda r: alignment(r, 0.0)),
    "near push_alignment": (
        {"term": "push_alignment", "pusher": "base/tip", "object": "box", "near": 0.4},
        lambda r: alignment(r, 0.4),
    ),
    "push_path": (
        {"pusher": "base/tip", "object": "box", "width": 0.2, "length": 0.3, "behind": 0.6, "turn": 0.7}
        | {"tolerance": 0.3, "steer": 0.3},
        lambda r: push_path(r, 0.7, np.hypot(0.15, 0.25) + 0.7, 0.3, 0.3),
    ),
    "leading push_path": (
        {"term": "push_path", "pusher": "base/tip", "object": "box", "width": 0.2, "length": 0.3, "lead": 0.6},
        lambda r: push_path(r, 1.0, np.hypot(0.15, 0.25) + 0.1, 0.0, 0.0, 0.6),
    ),
    "contact_force": (
        {"between": ["box", "obstacles"]},
        lambda r: np.linalg.norm(r.trajectory.contact_force.numpy().astype(np.float64), axis=-1).sum(-1),
    ),
    "control_effort": (
        {"of": "base"},
        lambda r: ((r.control.numpy() / [1.0, 2.0, 0.5]) ** 2).sum(-1),
    ),
    "control_rate": ({}, rate),
    "joint_limit": ({"margin": 99.5}, lambda r: joint_limit(r, 99.5)),
    "joint_velocity": ({}, lambda r: (r.trajectory.joint_qd.numpy()[1:, :, :3].astype(np.float64) ** 2).sum(-1)),
    "obstacle_clearance": (
        {"of": "base/tip", "radius": 0.1, "least": 0.03},
        lambda r: clearance(r, "surface", 0.1, 0.03),
    ),
    "centre clearance": (
        {"term": "obstacle_clearance", "of": "base/tip", "to": "centre"},
        lambda r: clearance(r, "centre", 0.0, 0.05),
    ),
    "leading distance": (
        {"term": "distance", "between": ["box", "base/tip"], "lead": 0.7},
        lambda r: leading_distance(r, 0.7),
    ),
    # wide: the ends of a lying capsule have corners of their own, some millimetres off
    "outline_clearance": (
        {"of": "base/tip", "within": 8.0},
        lambda r: outline_clearance(r, "base/tip", 0.2 * RING[:, :2] - [0.2, 0.0], 8.0),
    ),
    "outline_distance": (
        {"of": "base/tip", "object": "box", "inside": 3.0},
        lambda r: outline_distance(r, 3.0),
    ),
    "height": ({"of": "base/tip", "target": 0.3}, lambda r: np.abs(r.pose("base/tip")[0][..., 2] - 0.3)),
    "slack height": (
        {"term": "height", "of": "base/tip", "target": 0.3, "slack": 0.2},
        lambda r: np.maximum(np.abs(r.pose("base/tip")[0][..., 2] - 0.3) - 0.2, 0.0),
    ),
    "orientation": (
        {"of": "base/tip", "to": "box"},
        lambda r: r.each((r.pose("base/tip")[1].inv() * r.pose("box")[1]).magnitude()),
    ),
    "tilt": (
        {"term": "orientation", "of": "base/tip", "tilt": True},
        lambda r: r.each(
            np.arccos((r.pose("base/tip")[1].apply([0, 0, 1.0]) * r.pose("goal")[1].apply([0, 0, 1.0])).sum(-1))
        ),
    ),
}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", CASES)
def test_terms_match_float64(name, seed):
    keys, reference = CASES[name]
    rollouts = Rollouts({"term": name, "weight": 2.5, **keys}, seed=seed)
    expected = 2.5 * reference(rollouts)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(rollouts.cost(), expected, rtol=2e-4, atol=2e-4)


def test_every_built_in_term_is_covered():
    assert {keys.get("term", name) for name, (keys, _) in CASES.items()} == set(BUILTIN)


def put(r: Rollouts, frame: str, places: np.ndarray) -> None:
    """Put a frame's body upright at places (x, y, yaw), one for every step and world."""
    body_q = r.trajectory.body_q.numpy()
    turns = Rotation.from_euler("z", places[:, 2:]).as_quat()
    poses = np.column_stack([places[:, :2], np.full(len(places), 0.1), turns])
    body_q[1:, :, int(r.layout.frame_body[r.layout.frame(frame)])] = poses.reshape(r.t, r.w, 7)
    r.trajectory.body_q.assign(body_q)


def solid(name: str, shape: str, size: tuple, at: tuple, yaw: float = 0.0) -> dict:
    rotation = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
    return {"name": name, "shape": shape, "size": size, "position": (*at, 0.2), "rotation": rotation}


SLAB = solid("slab", "box", (0.8, 1.0, 0.4), (0.0, 0.0))
SLANT = solid("slant", "box", (0.8, 0.8, 0.4), (0.0, 0.0), np.pi / 4)
CAN = solid("can", "cylinder", (0.2, 0.4), (0.0, 0.0))


@pytest.mark.parametrize(
    ("of", "obstacles", "place", "gaps"),
    [
        ("box", [SLAB], (0.55, 0.0, 0.0), [0.0]),
        ("box", [SLAB], (0.65, 0.1, 0.0), [0.1]),
        ("box", [SLAB], (0.6, 0.85, 0.0), [np.hypot(0.05, 0.1)]),
        ("box", [SLAB], (0.52, 0.73, 0.0), [-0.02]),  # a corner 3 cm and 2 cm within
        ("box", [SLAB], (0.75, 0.0, np.pi / 4), [0.35 - 0.4 * np.sqrt(0.5)]),
        ("box", [SLAB], (0.0, 0.7, np.pi / 2), [0.05]),
        ("box", [SLANT], (0.4 * np.sqrt(2.0) + 0.25, 0.0, 0.0), [0.1]),  # its corner to the middle of a side
        ("box", [SLANT], (0.4 * np.sqrt(2.0) + 0.11, 0.0, 0.0), [-0.04]),
        ("box", [SLAB], (0.95, 0.0, 0.0), [0.4]),
        ("box", [SLAB], (3.0, 2.0, 0.3), [9.0]),
        ("box", [CAN], (0.4, 0.1, 0.0), [0.05]),
        ("box", [CAN], (0.0, -0.44, 0.0), [-0.01]),
        ("base/tip", [SLAB], (0.7, 0.2, 2.0), [0.1]),
        ("base/centre", [SLAB], (0.7, 0.2, -1.0), [0.1]),
        ("base/tip", [CAN], (0.0, -0.55, 1.0), [0.15]),
        ("box", [SLAB, {**CAN, "position": (1.1, 0.0, 0.2)}], (0.65, 0.0, 0.0), [0.1, 0.1]),
        ("box", [SLAB, {**CAN, "position": (1.5, 0.0, 0.2)}], (0.55, 0.0, 0.0), [0.0, 0.6]),
        ("box", [], (0.0, 0.0, 0.0), []),
    ],
)
def test_nearness_of_outlines_grows_evenly_from_where_it_begins(of, obstacles, place, gaps):
    rollouts = Rollouts({"term": "outline_clearance", "of": of, "within": 0.4}, obstacles=obstacles)
    put(rollouts, of, np.tile(place, (rollouts.t * rollouts.w, 1)))
    expected = sum(max(0.0, 1.0 - d / 0.4) for d in gaps)
    # round outlines have 32 corners, up to 1 mm within the circle
    round_ones = of != "box" or CAN["size"] in [o["size"] for o in obstacles]
    np.testing.assert_allclose(rollouts.cost(), expected, atol=6e-3 if round_ones else 2e-5)


@pytest.mark.parametrize("seed", range(2))
def test_nearness_of_boxes_matches_float64_wherever_they_are(seed):
    obstacles = [SLAB, {**SLANT, "position": (1.2, 0.4, 0.3), "rotation": TURN}]
    rollouts = Rollouts({"term": "outline_clearance", "of": "box", "within": 0.4}, obstacles=obstacles)
    rng = np.random.default_rng(seed)
    put(rollouts, "box", rng.uniform([-1.0, -1.0, -3.0], [2.2, 1.4, 3.0], size=(rollouts.t * rollouts.w, 3)))
    own = np.array([(-0.15, -0.25), (0.15, -0.25), (0.15, 0.25), (-0.15, 0.25)])
    expected = outline_clearance(rollouts, "box", own, 0.4)
    assert (expected > 1.0).any()
    assert (expected == 0.0).any()
    np.testing.assert_allclose(rollouts.cost(), expected, atol=2e-5)


def test_a_goal_without_a_height_is_compared_in_the_plane():
    cost = {"term": "distance", "between": ["box", "goal"]}
    rollouts = Rollouts(cost)
    d = rollouts.pose("box")[0] - rollouts.pose("goal")[0]
    np.testing.assert_allclose(rollouts.cost(), np.linalg.norm(d, axis=-1), rtol=1e-4)
    flat = rollouts.scene.model_copy(update={"goal": rollouts.scene.goal.model_copy(update={"position": (1.0, 2.0)})})
    stack = CostStack(flat, rollouts.layout)
    stack.attach(rollouts.trajectory, rollouts.control, SHAPE)
    stack.set_goal(rollouts.goal)
    stack.launch()
    np.testing.assert_allclose(stack.cost.numpy()[0], np.linalg.norm(d[..., :2], axis=-1), rtol=1e-4)


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        ({"term": "distnce"}, r"cost\.distnce\.term: no such cost term.*Did you mean 'distance'"),
        ({"term": "distance", "between": ["base/tpi", "box"]}, r"cost\.distance\.between.*Did you mean 'base/tip'"),
        ({"term": "distance", "betwen": ["base/tip", "box"]}, r"unknown key.*Did you mean 'between'"),
        ({"term": "distance"}, r"the key 'between' is missing"),
        ({"term": "distance", "between": ["base/tip"]}, r"cost\.distance\.between"),
        ({"term": "distance", "between": ["base/tip", "box"], "metric": "manhattan"}, r"cost\.distance\.metric"),
        ({"term": "yaw", "of": "boks"}, r"cost\.yaw\.of.*Did you mean 'box'"),
        ({"term": "contact_force", "between": ["base", "obstacle"]}, r"cost\.contact_force.*Did you mean 'obstacles'"),
        ({"term": "control_effort", "of": "bas"}, r"cost\.control_effort\.of.*Did you mean 'base'"),
        ({"term": "obstacle_clearance", "of": "box", "to": "edge"}, r"cost\.obstacle_clearance\.to.*surface"),
        ({"term": "height", "of": "box", "target": "high"}, r"cost\.height\.target"),
        (
            {"term": "outline_clearance", "of": "wall", "within": 0.1},
            r"cost\.outline_clearance\.of: .*no colliding shape",
        ),
        (
            {"term": "outline_clearance", "of": "goal", "within": 0.1},
            r"cost\.outline_clearance\.of: .*no colliding shape",
        ),
        ({"term": "outline_clearance", "of": "base/x_link", "within": 0.1}, r"clearance\.of: .*no colliding shape"),
        ({"term": "outline_clearance", "of": "boks", "within": 0.1}, r"outline_clearance\.of.*Did you mean 'box'"),
        ({"term": "outline_clearance", "of": "box", "within": 0.0}, r"cost\.outline_clearance\.within"),
    ],
)
def test_mistakes_in_a_cost_table_name_the_key_and_a_way_out(cost, message):
    with pytest.raises(SceneError, match=message):
        Rollouts(cost)


# terms of users


@wp.struct
class ReachParams:
    frame: int
    gain: float
    target: wp.vec3
    joint: int


@warpmpc.cost_term("reach")
def reach(s: warpmpc.StepView, p: ReachParams) -> float:
    away = wp.length_sq(warpmpc.frame_position(s, p.frame) - p.target)
    return p.gain * away + warpmpc.joint_velocity(s, 0) * warpmpc.control(s, 1) + warpmpc.joint_position(s, p.joint)


@warpmpc.array_cost("reach_array")
def reach_array(batch) -> np.ndarray:
    p = batch["params"]
    body_q = batch["body_q"][1:, :, p["body"]].astype(np.float64)
    turn = Rotation.from_quat(body_q[..., 3:].reshape(-1, 4))
    tip = body_q[..., :3] + turn.apply([0.2, 0.0, 0.0]).reshape(*body_q.shape[:2], 3)
    away = ((tip - p["target"]) ** 2).sum(-1)
    return p["gain"] * away + batch["joint_qd"][1:, :, 0] * batch["control"][..., 1] + batch["joint_q"][1:, :, 2]


KEYS = {"frame": "base/tip", "gain": 1.5, "target": [0.3, -0.2, 0.7], "joint": "yaw"}


def test_a_users_term_and_its_array_twin_agree():
    layout = Rollouts({"term": "control_effort"}).layout
    body = int(layout.frame_body[layout.frame("base/tip")])
    twin = {"term": "reach_array", "weight": 3.0, "body": body, "gain": 1.5, "target": [0.3, -0.2, 0.7]}
    for seed in range(2):
        rollouts = Rollouts({"term": "reach", "weight": 3.0, **KEYS}, twin, seed=seed, terms=[reach, reach_array])
        own, array = rollouts.cost(0), rollouts.cost(1)
        assert np.ptp(own) > 1.0
        np.testing.assert_allclose(own, array, rtol=1e-4, atol=1e-4)


def test_terms_of_the_same_function_name_are_not_mixed_up():
    def make(name: str, factor: float):
        @wp.struct
        class Params:
            offset: float

        @warpmpc.cost_term(name)
        def term(s: warpmpc.StepView, p: Params) -> float:
            return wp.static(factor) * warpmpc.joint_position(s, 0) + p.offset

        return term

    def other():
        @wp.struct
        class Params:
            offset: float

        @warpmpc.cost_term("third")
        def term(s: warpmpc.StepView, p: Params) -> float:
            return warpmpc.joint_position(s, 1) - p.offset

        return term

    terms = [make("first", 1.0), make("second", -2.0), other()]
    costs = [{"term": term.name, "offset": 0.5} for term in terms]
    rollouts = Rollouts(*costs, terms=terms)
    q = rollouts.trajectory.joint_q.numpy()[1:]
    for i, expected in enumerate((q[..., 0] + 0.5, -2.0 * q[..., 0] + 0.5, q[..., 1] - 0.5)):
        np.testing.assert_allclose(rollouts.cost(i), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": "base/tpi"}, r"cost\.reach\.frame.*Did you mean 'base/tip'"),
        ({"joint": "yow"}, r"cost\.reach\.joint"),
        ({"gian": 1.0}, r"cost\.reach\.gian.*Did you mean 'gain'"),
        ({"gain": True}, "needs finite numbers"),
        ({"gain": {"p": 1.0}}, "needs finite numbers"),
        ({"target": ["a", "b", "c"]}, "needs finite numbers"),
        ({"target": [1.0, 2.0]}, "does not fit"),
        ({"target": [1.0, 2.0, 3.0, 4.0]}, "does not fit"),
        ({"gain": [1.0, 2.0]}, "does not fit"),
    ],
)
def test_mistakes_in_a_users_table_name_the_key(change, message):
    with pytest.raises(SceneError, match=message):
        Rollouts({"term": "reach", **KEYS, **change}, terms=[reach])


@pytest.mark.parametrize("missing", KEYS)
def test_every_field_of_a_users_struct_must_be_given(missing):
    keys = {key: value for key, value in KEYS.items() if key != missing}
    with pytest.raises(SceneError, match=f"needs the key '{missing}'"):
        Rollouts({"term": "reach", **keys}, terms=[reach])


def test_a_term_without_its_annotations_is_refused_when_it_is_defined():
    def bare(s, p):
        return 0.0

    def no_struct(s: warpmpc.StepView, p: float) -> float:
        return 0.0

    def no_view(s: ReachParams, p: ReachParams) -> float:
        return 0.0

    for function in (bare, no_struct, no_view):
        with pytest.raises(TypeError, match=rf"cost term 'x': write def {function.__name__}\("):
            warpmpc.cost_term("x")(function)


def test_an_array_cost_of_the_wrong_shape_is_refused():
    flat = warpmpc.array_cost("flat")(lambda batch: np.zeros(3))
    with pytest.raises(SceneError, match=r"cost\.flat: .*wrong shape.*\[3\].*\(5, 12\)"):
        Rollouts({"term": "flat"}, terms=[flat]).cost()
