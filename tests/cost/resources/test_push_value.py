# SPDX-License-Identifier: Apache-2.0
"""The least work to push an object to its goal, of every place and side: against plain value iteration."""

import math
import time

import numpy as np
import pytest
from push_scenes import YAWS, block, make_grid, request, round_request
from small_scenes import make_scene

from warpmpc.cost.resources.geodesic import Grid
from warpmpc.cost.resources.push_value import ANGLES, OBSTRUCTED, STEPS, PushRequest, Search, push_value
from warpmpc.scene.draw import signed_distance

GOALS = [(0.0, 0.0, 0.0), (0.13, -0.27, 0.7), (-0.342, 0.561, -2.0)]


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


def test_the_process_executes_nothing_of_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numpy.py").write_text("open('executed', 'w')")
    search = Search()
    search.begin(3, [])
    end = time.monotonic() + 120.0
    while not (done := search.finished()) and time.monotonic() < end:
        time.sleep(0.05)
    search.stop()
    assert done == [(3, [])]
    assert not (tmp_path / "executed").exists()
