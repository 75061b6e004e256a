# SPDX-License-Identifier: Apache-2.0
"""Pictures of runs: shapes have their size, the near hides the far, curves have names, any scene and term is drawn."""

from dataclasses import replace

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from run_logs import changed
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc.log.run_log import RunLog
from warpmpc.model.layout import ShapeInfo
from warpmpc.plant.plant import Plant
from warpmpc.record.plots import draw_run, figures, plot_log
from warpmpc.record.run_recorder import RunRecorder
from warpmpc.record.scene_picture import VIEWS, ScenePicture, View, natural_view, oblique, triangles_of
from warpmpc.run.episode import Episode


@pytest.fixture(scope="module")
def plant() -> Plant:
    scene = make_scene(object=[BOX], robot=[DISC])
    return Plant(scene, compiled=compiled(scene))


@pytest.mark.parametrize(
    ("kind", "scale", "volume"),
    [
        ("box", (0.1, 0.2, 0.3), 8 * 0.006),
        ("sphere", (0.5, 0.0, 0.0), 4 / 3 * np.pi * 0.125),
        ("ellipsoid", (0.5, 0.2, 0.1), 4 / 3 * np.pi * 0.01),
        ("capsule", (0.1, 0.3, 0.0), np.pi * 0.01 * (0.6 + 4 / 3 * 0.1)),
        ("cylinder", (0.1, 0.3, 0.0), np.pi * 0.01 * 0.6),
        ("cone", (0.1, 0.3, 0.0), np.pi * 0.01 * 0.6 / 3),
    ],
)
def test_a_shape_is_drawn_in_its_size_around_its_origin_and_seen_from_outside(plant, kind, scale, volume):
    turned = (1.0, 2.0, 3.0, 0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))  # z points to x
    shape = ShapeInfo("s", "box", 0, kind, turned, scale)
    corners = triangles_of(shape, plant.layout, hull=True)
    local = corners - [1.0, 2.0, 3.0]
    signed = np.linalg.det(local).sum() / 6.0  # above zero if all corners are counter-clockwise from outside
    assert signed == pytest.approx(volume, rel=0.08)
    a, b, _ = scale
    length = {"box": 0.3, "ellipsoid": 0.1, "sphere": a, "capsule": a + b}.get(kind, b)
    assert (local[..., 0].min(), local[..., 0].max()) == pytest.approx((-length, length), rel=0.02)


def test_a_plane_has_no_triangles(plant):
    plane = ShapeInfo("s", "ground", -1, "plane", (0.0,) * 6 + (1.0,), (0.0, 0.0, 0.0))
    assert triangles_of(plane, plant.layout, hull=True).shape == (0, 3, 3)


@pytest.mark.parametrize("name", VIEWS)
def test_a_view_keeps_lengths_across_it_and_shows_what_is_up(name):
    view = VIEWS[name]
    basis = np.array([view.right, view.up, view.towards])
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(basis) == pytest.approx(1.0)
    if name != "top":
        assert view(np.array([0.0, 0.0, 1.0]))[1] > 0.5
    np.testing.assert_allclose(oblique(0.0, 0.5 * np.pi).towards, [0.0, 0.0, 1.0], atol=1e-12)


def middle(plant: Plant, view: View) -> np.ndarray:
    """Colour ``[3]`` in the middle of a picture of the disc at the origin and the box before it on the x-axis."""
    figure, axes = plt.subplots(figsize=(2, 2), dpi=50)
    axes.set_position([0.0, 0.0, 1.0, 1.0])
    ScenePicture(axes, plant, view).solid(plant.body_q, ("object", "robot"))
    height = plant.body_q[plant.layout.body_name.index("base/base_link"), 2]
    axes.set_xlim(-0.05, 0.05)
    axes.set_ylim(height, height + 0.04)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0
    plt.close(figure)
    return pixels[50, 50]


def test_the_near_hides_the_far(plant):
    from_the_box = middle(plant, VIEWS["front"])
    from_the_disc = middle(plant, View((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), None))
    assert from_the_box[2] > from_the_box[0]  # blue
    assert from_the_disc[0] > from_the_disc[2]  # orange


def test_what_stays_level_is_seen_from_above(plant):
    way = np.tile(plant.body_q, (4, 1, 1))
    base = plant.layout.body_name.index("base/base_link")
    way[:, base, :2] = np.random.default_rng(0).normal(size=(4, 2))
    way[:, base, 3:] = [[0.0, 0.0, np.sin(yaw), np.cos(yaw)] for yaw in range(4)]
    assert natural_view(plant.layout, way) == "top"
    box = plant.layout.body_name.index("box")
    way[2, box, 2] += 1.0
    assert natural_view(plant.layout, way) == "top"
    tilted, risen = way.copy(), way.copy()
    tilted[3, base, 3:] = [np.sin(0.1), 0.0, 0.0, np.cos(0.1)]
    risen[3, base, 2] += 0.1
    assert natural_view(plant.layout, tilted) == natural_view(plant.layout, risen) == "3d"


@pytest.fixture(scope="module")
def log() -> RunLog:
    scene = make_scene(
        object=[BOX], robot=[DISC], timing={"control_dt": 0.04, "timeout": 0.4}, planner={"samples": 16, "horizon": 4}
    )
    episode = Episode(scene, engine="mujoco", device="cpu", seed=3, compiled=compiled(scene))
    recorder = RunRecorder(episode.plant, episode.controller)
    episode.run(recorder=recorder)
    return recorder.run_log


def lines(figure) -> dict[str, np.ndarray]:
    """Every line of a figure by its name."""
    return {line.get_label(): np.asarray(line.get_ydata()) for axes in figure.axes for line in axes.lines}


def test_figures_show_the_run(log):
    scene = make_scene(object=[BOX], robot=[DISC])
    found = dict(figures(log, scene))
    assert list(found) == ["path", "costs", "controls", "plan_times", "errors", "foresight"]
    errors = lines(found["foresight"])["state after 0.2 s"]
    assert len(errors)
    assert (errors >= 0.0).all()
    costs = lines(found["costs"])
    np.testing.assert_array_equal(costs["distance"], log.plans.terms[:, 0])
    np.testing.assert_array_equal(costs["sum"], log.plans.cost)
    times = lines(found["plan_times"])
    np.testing.assert_array_equal(times["plan"], log.controls.plan_ms)
    np.testing.assert_allclose(times["one control"], 40.0)
    for i, axes in enumerate(found["controls"].axes):
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), log.controls.control[:, i])
    error, tolerance = found["errors"].axes[0].lines
    np.testing.assert_array_equal(error.get_ydata(), log.states.goal_error[:, 0])
    np.testing.assert_allclose(tolerance.get_ydata(), 0.1)


def test_every_pair_has_a_curve_of_its_own(log):
    pairs = np.arange(33.0 * 2).reshape(11, 2, 3)
    names = {**log.names, "pairs": ["a-b", "c-b"]}
    found = dict(figures(replace(log, names=names, states=changed(log.states, contact_force=pairs)), None))
    np.testing.assert_allclose(lines(found["contact_forces"])["c-b"], np.linalg.norm(pairs[:, 1], axis=1))


@pytest.mark.parametrize("view", [None, "3d"])
def test_bodies_and_their_ways_are_drawn(log, plant, view):
    figure, axes = plt.subplots()
    draw_run(axes, log, plant, view=view)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0
    plt.close(figure)
    assert pixels.std() > 0.02
    base = log.names["bodies"].index("base/base_link")
    ways = [line.get_xydata() for line in axes.lines]
    expected = VIEWS[view or "top"](log.states.body_q[:, base, :3].astype(float))
    assert any(way.shape == expected.shape and np.allclose(way, expected) for way in ways)


def test_without_a_scene_the_ways_are_left(log):
    figure, axes = plt.subplots()
    draw_run(axes, log, None)
    assert {line.get_label() for line in axes.lines} == set(log.names["bodies"])
    plt.close(figure)


def test_files_are_written(log, tmp_path):
    written = plot_log(log, tmp_path / "new", title="a run")
    assert [path.name for path in written] == [
        "history.csv",
        *(f"{name}.png" for name in ("path", "costs", "controls", "plan_times", "errors", "foresight")),
    ]
    for path in written[1:]:
        assert plt.imread(path)[..., :3].std() > 0.02
    assert (tmp_path / "new" / "history.csv").read_text().startswith("time,joint_q/")
