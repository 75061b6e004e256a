# SPDX-License-Identifier: Apache-2.0
"""Every built-in cost term against float64 on random rollouts."""

import numpy as np
import pytest
from arm_references import CASES as ARM_CASES
from outlines import RING, outline_clearance
from rollouts import SHAPE, Rollouts, heading
from scipy.interpolate import RegularGridInterpolator

from warpmpc import SceneError
from warpmpc.cost.resources.push_value import ANGLES
from warpmpc.cost.stack import CostStack
from warpmpc.cost.terms import TERMS
from warpmpc.scene.draw import signed_distance


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


SWIVEL = np.arctan2(0.75 * 0.25 - 0.5 * 0.2, 0.15)
"""From where a pusher 0.2 m wide turns the box [rad]: its side reaches three quarters of the way to the corner."""


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

    _, params = r.stack.terms[0]
    table, cell = np.moveaxis(params.value.numpy().astype(np.float64), -1, 1), params.cell
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

    # beside the middle of the box's own side; from 0.52 on ever nearer to its corner, which faces straight at 45°, and
    # from 60 to 75° over to the next side
    size = np.abs(error)
    turned = size - 0.5 * np.pi * np.floor((size + np.pi / 12) / (0.5 * np.pi))
    across = np.cos(np.angle(to) - error) ** 2  # how squarely the pusher stands before a broad side
    narrow = min(SWIVEL, np.arctan2(0.15, 0.25))
    aim = np.minimum((1.0 + steer) * size, 0.75 * (narrow + across * (SWIVEL - narrow)))
    knots = np.array([-np.pi / 12, 0.52, np.pi / 4, np.pi / 3, 5 * np.pi / 12])
    places = [[knots[0] - m, knots[1] - m, 0.12, np.pi / 12 + 0.12, knots[0] - m] for m in aim]
    place = np.array([np.interp(t, knots, row) for t, row in zip(turned, places, strict=True)])
    side = np.angle(to) - np.sign(error) * place
    least = value(side) + turn * np.maximum(apart - radius, 0.0)
    for part in np.array([-1.0, -2 / 3, -1 / 3, 1 / 3, 2 / 3, 1.0]):
        angle = part * np.arccos(np.minimum(radius / apart, 1.0))
        way = np.linalg.norm(np.stack([apart - radius * np.cos(angle), radius * np.sin(angle)]), axis=0)
        other = value(side + angle) + turn * way
        least = np.where(apart > radius, np.minimum(least, other), least)
    # near the goal the pusher goes to where it turns the box back: beside the middle of one of its broad sides (± x),
    # of that to which the box lies when it lies aside by half the tolerance
    beside = np.angle(to) - error + SWIVEL * np.sign(error)
    either = np.abs(beside - np.pi * np.round(beside / np.pi))
    aside = (off * np.exp(-1j * error)).real / max(tolerance, 1e-6)
    outer = np.abs(np.angle(np.exp(1j * (beside + np.pi * (aside < 0.0)))))
    share = np.minimum(2.0 * np.abs(aside), 1.0)
    astray = ((1.0 - share) * either + share * outer) * np.minimum(np.abs(error) / 0.3, 1.0)
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


def joint_limit(r: Rollouts, margin: float, joints: tuple[int, ...] = (0, 1)) -> np.ndarray:
    q = r.trajectory.joint_q.numpy()[1:, :, joints].astype(np.float64)  # yaw has no limits
    return (np.maximum(np.abs(q) - (100.0 - margin), 0.0) ** 2).sum(-1)


def approach(r: Rollouts, width: float, rise: float) -> np.ndarray:
    (hand, turn), (box, _) = r.pose("base/tip"), r.pose("box")
    d = box - hand
    beside = np.linalg.norm(turn.inv().apply(d.reshape(-1, 3))[:, :2], axis=1)
    low = np.maximum(r.each(rise * (1.0 - np.exp(-((beside / width) ** 8)))) + d[..., 2], 0.0)
    return np.sqrt((d**2).sum(-1) + 1e-4) - 0.01 + 2.0 * low


def finger_alignment(r: Rollouts) -> np.ndarray:
    across = r.pose("box")[1].inv().apply(r.pose("base/tip")[1].apply([0.0, 1.0, 0.0]))
    return r.each(2.0 * (1.0 - (across**4).sum(axis=1)))


def gripper(r: Rollouts, near: float) -> np.ndarray:
    u = r.control.numpy().astype(np.float64)
    mean = 0.5 * (u[..., 0] / 1.0 + u[..., 2] / 0.5)
    closing = distance(r, False) < near
    assert 0.1 < closing.mean() < 0.9
    return np.where(closing, 0.5 * (1.0 + mean), 1.0 + 0.5 * (1.0 - mean))


def posture(r: Rollouts) -> np.ndarray:
    q = r.trajectory.joint_q.numpy()[1:, :, [2, 0]].astype(np.float64)
    return ((q - [0.5, 0.3]) ** 2).sum(-1)


def rate(r: Rollouts) -> np.ndarray:
    u = r.control.numpy().astype(np.float64)
    before = np.concatenate([np.repeat(r.state.last_control.numpy(), SHAPE.rollouts, axis=0)[None], u[:-1]])
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
    "control_effort": ({"of": "base"}, lambda r: ((r.control.numpy() / [1.0, 2.0, 0.5]) ** 2).sum(-1)),
    "control_rate": ({}, rate),
    "joint_limit": ({"margin": 99.5}, lambda r: joint_limit(r, 99.5)),
    "joint_limit of some": (
        {"term": "joint_limit", "joints": ["base/y"], "margin": 99.5},
        lambda r: joint_limit(r, 99.5, (1,)),
    ),
    "joint_velocity": ({}, lambda r: (r.trajectory.joint_qd.numpy()[1:, :, :3].astype(np.float64) ** 2).sum(-1)),
    "joint_velocity of some": (
        {"term": "joint_velocity", "joints": ["yaw", "base/x"]},
        lambda r: (r.trajectory.joint_qd.numpy()[1:, :, [2, 0]].astype(np.float64) ** 2).sum(-1),
    ),
    "posture": ({"joints": ["base/yaw", "x"]}, posture),
    "approach": ({"hand": "base/tip", "object": "box", "width": 1.2, "rise": 0.8}, lambda r: approach(r, 1.2, 0.8)),
    "finger_alignment": ({"hand": "base/tip", "object": "box"}, finger_alignment),
    "gripper": (
        {"hand": "base/tip", "object": "box", "near": 1.8, "fingers": ["base/x", "base/yaw"]},
        lambda r: gripper(r, 1.8),
    ),
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
    # wide: the ends of a lying capsule have their own corners, some millimetres off
    "outline_clearance": (
        {"of": "base/tip", "within": 8.0},
        lambda r: outline_clearance(r, "base/tip", 0.2 * RING[:, :2] - [0.2, 0.0], 8.0),
    ),
    "outline_distance": ({"of": "base/tip", "object": "box", "inside": 3.0}, lambda r: outline_distance(r, 3.0)),
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
    "axis": (
        {"term": "orientation", "of": "base/tip", "axis": [3.0, 0.0, 4.0]},
        lambda r: r.each(np.arccos(r.pose("base/tip")[1].apply([0.6, 0.0, 0.8])[:, 2])),
    ),
    "axis along": (
        {"term": "orientation", "of": "base/tip", "to": "box", "axis": [0.0, 2.0, 0.0], "along": [0.6, 0.8, 0.0]},
        lambda r: r.each(
            np.arccos((r.pose("base/tip")[1].apply([0, 1.0, 0]) * r.pose("box")[1].apply([0.6, 0.8, 0])).sum(-1))
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
    covered = {keys.get("term", name) for name, (keys, _) in CASES.items()}
    covered |= {keys.get("term", name) for name, (_, keys, _) in ARM_CASES.items()}
    # test_collision.py and so on, test_learned_cloud.py, test_residuals.py, test_gait.py
    elsewhere = {"collision", "learned", "learned_cloud", "cloud", "rolling", "residuals", "numbers", "gait"}
    covered |= {name for name, term in TERMS.items() if term.keys.__module__.rpartition(".")[2] in elsewhere}
    assert covered == set(TERMS)


def test_a_goal_without_a_height_is_compared_in_the_plane():
    cost = {"term": "distance", "between": ["box", "goal"]}
    rollouts = Rollouts(cost)
    d = rollouts.pose("box")[0] - rollouts.pose("goal")[0]
    np.testing.assert_allclose(rollouts.cost(), np.linalg.norm(d, axis=-1), rtol=1e-4)
    flat = rollouts.scene.model_copy(update={"goal": rollouts.scene.goal.model_copy(update={"position": (1.0, 2.0)})})
    evaluator = rollouts.evaluator_of(CostStack(flat, rollouts.layout, rollouts.task))
    evaluator.launch()
    np.testing.assert_allclose(evaluator.cost.numpy()[0], np.linalg.norm(d[..., :2], axis=-1), rtol=1e-4)


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        ({"term": "distnce"}, r"cost\.distnce\.term: no such cost term.*Did you mean 'distance'"),
        ({"term": "distance", "between": ["base/tpi", "box"]}, r"cost\.distance\.between.*Did you mean 'base/tip'"),
        ({"term": "distance", "betwen": ["base/tip", "box"]}, r"unknown key.*Did you mean 'between'"),
        ({"term": "distance", "wieght": 10.0}, r"unknown key.*between.*Did you mean 'weight'\?"),
        ({"term": "distance"}, r"the key 'between' is missing"),
        ({"term": "distance", "between": ["base/tip"]}, r"cost\.distance\.between"),
        ({"term": "distance", "between": ["base/tip", "box"], "metric": "manhattan"}, r"cost\.distance\.metric"),
        ({"term": "orientation", "of": "box", "axis": [0.0, 0.0, 0.0]}, r"orientation\.axis: .*length above zero"),
        ({"term": "orientation", "of": "box", "along": [1.0, 0.0, 0.0]}, r"cost\.orientation\.along: .*axis = "),
        ({"term": "orientation", "of": "box", "to": "gaol"}, r"cost\.orientation\.to.*Did you mean 'goal'"),
        ({"term": "yaw", "of": "boks"}, r"cost\.yaw\.of.*Did you mean 'box'"),
        ({"term": "contact_force", "between": ["base", "obstacle"]}, r"cost\.contact_force.*Did you mean 'obstacles'"),
        ({"term": "control_effort", "of": "bas"}, r"cost\.control_effort\.of.*Did you mean 'base'"),
        ({"term": "obstacle_clearance", "of": "box", "to": "edge"}, r"cost\.obstacle_clearance\.to.*surface"),
        ({"term": "height", "of": "box", "target": "high"}, r"cost\.height\.target"),
        ({"term": "joint_velocity", "joints": ["base/yav"]}, r"velocity\.joints.*Did you mean 'base/yaw'"),
        ({"term": "posture", "joints": []}, r"cost\.posture\.joints"),
        ({"term": "posture", "joints": ["x", "base/x"]}, r"cost\.posture\.joints: a joint is named twice"),
        ({"term": "posture", "of": "base", "joints": ["x"]}, r"cost\.posture\.joints: .*not both"),
        ({"term": "joint_limit", "joints": ["yaw"]}, r"cost\.joint_limit\.joints: this joint has no limits.*base/yaw"),
        (
            {"term": "finger_alignment", "hand": "base/tip", "object": "goal"},
            r"cost\.finger_alignment\.object: no such object",
        ),
        (
            {"term": "gripper", "hand": "base/tip", "object": "box", "near": 0.1, "fingers": ["base/jaw"]},
            r"cost\.gripper\.fingers: no such control.*base/x",
        ),
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
