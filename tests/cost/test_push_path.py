# SPDX-License-Identifier: Apache-2.0
"""The work left to push an object to its goal: against plain value iteration, and as the cost of rollouts."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation
from small_scenes import BOX, compiled, make_scene
from test_geodesic import around_corners

from warpmpc import SceneError
from warpmpc.cost.geodesic import Grid
from warpmpc.cost.push_path import ANGLES, OBSTRUCTED, STEPS, PushRequest, push_value
from warpmpc.cost.stack import CostStack
from warpmpc.engine.trajectory import Shape, Trajectory
from warpmpc.kernels.fields import sample_push, side_of
from warpmpc.scene.draw import signed_distance

GOALS = [(0.0, 0.0, 0.0), (0.13, -0.27, 0.7), (-0.342, 0.561, -2.0)]
YAWS = [0.0, 0.2, 0.7, np.pi / 4]


def block(name="block", *, size=(0.4, 0.8, 0.4), position=(0.5, 0.3), yaw=0.0) -> dict:
    rotation = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return {"name": name, "shape": "box", "size": size, "position": (*position, size[2] / 2), "rotation": rotation}


def make_grid(*obstacles: dict, cell: float = 0.1, reach: float = 1.0) -> Grid:
    layout = compiled(make_scene(obstacle=obstacles)).layout
    return Grid(layout, np.array([[-reach, -reach], [reach, reach]]), cell=cell)


def request(**changes) -> PushRequest:
    """A box of 0.3 × 0.5 m and a pusher of 0.2 × 0.3 m."""
    sizes = {"inflation": 0.23, "half_size": (0.15, 0.25), "faces": True, "width": 0.2, "length": 0.3}
    return PushRequest(**{**sizes, "turn": 1.0, "slant": 1.5, **changes})


def round_request(radius: float = 0.2, **changes) -> PushRequest:
    return request(half_size=(radius, radius), faces=False, **changes)


def edge(r: PushRequest, angle) -> np.ndarray:
    """Distance from an object's centre to its outline in some directions."""
    x, y = r.half_size
    if not r.faces:
        return np.full(np.shape(angle), x)
    return 1.0 / np.maximum(np.abs(np.cos(angle)) / x, np.abs(np.sin(angle)) / y)


# the search


@pytest.mark.parametrize("side", [0, 4, 8, 12])
@pytest.mark.parametrize("goal", GOALS)
@pytest.mark.parametrize("make", [request, round_request])
def test_from_the_right_side_it_is_the_straight_distance_and_else_also_the_way_around(make, goal, side):
    r = make(turn=0.7, slant=100.0)
    grid = make_grid()
    value, origin = push_value(grid, r, np.array(goal[:2]), goal[2])
    column, row = np.round(-origin / grid.cell).astype(int)
    np.testing.assert_allclose(origin + grid.cell * np.array([column, row]), 0.0, atol=1e-9)
    np.testing.assert_allclose(value[:, row, column], 0.0, atol=2e-6)
    steps = np.arange(1, 6)
    line = value[:, row + steps * STEPS[side, 1], column + steps * STEPS[side, 0]]
    np.testing.assert_allclose(line[side], grid.cell * steps, atol=2e-6)

    extra = np.roll(line - line[side], -side, axis=0)[:9]  # half a turn, starting at the right side
    np.testing.assert_allclose(np.roll(line[::-1] - line[side], side + 1, axis=0)[:9], extra, atol=1e-6)
    np.testing.assert_allclose(extra, extra[:, :1].repeat(len(steps), axis=1), atol=1e-6)
    angle = np.linspace(0.0, np.pi, 2001)
    reach = edge(r, angle + ANGLES[side]) + 0.5 * r.length
    length = np.append(0.0, np.cumsum(0.5 * (reach[1:] + reach[:-1]) * np.diff(angle)))
    expected = r.turn * np.interp(ANGLES[:9], angle, length)
    np.testing.assert_allclose(extra[:, 0], expected, rtol=0.08 if r.faces else 1e-6, atol=1e-6)
    assert (np.diff(extra[:, 0]) > 0.05).all()


def pushes(d: int, r: PushRequest) -> list[tuple[int, int, float]]:
    """Columns, rows and price of the pushes from one side; a box has four, and may be pushed a little aslant."""
    if not r.faces:
        ways = [(d, 1.0)]
    else:
        ways = [] if d % 4 else [(d, 1.0), ((d + 1) % 16, r.slant), ((d - 1) % 16, r.slant)]
    return [(-STEPS[way][0], -STEPS[way][1], price) for way, price in ways]


def value_iteration(grid: Grid, r: PushRequest, goal: tuple[int, int]) -> np.ndarray:
    """Least work ``[16, rows, columns]`` by relaxing every state until none changes; infinite where there is no way."""
    rows, columns = grid.clearance.shape
    heading = [math.atan2(y, x) % math.tau for x, y in STEPS]
    outline = edge(r, np.array(heading))

    def clear(row: int, column: int, away: float, d: int) -> bool:
        u = round(column + away * math.cos(heading[d]) / grid.cell)
        v = round(row + away * math.sin(heading[d]) / grid.cell)
        return grid.clearance[min(max(v, 0), rows - 1), min(max(u, 0), columns - 1)] >= r.width / 2

    least, most = r.width / 2, max(r.length - r.width / 2, r.width / 2)
    room = np.zeros((16, rows, columns), bool)
    for d, row, column in np.ndindex(*room.shape):
        behind = [outline[d] + least + part * (most - least) for part in (0.0, 1 / 3, 2 / 3, 1.0)]
        room[d, row, column] = all(clear(row, column, away, d) for away in behind)
    free = grid.clearance >= r.inflation

    moves = []  # (side, its step, cost)
    for d in range(16):
        for dx, dy, price in pushes(d, r):
            moves.append((d, dx, dy, price * grid.cell * math.hypot(dx, dy)))

    value = np.full((16, rows, columns), np.inf)
    value[:, goal[1], goal[0]] = 0.0
    for _ in range(1000):
        before = value.copy()
        for d, dx, dy, cost in moves:
            for row in range(max(0, -dy), min(rows, rows - dy)):
                column = np.arange(max(0, -dx), min(columns, columns - dx))
                there = row + dy, column + dx
                can = free[row, column] & free[there] & room[d, row, column] & room[(d, *there)]
                value[d, row, column] = np.minimum(
                    value[d, row, column], np.where(can, cost + value[(d, *there)], np.inf)
                )
        for d in range(16):
            for e in ((d - 1) % 16, (d + 1) % 16):
                angle = abs(math.remainder(heading[e] - heading[d], math.tau))
                arc = r.turn * angle * (0.5 * (outline[d] + outline[e]) + 0.5 * r.length)
                value[d] = np.minimum(value[d], np.where(room[d] & room[e], arc, OBSTRUCTED * arc) + value[e])
        if np.array_equal(value, before):
            return value
    raise AssertionError("no end")


@pytest.mark.parametrize("seed", range(4))
def test_it_agrees_with_value_iteration(seed):
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.1, 0.25, size=2)
    r = PushRequest(
        inflation=rng.uniform(0.12, 0.3),
        half_size=tuple(half if seed % 2 else half[[0, 0]]),
        faces=bool(seed % 2),
        width=rng.uniform(0.1, 0.3),
        length=rng.uniform(0.0, 0.5),
        turn=rng.uniform(0.3, 1.5),
        slant=rng.uniform(1.0, 2.0),
    )
    grid = make_grid(block(), cell=0.2)
    goal, yaw = rng.uniform([-0.2, -0.6], [0.2, 0.6]), rng.uniform(-3.0, 3.0)
    value, origin = push_value(grid, r, goal, yaw)
    moved, cell = grid.turned(goal, yaw)
    np.testing.assert_array_equal(origin, moved.origin)
    expected = value_iteration(moved, r, cell)
    straight = np.linalg.norm(moved.points - goal, axis=-1)
    expected = np.where(np.isfinite(expected), expected, 3.0 * straight)
    free = moved.clearance >= r.inflation
    assert 10 < (~free).sum() < 0.3 * free.size
    assert (expected - straight)[:, free].max() > 1.0
    np.testing.assert_allclose(value[:, free], expected[:, free], atol=2e-6)

    for row, column in np.argwhere(~free):
        away = np.linalg.norm(moved.points[free] - moved.points[row, column], axis=1)
        nearest = expected[:, free][:, away < away.min() + 1e-6] + 2.0 * away.min()
        assert np.abs(nearest - value[:, row, column, None]).max(axis=0).min() < 1e-5


def around_goal(grid: Grid, r: PushRequest, goal: np.ndarray, yaw: float, reach: int = 10) -> np.ndarray:
    """Values of the places up to some cells from the goal, along its axes."""
    value, origin = push_value(grid, r, goal, yaw)
    column, row = np.round(-origin / grid.cell).astype(int)
    assert reach <= min(column, row) <= max(column, row) < value.shape[1] - reach
    return value[:, row - reach : row + reach + 1, column - reach : column + reach + 1]


@pytest.mark.parametrize("yaw", [*YAWS, -2.0])
@pytest.mark.parametrize("make", [request, round_request])
def test_in_the_open_the_goals_heading_changes_nothing_in_its_frame(make, yaw):
    grid, goal = make_grid(), np.array([0.13, -0.27])
    value = around_goal(grid, make(), goal, yaw)
    np.testing.assert_allclose(value, around_goal(grid, make(), goal, 0.0), atol=1e-6)
    axis = 0.1 * np.arange(-10, 11)
    straight = np.hypot(axis, axis[:, None])
    assert (value >= straight - 1e-6).all()
    # two sides and a way around between them; without a way it would be three times as far
    assert (value.min(axis=0) < 1.5 * straight + 0.8).all()


@pytest.mark.parametrize("yaw", [*YAWS[1:], np.pi / 2, -2.0])
def test_a_turn_of_the_whole_scene_changes_nothing_in_the_goals_frame(yaw):
    r = request(inflation=0.2345, half_size=(0.16, 0.27), width=0.19, length=0.31)  # nothing halfway between two cells
    found = []
    for turn in (0.0, yaw):
        c, s = math.cos(turn), math.sin(turn)
        wall = block(yaw=0.3 + turn, size=(0.3, 0.7, 0.4), position=(0.5 * c - 0.3 * s, 0.5 * s + 0.3 * c))
        goal = np.array([-0.32 * c - 0.14 * s, -0.32 * s + 0.14 * c])
        found.append(around_goal(make_grid(wall), r, goal, 0.1 + turn))
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)
    assert np.abs(found[0] - around_goal(make_grid(), r, goal, 0.0)).max() > 1.0


def test_where_no_push_leads_to_the_goal_it_stays_finite():
    sides = [block(n, size=(0.1, 1.0, 0.4), position=(x, 0.0)) for n, x in (("left", -0.4), ("right", 0.4))]
    ends = [block(n, size=(0.9, 0.1, 0.4), position=(0.0, y)) for n, y in (("top", 0.45), ("bottom", -0.45))]
    grid = make_grid(*sides, *ends)
    value, _ = push_value(grid, request(inflation=0.15), np.zeros(2), 0.3)
    moved, _ = grid.turned(np.zeros(2), 0.3)
    free = moved.clearance >= 0.15
    straight = np.linalg.norm(moved.points, axis=-1)
    outside = free & (straight > 0.5)
    np.testing.assert_allclose(value[:, outside], np.tile(3.0 * straight[outside], (16, 1)))
    assert np.isfinite(value).all()


def test_a_box_that_overshot_towards_a_wall_is_much_dearer_than_one_that_stopped_short():
    goal = np.array([0.03, 0.1])
    for obstacles, trapped in (((block(size=(1.4, 0.2, 0.4), position=(0.0, 0.6)),), True), ((), False)):
        grid = make_grid(*obstacles, cell=0.05)
        value, _ = push_value(grid, request(), goal, 0.0)
        _, (column, row) = grid.turned(goal, 0.0)
        short, over = (value[:, row + k, column].min() for k in (-1, 1))
        assert short == pytest.approx(0.05, abs=1e-5)
        if trapped:
            assert over > short + 1.0
        else:
            assert over == pytest.approx(short)


def test_a_round_object_may_be_pushed_along_a_diagonal_and_a_box_needs_two_sides():
    goal = np.array([0.02, -0.13])
    grid = make_grid()
    _, (column, row) = grid.turned(goal, 0.0)
    cases = {"round": round_request(), "box": request(slant=100.0), "slant": request()}
    value = {name: push_value(grid, r, goal, 0.0)[0] for name, r in cases.items()}
    for d, (dx, dy) in enumerate(STEPS):
        place = row + 2 * dy, column + 2 * dx
        straight = 0.2 * math.hypot(dx, dy)
        assert value["round"][(d, *place)] == pytest.approx(straight, abs=1e-5)
        if d % 4 == 0:
            assert value["box"][(d, *place)] == pytest.approx(straight, abs=1e-5)
            # a push aslant saves the second side
            aslant = row + 2 * dy + dx, column + 2 * dx - dy
            assert value["slant"][(d, *aslant)] == pytest.approx(1.5 * 0.1 * math.sqrt(5.0), abs=1e-5)
            assert value["box"][:, *aslant].min() > 0.6
            continue
        # along one axis, a quarter of the way around, along the other
        quarter = value["box"][4, row, column + 1] - value["box"][0, row, column + 1]
        assert quarter > 0.3
        assert value["box"][:, *place].min() == pytest.approx(0.2 * (abs(dx) + abs(dy)) + quarter, abs=1e-5)


# the grid in the goal's frame


@pytest.mark.parametrize("yaw", [*YAWS, 3.0])
@pytest.mark.parametrize("point", [(0.137, -0.61), (0.0, 0.0), (-0.971, 0.33)])
def test_a_turned_grid_stands_in_the_frame_of_a_point_over_the_same_area(point, yaw):
    blocks = [block(yaw=0.5, size=(0.4, 0.8, 2.0)), block("post", size=(0.2, 0.2, 2.0), position=(-2.4, 0.2))]
    grid = make_grid(*blocks)
    before = grid.origin.copy(), grid.points.copy(), grid.clearance.copy()
    moved, (column, row) = grid.turned(np.array(point), yaw)
    rows, columns = moved.clearance.shape
    assert rows == columns == Grid.size(grid.clearance.shape)
    np.testing.assert_allclose(moved.points[row, column], point, atol=1e-12)
    np.testing.assert_allclose(moved.origin + moved.cell * np.array([column, row]), 0.0, atol=1e-12)

    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])  # world → the point's frame
    index = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    local = (moved.points - point) @ turn.T
    np.testing.assert_allclose(local, moved.origin + moved.cell * index, atol=1e-12)
    area = (grid.points - point) @ turn.T  # rounded to whole cells on either side
    assert (np.abs(area - local.mean(axis=(0, 1))) <= 0.5 * grid.cell * (columns - 1) + 0.5 * grid.cell).all()

    shapes = make_scene(obstacle=blocks).obstacle
    exact = [[min(signed_distance(o, tuple(p)) for o in shapes) for p in line] for line in moved.points[::4, ::4]]
    np.testing.assert_allclose(moved.clearance[::4, ::4], exact, atol=1e-6)
    for old, kept in zip(before, (grid.origin, grid.points, grid.clearance), strict=True):
        np.testing.assert_array_equal(old, kept)


@pytest.mark.parametrize(
    ("point", "yaw", "part"), [((9, 0), 0.0, (1, 0.5)), ((-9, 9), 0.0, (0, 1)), ((9, 0), np.pi / 2, (0.5, 0))]
)
def test_a_goal_outside_the_area_is_on_the_border_of_the_grid(point, yaw, part):
    moved, found = make_grid(block()).turned(np.array(point), yaw)
    np.testing.assert_allclose(found, np.array(part) * (len(moved.points) - 1), atol=1.0)
    np.testing.assert_allclose(moved.points[found[::-1]], point, atol=1e-12)
    value, origin = push_value(make_grid(block()), request(), np.array(point), yaw)
    assert np.isfinite(value).all()
    np.testing.assert_allclose(origin, -moved.cell * np.array(found), atol=1e-12)
    assert (value[:, found[1], found[0]] <= 2e-6).all()


def test_without_obstacles_there_is_nothing_near_anywhere():
    moved, _ = make_grid().turned(np.array([0.123, 0.456]), 0.3)
    assert np.isinf(moved.clearance).all()


# sampling


@wp.kernel
def side_kernel(
    # inputs
    angle: wp.array[float],
    # outputs
    side: wp.array[float],
):
    """The side of one direction."""
    i = wp.tid()
    side[i] = side_of(angle[i])


@wp.kernel
def sample_push_kernel(
    # inputs
    value: wp.array4d[float],
    origin: wp.vec2,
    cell: float,
    at: wp.array[wp.vec2],
    angle: wp.array[float],
    # outputs
    out: wp.array2d[float],
):
    """Sample one environment's value at one point and direction."""
    e, i = wp.tid()
    out[e, i] = sample_push(value, e, origin, cell, at[i], angle[i])


def side_at(angle, device: str) -> np.ndarray:
    """Fractional sides of directions [n]."""
    out = wp.zeros(len(angle), dtype=float, device=device)
    wp.launch(
        side_kernel,
        dim=len(angle),
        inputs=[wp.array(angle, dtype=float, device=device)],
        outputs=[out],
        device=device,
    )
    return out.numpy().astype(np.float64)


ORIGIN, CELL = (-1.5, 0.7), 0.25


def sample(value: np.ndarray, at, angle, device: str) -> np.ndarray:
    """Samples [E, n] of values [E, 16, rows, columns] at points [n, 2] and directions [n]."""
    out = wp.zeros((len(value), len(at)), dtype=float, device=device)
    inputs = [wp.array(value, dtype=float, device=device), wp.vec2(*ORIGIN), CELL]
    inputs += [wp.array(at, dtype=wp.vec2, device=device), wp.array(angle, dtype=float, device=device)]
    wp.launch(sample_push_kernel, dim=out.shape, inputs=inputs, outputs=[out], device=device)
    return out.numpy()


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 3])
def test_the_16_directions_have_whole_sides_and_those_between_go_on_evenly(turns, device):
    full = 2.0 * np.pi * turns
    error = side_at(ANGLES + full, device) - np.arange(16)
    np.testing.assert_allclose((error + 8.0) % 16.0 - 8.0, 0.0, atol=3e-5)
    angle = np.linspace(0.01, 2.0 * np.pi - 0.01, 1000)
    found = side_at(angle + full, device)
    assert (np.diff(found) > 0.0).all()
    assert np.diff(found).max() < 0.03
    np.testing.assert_allclose(found, np.interp(angle, [*ANGLES, 2.0 * np.pi], np.arange(17)), atol=1e-4)
    seam = side_at(np.array([-1e-3, 1e-3]) + full, device)
    np.testing.assert_allclose(seam, [16.0 - 1e-3 / ANGLES[1], 1e-3 / ANGLES[1]], atol=1e-4)


def test_at_cells_and_sides_a_sample_is_the_table(device):
    value = np.random.default_rng(0).normal(size=(2, 16, 4, 6))
    index = np.array(list(np.ndindex(16, 4, 6)))
    at = np.array(ORIGIN) + CELL * index[:, [2, 1]]
    found = sample(value, at, ANGLES[index[:, 0]], device)
    np.testing.assert_allclose(found, value.reshape(2, -1), atol=2e-5)


@pytest.mark.parametrize("seed", range(2))
def test_between_cells_and_sides_a_sample_is_linear_and_grows_outside_the_grid(seed, device):
    rng = np.random.default_rng(seed)
    value = rng.normal(size=(2, 16, 4, 6))
    low, high = np.array(ORIGIN), np.array(ORIGIN) + CELL * np.array([5, 3])
    at = rng.uniform(low - 1.0, high + 1.0, size=(300, 2))
    angle = rng.uniform(-7.0, 7.0, size=300)
    inside = np.clip(at, low, high)
    outside = np.linalg.norm(at - inside, axis=1)
    assert 30 < (outside == 0.0).sum() < 270
    sides = np.interp(angle % (2.0 * np.pi), [*ANGLES, 2.0 * np.pi], np.arange(17))
    cells = (inside - low) / CELL
    found = sample(value, at, angle, device)
    for e in range(2):
        axes = np.arange(17), np.arange(4), np.arange(6)
        table = RegularGridInterpolator(axes, np.concatenate([value[e], value[e, :1]]))
        expected = table(np.stack([sides, cells[:, 1], cells[:, 0]], axis=1)) + outside
        np.testing.assert_allclose(found[e], expected, atol=5e-5)


# the cost term

KEYS = {"term": "push_path", "pusher": "base/centre", "object": "box", "width": 0.2, "length": 0.3}
RADIUS = math.hypot(0.15, 0.25) + 0.1  # [m] within which the pusher is at the box
SAMPLES = 315


def pose(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, 0.1, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]


class Pushing:
    """Two environments of one step, with box and pusher put in place by hand."""

    def __init__(self, *costs: dict, obstacles=(), goals=((0.0, 0.0),), device: str = "cpu", **box):
        self.scene = make_scene(
            object=[{**BOX, "position": (0.8, 0.0, 0.1), **box}],
            obstacle=list(obstacles),
            goal={"object": "box", "position": (0.0, 0.0), "yaw": 0.0},
            cost=[{**KEYS, **cost} for cost in costs],
        )
        self.layout, self.device = compiled(self.scene).layout, device
        self.stack = CostStack(self.scene, self.layout, device=device)
        shape = Shape(2, SAMPLES, 1, 1)
        self.trajectory = Trajectory.allocate(shape, self.layout, 0, device)
        self.stack.attach(self.trajectory, wp.zeros((1, shape.worlds, 3), dtype=float, device=device), shape)
        self.aim(*(goals if len(goals) == 2 else 2 * goals))

    def aim(self, *goals) -> None:
        """Move the goals (x, y, yaw) of both environments."""
        poses = np.array([pose(*goal) for goal in goals])
        self.stack.set_goal(poses)
        self.stack.aim(poses)

    def values(self) -> np.ndarray:
        """Values of the first term ``[E, 16, rows, columns]``."""
        return self.stack._push_paths[0][0].value.numpy().copy()

    def cost(self, box, pusher) -> np.ndarray:
        """Cost ``[term, E, S]`` of boxes (x, y, yaw) and pushers (x, y), each for one, a sample or an environment."""
        body_q = np.zeros((2, 2, SAMPLES, self.layout.nb, 7), np.float32)
        body_q[..., 6] = 1.0
        for name, place in (("box", box), ("base/centre", pusher)):
            body = self.layout.frame_body[self.layout.frame(name)]
            body_q[..., body, :] = np.apply_along_axis(lambda p: pose(*p), -1, np.asarray(place, dtype=float))
        self.trajectory.body_q.assign(body_q.reshape(2, 2 * SAMPLES, -1, 7))
        self.stack.guide()
        self.stack.launch()
        return self.stack.cost.numpy()[:, 0].reshape(-1, 2, SAMPLES).astype(np.float64)


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
    tilted.stack.set_goal(poses)
    tilted.stack.aim(poses)
    rng = np.random.default_rng(0)
    box = rng.uniform([-0.8, -0.8, -3.0], [0.8, 0.8, 3.0], size=(SAMPLES, 3))
    places = box, box[:, :2] + rng.uniform(-1.0, 1.0, size=(SAMPLES, 2))
    np.testing.assert_allclose(tilted.cost(*places), upright.cost(*places), atol=1e-3)


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


def test_obstacles_between_pusher_and_object_make_the_way_longer(device):
    wall = block(size=(0.2, 1.2, 0.4), position=(0.9, 0.0))
    found = [Pushing({}, obstacles=o, device=device).cost((0.0, 0.0), (1.5, 0.1))[0, 0, 0] for o in ((), (wall,))]
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
        assert beside == pytest.approx(-math.copysign(0.3, error), abs=0.011)


@pytest.mark.parametrize("error", [0.25, -0.25, 0.8, -1.2])
@pytest.mark.parametrize(("size", "broad"), [((0.3, 0.5, 0.2), 0.0), ((0.5, 0.3, 0.2), np.pi / 2)])
def test_at_its_goal_a_turned_box_is_turned_back_from_a_broad_side(size, broad, error, device):
    pushing = Pushing({"steer": 0.5, "tolerance": 0.03}, device=device, size=size)
    angle = cheapest_angle(pushing, (0.0, 0.0), error) - error - broad  # in the box's frame, from a broad side
    beside = angle - np.pi * round(angle / np.pi)
    assert beside == pytest.approx(-math.copysign(0.4, error), abs=0.011)
    straight = Pushing({"tolerance": 0.03}, device=device, size=size)
    assert np.ptp(straight.cost((0.0, 0.0, error), around((0.0, 0.0), 0.3, np.linspace(-3, 3, SAMPLES)))) < 1e-5


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
    layout = compiled(scene).layout
    (stone,) = layout.entity("stone").shapes
    shapes = [replace(shape, kind="mesh") if i == stone else shape for i, shape in enumerate(layout.shapes)]
    with pytest.raises(SceneError, match=says) as caught:
        CostStack(scene, replace(layout, shapes=shapes))
    assert caught.value.key == f"cost.push_path{key}"
    assert caught.value.found == found
    if allowed:
        assert allowed in str(caught.value.allowed) or allowed in list(caught.value.allowed)
