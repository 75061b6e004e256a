# SPDX-License-Identifier: Apache-2.0
"""A run as arrays: they are what plant and controller had, named, and the same when read back."""

import contextlib
import csv
import resource
from dataclasses import fields

import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, make_scene

import warpmpc
from warpmpc.record.history import History, HistoryRecorder
from warpmpc.run.episode import Episode

STEPS = 12
SCENE = {
    "timing": {"control_dt": 0.04, "timeout": STEPS * 0.04},
    "object": [{**BOX, "position": (1.5, 0.0, 2.0)}],  # it falls
    "obstacle": [{**WALL, "position": (0.32, 0.0, 0.2)}],  # which the disc is driven into
    "cost": [
        {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
        {"term": "distance", "name": "total", "between": ["base/centre", "box"], "weight": 0.5},
    ],
    "planner": {"samples": 16, "horizon": 4},
}


class Watched(HistoryRecorder):
    """Also keeps what the two say themselves, step by step."""

    def __init__(self, controller, plant):
        super().__init__(controller, plant)
        self.plant, self.controller, self.seen = plant, controller, []

    def log(self, control):
        super().log(control)
        plant, info = self.plant, self.controller.info
        self.seen.append((control.copy(), plant.state, plant.body_q, plant.forces.copy(), info))


@pytest.fixture(scope="module")
def watched() -> Watched:
    scene = make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = Watched(episode.controller, episode.plant)
    episode.run(recorder=recorder)
    return recorder


@pytest.fixture(scope="module")
def history(watched) -> History:
    return watched.history


def test_arrays_are_what_was_there_at_each_step(watched, history):
    assert len(watched.seen) == STEPS
    layout = watched.plant.layout
    np.testing.assert_array_equal(history.joint_q[0], layout.joint_q)
    np.testing.assert_allclose(history.time, 0.04 * np.arange(STEPS + 1))
    for n, (control, state, body_q, force, info) in enumerate(watched.seen):
        np.testing.assert_array_equal(history.control[n], control)
        np.testing.assert_array_equal(history.joint_q[n + 1], state.joint_q)
        np.testing.assert_array_equal(history.joint_qd[n + 1], state.joint_qd)
        np.testing.assert_array_equal(history.body_q[n + 1], body_q)
        np.testing.assert_array_equal(history.contact_force[n + 1], force)
        assert dict(zip(history.term_names, history.cost_terms[n], strict=True)) == pytest.approx(info.terms)
        assert (history.cost[n], history.plan_ms[n]) == (info.cost, info.plan_ms)
        assert (history.beta[n], history.eta[n]) == (info.beta, info.eta)
    assert np.isnan(history.contact_force[0]).all()


def test_names_say_which_number_is_which(history):
    at = history.columns()
    fall = np.diff(at["joint_q/box/z"])
    assert at["joint_q/box/z"][0] == pytest.approx(2.0)
    assert fall[-1] < fall[0] < 0.0
    np.testing.assert_allclose(at["joint_qd/box/vz"][1:-1], 0.5 * (fall[1:] + fall[:-1]) / 0.04, rtol=0.1)
    np.testing.assert_array_equal(at["joint_q/box/z"], at["body_q/box/z"])
    np.testing.assert_array_equal(at["joint_q/base/x"], at["body_q/base/base_link/x"])
    assert at["joint_q/box/qw"] == pytest.approx(np.ones(STEPS + 1), abs=1e-3)
    assert at["joint_qd/box/wy"] == pytest.approx(np.zeros(STEPS + 1), abs=1e-2)


def test_forces_are_on_the_first_of_a_pair(history):
    """The disc is driven into a wall before it, which pushes it back."""
    force = history.columns()["contact_force/base-wall/x"]
    assert np.nanmin(force) < -1.0
    assert np.nanmax(force) <= 0.0


def test_a_term_may_have_any_name(history):
    at = history.columns()
    np.testing.assert_allclose(at["cost/distance"] + at["cost/total"], at["cost"], rtol=1e-5)
    assert at["cost/total"][0] != at["cost"][0]


def test_a_csv_file_has_a_column_for_each_number_and_nothing_where_there_is_none(history, tmp_path):
    history.save(tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = history.columns()
    assert list(rows[0]) == list(columns)
    for name, column in columns.items():
        found = [np.nan if row[name] == "" else float(row[name]) for row in rows]
        np.testing.assert_allclose(found, column, rtol=1e-8)
    assert {name for name in columns if rows[-1][name] == ""} == {
        name for name in columns if name.split("/")[0] in ("control", "cost", "plan_ms", "beta", "eta")
    }


def test_an_npz_file_is_read_back_as_it_was(history, tmp_path):
    history.save(tmp_path / "a.npz")
    again = warpmpc.History.load(tmp_path / "a.npz")
    assert again.log.to_arrays().keys() == history.log.to_arrays().keys()
    for field in fields(History):
        if field.name == "log":  # tests/record/test_replay.py
            continue
        np.testing.assert_array_equal(getattr(again, field.name), getattr(history, field.name))
        assert type(getattr(again, field.name)) is type(getattr(history, field.name))


def test_files_of_older_versions_are_read_without_what_they_lack(history, tmp_path):
    history.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as data:
        later = ("beta", "eta", "goal_error", "error_names")
        old = {name: data[name] for name in data if name not in later and not name.startswith("log_")}
    np.savez(tmp_path / "old.npz", **old)
    again = warpmpc.History.load(tmp_path / "old.npz")
    np.testing.assert_array_equal(again.joint_q, history.joint_q)
    assert again.log is None
    assert again.error_names == ()
    assert np.isnan(again.beta).all()
    assert again.columns().keys() == {name for name in history.columns() if not name.startswith("goal_error")}


def test_how_far_the_goal_is_belongs_to_states(watched, history):
    np.testing.assert_array_equal(history.goal_error[-1], [watched.plant.error.position])
    assert history.error_names == ("position",)
    assert history.columns()["goal_error/position"][0] == pytest.approx(np.hypot(1.0, 0.5))


def test_other_files_are_refused(history, tmp_path):
    with pytest.raises(ValueError, match=r"is a \.csv or \.npz file, not"):
        history.save(tmp_path / "a.xlsx")
    np.savez(tmp_path / "b.npz", x=np.zeros(3))
    (tmp_path / "c.npz").write_text("text")
    for name in ("b.npz", "c.npz"):
        with pytest.raises(ValueError, match=f"{name}: is no history"):
            History.load(tmp_path / name)


def test_a_run_without_a_step_has_a_state_and_no_plan():
    scene = make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = HistoryRecorder(episode.controller, episode.plant)
    history = recorder.history
    assert history.joint_q.shape == (1, episode.plant.layout.nq)
    assert history.control.shape == (0, episode.plant.layout.nu)
    assert history.cost_terms.shape == (0, 2)
    assert {len(column) for column in history.columns().values()} == {1}
    with pytest.raises(ValueError, match="log comes after"):
        recorder.log(np.zeros(3))


def test_files_that_are_cut_off_or_damaged_are_refused(history, tmp_path):
    history.save(tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    cut = [whole[: len(whole) * part // 8] for part in range(8)]
    rng = np.random.default_rng(0)
    flipped = [bytearray(whole) for _ in range(60)]
    for data in flipped:
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    for data in [*cut, *flipped]:
        (tmp_path / "a.npz").write_bytes(data)
        refused = pytest.raises(ValueError, match=r"a\.npz: is no history")
        # a bit of what nobody reads does not matter
        with refused if len(data) < len(whole) else contextlib.suppress(ValueError):
            History.load(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.npz", "a.csv"])
def test_a_disk_that_is_full_leaves_the_file_that_was_there(history, tmp_path, name):
    (tmp_path / "elsewhere").mkdir()
    history.save(tmp_path / "elsewhere" / name)
    (tmp_path / name).symlink_to(tmp_path / "elsewhere" / name)
    before = (tmp_path / name).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            history.save(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / name).read_bytes() == before
    history.save(tmp_path / name)
    assert (tmp_path / name).is_symlink()
    assert sorted(file.name for file in tmp_path.rglob("*")) == sorted([name, "elsewhere", name])
