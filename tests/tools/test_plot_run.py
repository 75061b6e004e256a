# SPDX-License-Identifier: Apache-2.0
"""Pictures of runs: shapes have their size, the near hides the far, curves have names, any scene and term is drawn."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import plot_run
import pytest
import warp as wp
from plot_run import draw_curves
from program import SCENE, TINY
from scene_picture import VIEWS, ScenePicture, View, natural_view, oblique, triangles_of
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc.model.layout import ShapeInfo
from warpmpc.plant.simulated import Plant
from warpmpc.record.history import History

TERMS = """
import numpy as np
import warpmpc


@warpmpc.array_cost("effort")
def effort(batch):
    return np.square(batch["control"]).sum(axis=-1)
"""


@pytest.fixture(autouse=True)
def as_loud_as_before(monkeypatch):
    """The tool silences Warp."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)


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


def test_every_curve_has_a_name_of_its_own():
    names = {"joint_q": (), "joint_qd": (), "body": (), "control": (), "term": ("near", "far"), "pair": ("a-b", "c-b")}
    history = History(
        time=np.arange(4.0),
        joint_q=np.zeros((4, 0)),
        joint_qd=np.zeros((4, 0)),
        body_q=np.zeros((4, 0, 7)),
        contact_force=np.arange(24.0).reshape(4, 2, 3),
        control=np.zeros((3, 0)),
        cost=np.array([3.0, 4.0, 5.0]),
        cost_terms=np.array([[1.0, 2.0], [1.0, 3.0], [1.0, 4.0]]),
        plan_ms=np.ones(3),
        **{f"{name}_names": value for name, value in names.items()},
    )
    figure, (costs, forces) = plt.subplots(2)
    draw_curves(costs, forces, history)
    curves = {line.get_label(): line.get_ydata() for line in (*costs.lines, *forces.lines)}
    plt.close(figure)
    np.testing.assert_array_equal(curves["far"], [2.0, 3.0, 4.0])
    np.testing.assert_array_equal(curves["sum"], history.cost)
    np.testing.assert_allclose(curves["c-b"][1], np.linalg.norm([9.0, 10.0, 11.0]))


@pytest.mark.parametrize("view", [[], ["--view", "3d", "--curves"]])
def test_a_scene_and_terms_of_ones_own_are_drawn(tmp_path, view):
    (tmp_path / "terms.py").write_text(TERMS)
    (tmp_path / "mine.toml").write_text(SCENE.replace("[planner]", '[[cost]]\nterm = "effort"\n\n[planner]'))
    out = tmp_path / "new" / "a.png"
    args = [str(tmp_path / "mine.toml"), "--terms", str(tmp_path / "terms.py"), "--engine", "mujoco", *TINY]
    assert plot_run.main([*args, *view, "--out", str(out)]) == 0
    assert plt.imread(out)[..., :3].std() > 0.02


def test_a_mistake_is_one_message_and_exit_code_2(tmp_path, capsys):
    assert plot_run.main(["omni_push_bax", "--out", str(tmp_path / "a.png")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Did you mean 'omni_push_box'?" in err
    assert err.count("\n") == 1
