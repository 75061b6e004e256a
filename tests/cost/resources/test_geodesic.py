# SPDX-License-Identifier: Apache-2.0
"""Path lengths around obstacles against exact ones."""

import math

import numpy as np
import pytest
import warp as wp
from small_scenes import compiled, make_scene
from ways import INFLATION, around_corners

from warpmpc.cost.resources.geodesic import Grid
from warpmpc.cost.resources.guide import FieldRequest, Guide


def wall(name="wall", *, size=(0.4, 2.0, 0.5), position=(0.0, 0.0, 0.25), yaw=0.0) -> dict:
    rotation = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return {"name": name, "shape": "box", "size": size, "position": position, "rotation": rotation}


def make_grid(*obstacles: dict, cell: float = 0.05, reach: float = 3.0) -> Grid:
    layout = compiled(make_scene(obstacle=obstacles)).layout
    return Grid(layout, np.array([[-reach, -reach], [reach, reach]]), cell=cell)


def path_length(grid: Grid, target: np.ndarray, inflation: float) -> np.ndarray:
    """Field of path lengths to a goal, ``[rows, columns]``."""
    layout = compiled(make_scene()).layout
    guide = Guide(grid, [FieldRequest(layout.frame("goal"), inflation)], layout, envs=1, device="cpu")
    goal = wp.array([[*target, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=wp.transform, device="cpu")
    guide.launch(wp.zeros((1, layout.nb), dtype=wp.transform, device="cpu"), goal.reshape((1, 1)))
    return guide.field.numpy()[0]


def at(grid: Grid, field: np.ndarray, p) -> float:
    """Bilinear value of a field at a point."""
    from scipy.interpolate import RegularGridInterpolator

    axes = (grid.points[:, 0, 1], grid.points[0, :, 0])
    return float(RegularGridInterpolator(axes, field)(np.asarray(p)[::-1])[0])


@pytest.mark.parametrize(("x", "y"), [(1.0, 0.8), (1.5, 0.3), (2.0, 0.9)])
def test_the_way_around_a_box_corner_is_as_long_as_it_must_be(x, y):
    grid = make_grid(wall())
    target, start = np.array([-1.2, 0.4]), np.array([x, y])
    field = path_length(grid, target, INFLATION)
    exact = around_corners(target, start, [(-0.2, 1.0), (0.2, 1.0)], INFLATION)
    assert exact > np.linalg.norm(start - target) + 0.2
    assert at(grid, field, start) == pytest.approx(exact, abs=1.5 * grid.cell)


def test_finer_cells_come_closer():
    target, start = np.array([-1.2, 0.4]), np.array([1.5, 0.3])
    exact = around_corners(target, start, [(-0.2, 1.0), (0.2, 1.0)], INFLATION)
    error = []
    for cell in (0.1, 0.025):
        grid = make_grid(wall(), cell=cell)
        error.append(abs(at(grid, path_length(grid, target, INFLATION), start) - exact))
    assert error[1] < 0.5 * error[0]


@pytest.mark.parametrize("seed", range(2))
def test_in_the_open_a_path_is_a_straight_line(seed):
    rng = np.random.default_rng(seed)
    grid = make_grid(wall())
    target = np.array([-1.5, 0.2])
    field = path_length(grid, target, INFLATION)
    for p in rng.uniform([-2.9, -2.9], [-0.5, 2.9], size=(40, 2)):
        assert at(grid, field, p) == pytest.approx(np.linalg.norm(p - target), abs=grid.cell)


def test_without_obstacles_every_path_is_straight():
    grid = make_grid()
    target = np.array([0.3, -0.4])
    field = path_length(grid, target, INFLATION)
    np.testing.assert_allclose(field, np.linalg.norm(grid.points - target, axis=-1), atol=1.5 * grid.cell)


@pytest.mark.parametrize(
    ("obstacle", "inside", "outside"),
    [
        (wall(yaw=0.6), (0.0, 0.0), (0.6, 0.6)),
        ({"name": "can", "shape": "cylinder", "size": (0.4, 1.0)}, (0.39, 0.0), (0.41, 0.0)),
        ({"name": "ball", "shape": "sphere", "size": (0.4,)}, (0.27, 0.27), (0.3, 0.3)),
        (
            {"name": "log", "shape": "capsule", "size": (0.2, 1.0), "rotation": (0.0, 0.7071, 0.0, 0.7071)},
            (0.65, 0.0),
            (0.75, 0.0),
        ),
    ],
)
def test_clearance_is_the_distance_to_the_outline_seen_from_above(obstacle, inside, outside):
    grid = make_grid(obstacle, reach=1.5, cell=0.02)
    assert at(grid, grid.clearance, inside) < 0.0 < at(grid, grid.clearance, outside)
    far = np.array([1.4, 1.4])
    if obstacle["shape"] in ("cylinder", "sphere"):
        assert at(grid, grid.clearance, far) == pytest.approx(np.linalg.norm(far) - 0.4, abs=0.01)


@pytest.mark.parametrize("target", [(0.1, 0.95), (0.0, 0.0), (-0.3, 0.0), (0.25, -1.1)])
def test_a_target_inside_a_grown_obstacle_is_still_reached_from_everywhere(target):
    """Going downhill from anywhere leads to the target, through no local minimum."""
    grid = make_grid(wall())
    field = path_length(grid, np.array(target), INFLATION)
    assert np.isfinite(field).all()
    for start in [(2.5, 0.0), (-2.5, 0.0), (0.0, 2.5), (1.0, -2.0)]:
        column, row = np.round((np.array(start) - grid.origin) / grid.cell).astype(int)
        for _ in range(500):
            around = field[row - 1 : row + 2, column - 1 : column + 2]
            down = np.unravel_index(around.argmin(), (3, 3))
            if down == (1, 1):
                break
            row, column = row + down[0] - 1, column + down[1] - 1
        assert np.linalg.norm(grid.points[row, column] - target) < 2.0 * grid.cell


def test_a_target_in_the_margin_of_a_wall_is_near_on_its_side_alone():
    grid = make_grid(wall())
    field = path_length(grid, np.array([-0.22, 0.0]), INFLATION)
    assert at(grid, field, (-2.0, 0.0)) == pytest.approx(1.78, abs=2.0 * grid.cell)
    assert at(grid, field, (-1.0, 1.0)) == pytest.approx(math.hypot(0.78, 1.0), abs=3.0 * grid.cell)
    # around a corner of the wall, not through it
    assert at(grid, field, (1.5, 0.0)) > 2.5


def test_a_grown_obstacle_holds_a_hill_that_leads_out():
    grid = make_grid(wall())
    field = path_length(grid, np.array([-1.5, 0.0]), INFLATION)
    # from its middle the way out to the target's side is downhill
    values = [at(grid, field, (x, 0.0)) for x in (0.0, -0.1, -0.2, -0.3, -0.45)]
    assert np.all(np.diff(values) < 0.0)


def test_an_unreachable_target_leaves_the_field_finite():
    walls = [
        wall("a", size=(2.0, 0.2, 0.4), position=(1.0, 1.0, 0.2)),
        wall("b", size=(2.0, 0.2, 0.4), position=(1.0, -1.0, 0.2)),
        wall("c", size=(0.2, 2.0, 0.4), position=(0.1, 0.0, 0.2)),
        wall("d", size=(0.2, 2.0, 0.4), position=(1.9, 0.0, 0.2)),
    ]
    grid = make_grid(*walls)
    for target in ((1.0, 0.0), (-1.0, 0.0)):
        assert np.isfinite(path_length(grid, np.array(target), 0.1)).all()
