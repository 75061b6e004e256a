# SPDX-License-Identifier: Apache-2.0
"""The work left to push an object to its goal, as the cost of rollouts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from evaluating import Evaluating
from push_scenes import YAWS, block
from scipy.spatial.transform import Rotation
from small_scenes import BOX, layout_of, make_scene
from ways import around_corners

from warpmpc import SceneError, Task
from warpmpc.cost.stack import CostStack
from warpmpc.scene.model.trajectory import BatchSize

KEYS = {"term": "push_path", "pusher": "base/centre", "object": "box", "width": 0.2, "length": 0.3}
SWIVEL = math.atan2(0.75 * 0.25 - 0.1, 0.15)  # [rad] beside the middle of a broad side, to turn the box
RADIUS = math.hypot(0.15, 0.25) + 0.1  # [m] within which the pusher is at the box
SAMPLES = 315


def pose(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, 0.1, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]


class Pushing(Evaluating):
    """Two environments of one step, with box and pusher put in place by hand."""

    def __init__(self, *costs: dict, obstacles=(), goals=((0.0, 0.0),), device: str = "cpu", **box):
        scene = make_scene(
            object=[{**BOX, "position": (0.8, 0.0, 0.1), **box}],
            obstacle=list(obstacles),
            goal={"object": "box", "position": (0.0, 0.0), "yaw": 0.0},
            cost=[{**KEYS, **cost} for cost in costs],
        )
        super().__init__(scene, BatchSize(2, SAMPLES, 1, 1), device=device)
        self.aim(*(goals if len(goals) == 2 else 2 * goals))

    def aim(self, *goals) -> None:
        """Move the goals (x, y, yaw) of both environments."""
        self.set_goal(np.array([pose(*goal) for goal in goals]))

    def values(self) -> np.ndarray:
        """Values of the first term ``[E, rows, columns, 16]``."""
        return self.stack.terms[0][1].value.numpy().copy()

    def cost(self, box, pusher, velocity=(0.0, 0.0)) -> np.ndarray:
        """Cost ``[term, E, S]`` of boxes (x, y, yaw), pushers (x, y) and the boxes' velocities (x, y).

        Each is for one, a sample or an environment.
        """
        body_q = np.zeros((2, 2, SAMPLES, self.layout.nb, 7), np.float32)
        body_q[..., 6] = 1.0
        for name, place in (("box", box), ("base/centre", pusher)):
            body = self.layout.frame_body[self.layout.frame(name)]
            body_q[..., body, :] = np.apply_along_axis(lambda p: pose(*p), -1, np.asarray(place, dtype=float))
        self.trajectory.body_q.assign(body_q.reshape(2, 2 * SAMPLES, -1, 7))
        body_qd = np.zeros((2, 2, SAMPLES, self.layout.nb, 6), np.float32)
        body_qd[..., self.layout.frame_body[self.layout.frame("box")], :2] = velocity
        self.trajectory.body_qd.assign(body_qd.reshape(2, 2 * SAMPLES, -1, 6))
        self.observe()
        return super().cost()[:, 0].reshape(-1, 2, SAMPLES)


def around(centre, radius, angle: np.ndarray) -> np.ndarray:
    """Places [n, 2] at a distance from a centre in directions [n]."""
    return np.array(centre) + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


@pytest.mark.parametrize("yaw", YAWS)
@pytest.mark.parametrize("side", range(4))
def test_a_box_pushed_along_the_normal_of_its_side_has_no_hump_on_its_way(side, yaw, device):
    goal = np.array([0.231, -0.117])
    pushing = Pushing({"steer": 0.5}, goals=[(*goal, yaw)], device=device)
    normal = yaw + side * np.pi / 2
    left = np.linspace(0.9, 0.0, SAMPLES)
    box = around(goal, left, np.full(SAMPLES, normal))
    pusher = around(goal, left + 0.3, np.full(SAMPLES, normal))
    found = pushing.cost(np.column_stack([box, np.full(SAMPLES, yaw)]), pusher)[0]
    assert (np.diff(found, axis=1) < 0.0).all()
    np.testing.assert_allclose(found, [left, left], atol=1e-4)


def test_a_tilted_goal_counts_by_the_heading_of_its_x_axis(device):
    turns = Rotation.random(2, rng=np.random.default_rng(3))
    x = turns.apply([1.0, 0.0, 0.0])
    headings = np.arctan2(x[:, 1], x[:, 0])
    upright = Pushing({"steer": 0.5}, goals=[(0.2, 0.1, h) for h in headings], device=device)
    tilted = Pushing({"steer": 0.5}, device=device)
    poses = np.column_stack([np.tile([0.2, 0.1, 0.4], (2, 1)), turns.as_quat()])
    tilted.set_goal(poses)
    rng = np.random.default_rng(0)
    box = rng.uniform([-0.8, -0.8, -3.0], [0.8, 0.8, 3.0], size=(SAMPLES, 3))
    places = box, box[:, :2] + rng.uniform(-1.0, 1.0, size=(SAMPLES, 2))
    np.testing.assert_allclose(tilted.cost(*places), upright.cost(*places), atol=1e-3)


def test_an_object_may_coast_through_its_goal_but_not_past_it(device):
    pushing = Pushing({"lead": 0.5, "through": True, "tolerance": 0.05}, device=device)
    speed = np.linspace(0.0, 3.0, SAMPLES)
    velocity = np.column_stack([-speed, np.zeros(SAMPLES)])
    through = pushing.cost((0.3, 0.0), (0.6, 0.0), velocity)[0]
    assert (through[:, 1:] < through[:, :1]).all()
    np.testing.assert_allclose(through[:, speed > 0.6], 0.6 - RADIUS, atol=1e-4)  # the pusher's way
    for box, pusher in (((0.3, 0.3), (0.6, 0.3)), ((-0.1, 0.0), (0.2, 0.0))):
        past = pushing.cost(box, pusher, velocity)[0]
        assert (past[:, -1] > past[:, 0] + 0.5).all()


@pytest.mark.parametrize("turn", [1.0, 0.4])
def test_a_pusher_farther_away_costs_its_way(turn, device):
    pushing = Pushing({"turn": turn, "behind": 0.05}, device=device)
    away = np.linspace(0.2, 2.0, SAMPLES)
    found = pushing.cost((0.6, 0.0), around((0.6, 0.0), away, np.zeros(SAMPLES)))[0]
    expected = 0.6 + turn * np.maximum(away - RADIUS - 0.05, 0.0)
    np.testing.assert_allclose(found, [expected] * 2, atol=1e-4)
    # on the wrong side a way around comes on top
    wrong = pushing.cost((0.6, 0.0), around((0.6, 0.0), away, np.full(SAMPLES, np.pi)))[0, 0]
    assert (wrong > expected + 0.9 * turn).all()
    assert (np.diff(wrong) >= -1e-5).all()


@pytest.mark.parametrize("size", [BOX["size"], (0.04, 0.04, 0.2)])
def test_obstacles_between_pusher_and_object_make_the_way_longer(size, device):
    """A small object too, whose grid is finer: its pusher is not smaller."""
    wall = block(size=(0.2, 1.2, 0.4), position=(0.9, 0.0))
    walls = (), (wall,)
    pushing = [Pushing({}, obstacles=o, position=(0.0, 0.0, 0.1), size=size, device=device) for o in walls]
    found = [p.cost((0.0, 0.0), (1.5, 0.1))[0, 0, 0] for p in pushing]
    exact = around_corners((0.0, 0.0), (1.5, 0.1), [(0.8, 0.6), (1.0, 0.6)], 0.5 * math.hypot(0.2, 0.3))
    assert exact > 2.0
    assert found[1] - found[0] == pytest.approx(exact - math.hypot(1.5, 0.1), abs=0.08)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7])
def test_offsets_within_the_tolerance_along_the_goals_axes_are_free(yaw, device):
    pushing = Pushing({"tolerance": 0.04}, {}, goals=[(0.3, -0.2, yaw)], device=device)
    rng = np.random.default_rng(0)
    along = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

    def costs(offset: np.ndarray) -> np.ndarray:
        box = np.array([0.3, -0.2]) + offset @ along
        at = around((0.0, 0.0), 0.3, rng.uniform(-np.pi, np.pi, SAMPLES))
        return pushing.cost(np.column_stack([box, np.full(SAMPLES, yaw)]), box + at)[:, 0]

    small = rng.uniform(-0.039, 0.039, size=(SAMPLES, 2))
    tolerant, strict = costs(small)
    np.testing.assert_allclose(tolerant, 0.0, atol=1e-4)
    assert np.median(strict) > 0.1
    large = rng.uniform(0.101, 0.5, size=(SAMPLES, 2)) * rng.choice([-1.0, 1.0], size=(SAMPLES, 2))
    tolerant, strict = costs(large)
    np.testing.assert_allclose(tolerant, strict, atol=1e-4)
    assert tolerant.min() > 0.1
    # in between it grows without a jump
    one = np.stack([np.linspace(0.0, 0.12, SAMPLES), np.zeros(SAMPLES)], axis=1)
    box = np.array([0.3, -0.2]) + one @ along
    found, strict = pushing.cost(np.column_stack([box, np.full(SAMPLES, yaw)]), box + 0.3 * along[0])[:, 0]
    assert np.abs(np.diff(found)).max() < 0.04
    np.testing.assert_allclose(found[-1], strict[-1], atol=1e-4)


def cheapest_angle(pushing: Pushing, box: tuple[float, float], yaw: float) -> float:
    """Direction from a box to where a pusher beside it is cheapest."""
    angle = np.linspace(-np.pi, np.pi, SAMPLES)
    return float(angle[pushing.cost((*box, yaw), around(box, 0.3, angle))[0, 0].argmin()])


@pytest.mark.parametrize(("goal_yaw", "error"), [(0.0, 0.12), (0.7, -0.15), (3.0, 0.18)])
@pytest.mark.parametrize("steer", [0.0, 0.6])
def test_steering_moves_the_cheapest_side_so_that_a_push_turns_the_object_back(steer, goal_yaw, error, device):
    pushing = Pushing({"steer": steer}, goals=[(0.0, 0.0, goal_yaw)], device=device)
    for side in (goal_yaw, goal_yaw + np.pi / 2):
        box = 0.6 * math.cos(side), 0.6 * math.sin(side)
        beside = cheapest_angle(pushing, box, math.remainder(goal_yaw + error, math.tau)) - side
        assert math.remainder(beside + steer * error, math.tau) == pytest.approx(0.0, abs=0.011)
        # torque about the object of a force towards the goal at the pusher's place
        assert math.sin(beside) * error < 0.0 or steer == 0.0


@pytest.mark.parametrize("error", [0.5, -0.5, 1.4, -1.8, 2.9])
@pytest.mark.parametrize("steer", [0.0, 2.0])
def test_a_pusher_stays_near_the_middle_of_a_side_of_the_turned_object(steer, error, device):
    pushing = Pushing({"steer": steer}, device=device)
    for side, box in ((0.0, (0.6, 0.0)), (np.pi / 2, (0.0, 0.6))):
        middle = side + error - 0.5 * np.pi * round(error / (0.5 * np.pi))  # of the side that faces there now
        beside = math.remainder(cheapest_angle(pushing, box, error) - middle, math.tau)
        assert beside == pytest.approx(-math.copysign(0.75 * SWIVEL, error), abs=0.011)


@pytest.mark.parametrize("error", [0.25, -0.25, 0.8, -1.2])
@pytest.mark.parametrize(("size", "broad"), [((0.3, 0.5, 0.2), 0.0), ((0.5, 0.3, 0.2), np.pi / 2)])
def test_at_its_goal_a_turned_box_is_turned_back_from_a_broad_side(size, broad, error, device):
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03}, device=device, size=size)
    angle = cheapest_angle(pushing, (0.0, 0.0), error) - error - broad  # in the box's frame, from a broad side
    beside = angle - np.pi * round(angle / np.pi)
    assert beside == pytest.approx(-math.copysign(SWIVEL, error), abs=0.011)
    straight = Pushing({"tolerance": 0.03}, device=device, size=size)
    assert np.ptp(straight.cost((0.0, 0.0, error), around((0.0, 0.0), 0.3, np.linspace(-3, 3, SAMPLES)))) < 1e-5


@pytest.mark.parametrize(
    ("size", "width", "beside"),
    [
        ((0.15, 0.46, 0.1), 0.02, math.atan2(0.75 * 0.23 - 0.01, 0.075)),  # a stick needs the whole arm
        ((0.3, 0.5, 0.2), 0.39, 0.4),  # the corner of a broad front reaches far from its middle
    ],
)
def test_the_narrower_the_pusher_the_farther_out_it_turns_a_long_box(size, width, beside, device):
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03, "width": width}, device=device, size=size)
    angle = cheapest_angle(pushing, (0.0, 0.0), -0.25) + 0.25
    assert angle - np.pi * round(angle / np.pi) == pytest.approx(beside, abs=0.011)


@pytest.mark.parametrize("error", [0.12, -0.3, 0.42])
@pytest.mark.parametrize("size", [(0.15, 0.46, 0.1), (0.46, 0.15, 0.1), (0.2, 0.2, 0.1)])
def test_on_its_way_a_box_is_pushed_between_its_middle_and_its_corner(size, error, device):
    """On every side, where the push turns it back; beyond the corner lies another side."""
    pushing = Pushing({"steer": 1.0, "width": 0.02, "length": 0.02}, device=device, size=size)
    for side, box in ((0.0, (1.0, 0.0)), (np.pi / 2, (0.0, 1.0)), (np.pi, (-1.0, 0.0))):
        across, along = size[:2] if side != np.pi / 2 else size[1::-1]
        place = math.remainder(cheapest_angle(pushing, box, error) - side - error, math.tau)  # from the side's middle
        assert place * error < 0.0, (side, place)
        assert abs(place) < math.atan2(along, across), (side, place)


@pytest.mark.parametrize(("angle", "apart"), [(-2.5, 0.35), (-0.6, 0.8), (0.4, 0.35), (2.0, 0.8)])
@pytest.mark.parametrize(("direction", "low"), [(1.0, 0.1), (-1.0, 0.9), (1.0, 2.0)])
def test_the_cost_does_not_jump_as_the_object_turns(angle, apart, direction, low, device):
    """It used to jump by a walk around a quarter of the box at 45°, and pushers waited before that step."""
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03}, device=device)
    error = direction * np.linspace(low, low + 1.0, SAMPLES)
    box = np.column_stack([np.full(SAMPLES, 0.8), np.full(SAMPLES, 0.3), error])
    (pusher,) = around((0.8, 0.3), apart, np.array([angle]))
    assert np.abs(np.diff(pushing.cost(box, pusher)[0, 0])).max() < 0.03


@pytest.mark.parametrize("error", [0.18, -0.3, 0.6])
@pytest.mark.parametrize("aside", [0.035, -0.035])
def test_a_turned_box_beside_its_goal_is_turned_back_from_the_side_to_which_it_lies(aside, error, device):
    """A push from the other side would take it farther off: pushers used to wait there for good."""
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03}, device=device)
    box = aside * math.cos(error), aside * math.sin(error)  # aside along the normal of its broad sides
    angle = cheapest_angle(pushing, box, error) - error
    towards = 0.0 if aside > 0.0 else np.pi
    assert math.remainder(angle - towards + math.copysign(SWIVEL, error), math.tau) == pytest.approx(0.0, abs=0.011)
    # and the way there goes downhill, all around the box
    way = np.linspace(np.pi, 0.0, SAMPLES) * math.copysign(1.0, error)
    cost = pushing.cost((*box, error), around(box, 0.3, error + towards - math.copysign(SWIVEL, error) + way))[0, 0]
    assert (np.diff(cost) < 1e-4).all()


@pytest.mark.parametrize("error", [0.1, -0.2, 0.35, -0.35, 0.7, -1.2])
def test_turning_a_box_back_is_no_reason_to_keep_it_from_its_goal(error, device):
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03, "turn": 0.5}, device=device)
    angle = np.linspace(-np.pi, np.pi, SAMPLES)
    least = [pushing.cost((x, 0.0, error), around((x, 0.0), 0.5, angle))[0, 0].min() for x in np.linspace(0.4, 0.0, 41)]
    assert (np.diff(least) < 1e-4).all(), least


def test_a_goal_moves_in_its_own_environment_alone(device):
    pushing = Pushing({}, device=device)
    before, old = pushing.values(), pushing.cost((0.6, 0.0), (0.9, 0.0))[0, :, 0]
    np.testing.assert_array_equal(before[0], before[1])
    np.testing.assert_allclose(old, 0.6, atol=1e-4)
    pushing.aim((0.0, 0.0), (-0.313, 0.0))
    after, new = pushing.values(), pushing.cost((0.6, 0.0), (0.9, 0.0))[0, :, 0]
    np.testing.assert_array_equal(after[0], before[0])
    assert np.abs(after[1] - before[1]).max() > 0.2
    np.testing.assert_allclose(new, [0.6, 0.913], atol=1e-4)
    pushing.aim((0.1, 0.0), (-0.313, 0.0))
    np.testing.assert_array_equal(pushing.values()[1], after[1])
    np.testing.assert_allclose(pushing.cost((0.6, 0.0), (0.9, 0.0))[0, :, 0], [0.5, 0.913], atol=1e-4)
    pushing.aim((0.1, 0.0, np.pi / 4), (-0.313, 0.0))  # a turn alone is a move: now it takes two sides
    new = pushing.cost((0.6, 0.0), (0.9, 0.0))[0, :, 0]
    assert new[0] > 0.7
    np.testing.assert_allclose(new[1], 0.913, atol=1e-4)


def test_a_table_under_the_object_is_a_support_and_not_in_the_way(device):
    table = {"name": "table", "shape": "box", "size": (3.0, 3.0, 0.2), "position": (0.5, 0.0, -0.1), "support": True}
    wall = block(size=(0.2, 1.2, 0.4), position=(0.9, 0.0))
    rng = np.random.default_rng(0)
    box = rng.uniform([-0.5, -0.5, -3.0], [0.5, 0.5, 3.0], size=(SAMPLES, 3))
    pusher = box[:, :2] + rng.uniform(-1.0, 1.0, size=(SAMPLES, 2))
    start = {"position": (0.0, 0.0, 0.1), "device": device}
    without = Pushing({"steer": 0.5}, obstacles=[wall], **start).cost(box, pusher)
    with_table = Pushing({"steer": 0.5}, obstacles=[wall, table], **start).cost(box, pusher)
    np.testing.assert_allclose(with_table, without, atol=0.06)  # a larger grid, its cells elsewhere
    with pytest.raises(SceneError, match=r"'box' starts within obstacle 'table'.*support = true") as caught:
        Pushing({}, obstacles=[wall, {**table, "support": False}], **start)
    assert caught.value.key == "obstacle.table.support"
    post = block("post", size=(0.2, 0.2, 0.4), position=(0.0, 0.0))
    with pytest.raises(SceneError, match="the goal of 'box' lies within obstacle 'post'"):
        Pushing({}, obstacles=[post], device=device)
    with pytest.raises(SceneError, match="stands upright") as caught:
        Pushing({}, rotation=(0.7071, 0.0, 0.0, 0.7071), device=device)
    assert caught.value.key == "object.box.rotation"


def test_a_small_object_has_a_finer_grid(device):
    """A fifth as large, everything costs a fifth, close to the goal too: cells shrink with the object."""
    box = np.array([(0.61, 0.0), (0.0, 0.43), (-0.3, 0.2), (0.09, 0.07), (0.1, -0.06)])
    pusher = box + np.array([(0.2, 0.0), (-0.1, 0.3), (0.25, 0.1), (0.3, 0.0), (0.0, -0.3)])
    found = []
    for scale in (1.0, 0.2):
        size = tuple(scale * s for s in BOX["size"])
        keys = {"width": 0.2 * scale, "length": 0.3 * scale, "inflation": 0.0}
        pushing = Pushing(keys, size=size, position=(0.8 * scale, 0.0, 0.1 * scale), device=device)
        found.append([pushing.cost(b, p)[0, 0, 0] / scale for b, p in zip(scale * box, scale * pusher, strict=True)])
    np.testing.assert_allclose(found[1], found[0], atol=0.05)


@pytest.mark.parametrize(
    ("cost", "key", "found", "allowed", "says"),
    [
        ({"object": "boks"}, ".object", "boks", "box", "Did you mean 'box'"),
        ({"object": "wall"}, ".object", "wall", "box", "no such object"),
        ({"object": "stone"}, ".object", "mesh", None, "needs a primitive shape"),
        ({"pusher": "base/center"}, ".pusher", "base/center", "base/centre", "Did you mean 'base/centre'"),
        ({"width": None}, "", None, None, "the key 'width' is missing"),
        ({"widht": 0.2}, ".widht", "widht", "width", "Did you mean 'width'"),
        ({"width": 0.0}, ".width", 0.0, "across its direction", "wrong value"),
        ({"slant": 0.9}, ".slant", 0.9, "square to it", "wrong value"),
    ],
)
def test_mistakes_in_the_table_name_the_key_and_a_way_out(cost, key, found, allowed, says):
    table = {name: value for name, value in {**KEYS, **cost}.items() if value is not None}
    scene = make_scene(object=[BOX, {**BOX, "name": "stone"}], obstacle=[block("wall")], cost=[table])
    layout = layout_of(scene)
    (stone,) = layout.entity("stone").shapes
    shapes = [replace(shape, kind="mesh") if i == stone else shape for i, shape in enumerate(layout.shapes)]
    with pytest.raises(SceneError, match=says) as caught:
        CostStack(scene, replace(layout, shapes=shapes), Task(scene))
    assert caught.value.key == f"cost.push_path{key}"
    assert caught.value.found == found
    if allowed:
        assert allowed in str(caught.value.allowed) or allowed in list(caught.value.allowed)
