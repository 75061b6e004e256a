# SPDX-License-Identifier: Apache-2.0
"""Pictures of runs: meshes have their shapes' size, curves have names, any scene and term is drawn."""

from dataclasses import replace

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from run_logs import changed
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc import Plant, RunLog, RunRecorder
from warpmpc.extras.record.plots import figures, plot_log
from warpmpc.extras.record.shapes import mesh_of
from warpmpc.loop.run.episode import Episode
from warpmpc.scene.model.layout import ShapeInfo


@pytest.fixture(scope="module")
def plant() -> Plant:
    scene = make_scene(object=[{**BOX, "color": (0.1, 0.2, 0.9)}], robot=[DISC])
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
    shape = ShapeInfo("s", "box", 0, kind, (0.0,) * 6 + (1.0,), scale)
    local = mesh_of(shape, plant.layout, fine=False).triangles
    signed = np.linalg.det(local).sum() / 6.0  # above zero if all corners are counter-clockwise from outside
    assert signed == pytest.approx(volume, rel=0.08)
    a, b, _ = scale
    length = {"box": 0.3, "ellipsoid": 0.1, "sphere": a, "capsule": a + b}.get(kind, b)
    assert (local[..., 2].min(), local[..., 2].max()) == pytest.approx((-length, length), rel=0.02)


def test_a_plane_has_no_mesh(plant):
    plane = ShapeInfo("s", "ground", -1, "plane", (0.0,) * 6 + (1.0,), (0.0, 0.0, 0.0))
    assert mesh_of(plane, plant.layout) is None


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


def test_every_body_has_its_way_from_above(log):
    figure = dict(figures(log, None))["path"]
    ways = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    assert list(ways) == list(log.names["bodies"])
    base = log.names["bodies"].index("base/base_link")
    np.testing.assert_array_equal(ways["base/base_link"], log.states.body_q[:, base, :2])


def test_files_are_written(log, tmp_path):
    written = plot_log(log, tmp_path / "new", title="a run")
    assert [path.name for path in written] == [
        "history.csv",
        *(f"{name}.png" for name in ("path", "costs", "controls", "plan_times", "errors", "foresight")),
    ]
    for path in written[1:]:
        assert plt.imread(path)[..., :3].std() > 0.02
    assert (tmp_path / "new" / "history.csv").read_text().startswith("time,joint_q/")


def test_titles_tell_figures_apart(log, tmp_path, monkeypatch):
    titles = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: titles.append(self.axes[0].get_title()))
    plot_log(log, tmp_path, title="a run")
    assert len(set(titles)) == len(titles) > 4
    assert "a run: plan times" in titles


@pytest.mark.parametrize(("peaks", "scale"), [((1.0, 3.0), "linear"), ((1.0, 1e3), "symlog"), ((0.0, 1e3), "linear")])
def test_no_term_hides_the_others(log, peaks, scale):
    terms = np.tile([peaks[0], 0.0], (len(log.plans), 1))
    terms[2, 1] = peaks[1]  # for a moment
    changed_log = replace(log, plans=changed(log.plans, terms=terms), names={**log.names, "terms": ["small", "large"]})
    axes = dict(figures(changed_log, None))["costs"].axes[0]
    assert axes.get_yscale() == scale
