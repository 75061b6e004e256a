# SPDX-License-Identifier: Apache-2.0
"""The run log: its columns are what plant and controller had, named, and the same when read back."""

import contextlib
import csv
import resource

import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, make_scene

import warpmpc
from warpmpc import RunLog, RunRecorder
from warpmpc.loop.log.writer import TABLES
from warpmpc.loop.run.episode import Episode

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


class Watched(RunRecorder):
    """Also keeps what the two say themselves, step by step."""

    def __init__(self, plant, controller):
        super().__init__(plant, controller)
        self.plant, self.controller, self.seen, self.plans = plant, controller, [], []

    def log(self, control):
        super().log(control)
        plant, info = self.plant, self.controller.info
        self.seen.append((control.copy(), plant.state, plant.body_q, plant.forces.copy(), info))
        self.plans.append(self.controller.newest_plan)


@pytest.fixture(scope="module")
def watched() -> Watched:
    scene = make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = Watched(episode.plant, episode.controller)
    episode.run(recorder=recorder)
    return recorder


@pytest.fixture(scope="module")
def log(watched) -> RunLog:
    return watched.run_log


def test_arrays_are_what_was_there_at_each_step(watched, log):
    assert len(watched.seen) == STEPS
    layout, states = watched.plant.layout, log.states
    np.testing.assert_array_equal(states.joint_q[0], layout.joint_q)
    np.testing.assert_allclose(states.time, 0.04 * np.arange(STEPS + 1))
    for n, (control, state, body_q, force, info) in enumerate(watched.seen):
        np.testing.assert_array_equal(log.controls.control[n], control)
        np.testing.assert_array_equal(states.joint_q[n + 1], state.joint_q)
        np.testing.assert_array_equal(states.joint_qd[n + 1], state.joint_qd)
        np.testing.assert_array_equal(states.body_q[n + 1], body_q)
        np.testing.assert_array_equal(states.contact_force[n + 1], force)
        assert dict(zip(log.names["terms"], log.of_plans("terms")[n], strict=True)) == pytest.approx(info.terms)
        assert (log.of_plans("cost")[n], log.controls.plan_ms[n]) == (info.cost, info.plan_ms)
        assert (log.plans.beta[n], log.plans.eta[n]) == (info.beta, info.eta)
    assert np.isnan(states.contact_force[0]).all()
    for n, plan in enumerate(watched.plans):
        np.testing.assert_array_equal(log.plans.knots[n], plan.knots)
        np.testing.assert_array_equal(log.plans.knot_time[n], plan.times)
        np.testing.assert_allclose(plan.at(log.plans.time[n]), log.plans.command[n], atol=1e-6)


def test_names_say_which_number_is_which(log):
    at = log.columns()
    fall = np.diff(at["joint_q/box/z"])
    assert at["joint_q/box/z"][0] == pytest.approx(2.0)
    assert fall[-1] < fall[0] < 0.0
    np.testing.assert_allclose(at["joint_qd/box/vz"][1:-1], 0.5 * (fall[1:] + fall[:-1]) / 0.04, rtol=0.1)
    np.testing.assert_array_equal(at["joint_q/box/z"], at["body_q/box/z"])
    np.testing.assert_array_equal(at["joint_q/base/x"], at["body_q/base/base_link/x"])
    assert at["joint_q/box/qw"] == pytest.approx(np.ones(STEPS + 1), abs=1e-3)
    assert at["joint_qd/box/wy"] == pytest.approx(np.zeros(STEPS + 1), abs=1e-2)


def test_forces_are_on_the_first_of_a_pair(log):
    """The disc is driven into a wall before it, which pushes it back."""
    force = log.columns()["contact_force/base-wall/x"]
    assert np.nanmin(force) < -1.0
    assert np.nanmax(force) <= 0.0


def test_a_term_may_have_any_name(log):
    at = log.columns()
    np.testing.assert_allclose(at["cost/distance"] + at["cost/total"], at["cost"], rtol=1e-5)
    assert at["cost/total"][0] != at["cost"][0]


def test_a_csv_file_has_a_column_for_each_number_and_nothing_where_there_is_none(log, tmp_path):
    log.save(tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = log.columns()
    assert list(rows[0]) == list(columns)
    for name, column in columns.items():
        found = [np.nan if row[name] == "" else float(row[name]) for row in rows]
        np.testing.assert_allclose(found, column, rtol=1e-8)
    assert {name for name in columns if rows[-1][name] == ""} == {
        name
        for name in columns
        if name.split("/")[0] in ("control", "cost", "plan_ms", "beta", "eta", "proposer", "lowered")
    }


@pytest.mark.parametrize("name", ["a.npz", "a.runlog"])
def test_a_file_is_read_back_as_it_was(log, tmp_path, name):
    log.save(tmp_path / name)
    again = warpmpc.RunLog.load(tmp_path / name)
    assert (again.names, again.origin) == (log.names, log.origin)
    for table, columns in TABLES.items():
        found, there = getattr(again, table), getattr(log, table)
        assert len(found) == len(there)
        for column in columns:
            assert (column in (found.dtype.names or ())) == (column in (there.dtype.names or ()))
            if column in (there.dtype.names or ()):
                np.testing.assert_array_equal(found[column], there[column])
                assert found[column].dtype == there[column].dtype


def test_how_far_the_goal_is_belongs_to_states(watched, log):
    np.testing.assert_array_equal(log.states.goal_error[-1], [watched.plant.error.position])
    assert log.names["errors"] == ["position"]
    assert log.columns()["goal_error/position"][0] == pytest.approx(np.hypot(1.0, 0.5))


def test_other_files_are_refused(log, tmp_path):
    with pytest.raises(ValueError, match=r"is a \.csv, \.npz or \.runlog file, not"):
        log.save(tmp_path / "a.xlsx")
    np.savez(tmp_path / "b.npz", x=np.zeros(3))
    (tmp_path / "c.npz").write_text("text")
    (tmp_path / "d.runlog").write_text('{"format": "warpmpc run log 7"}\n')
    for name in ("b.npz", "c.npz", "d.runlog"):
        with pytest.raises(ValueError, match=f"{name}: is no run log"):
            RunLog.load(tmp_path / name)


def test_a_run_without_a_step_has_a_state_and_no_plan():
    scene = make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = RunRecorder(episode.plant, episode.controller)
    log = recorder.run_log
    assert log.states.joint_q.shape == (1, episode.plant.layout.nq)
    assert log.controls.control.shape == (0, episode.plant.layout.nu)
    assert log.plans.terms.shape == (0, 2)
    assert {len(column) for column in log.columns().values()} == {1}
    with pytest.raises(ValueError, match="log comes after"):
        recorder.log(np.zeros(3))


def test_files_that_are_cut_off_or_damaged_are_refused(log, tmp_path):
    log.save(tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    cut = [whole[: len(whole) * part // 8] for part in range(8)]
    rng = np.random.default_rng(0)
    flipped = [bytearray(whole) for _ in range(60)]
    for data in flipped:
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    for data in [*cut, *flipped]:
        (tmp_path / "a.npz").write_bytes(data)
        refused = pytest.raises(ValueError, match=r"a\.npz: is no run log")
        # a bit of what nobody reads does not matter
        with refused if len(data) < len(whole) else contextlib.suppress(ValueError):
            RunLog.load(tmp_path / "a.npz")


def test_a_run_that_is_killed_loses_the_row_it_was_writing_and_no_other(log, tmp_path):
    log_file, scene = tmp_path / "a.runlog", make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = RunRecorder(episode.plant, episode.controller, path=log_file)

    def killed(controller, plant, control):
        if plant.steps == 7:
            raise RuntimeError("killed")

    with contextlib.suppress(RuntimeError):
        episode.run(recorder=recorder, on_step=killed)
    assert len(RunLog.load(log_file).controls) == 7
    log_file.write_bytes(log_file.read_bytes()[:-9])
    left = RunLog.load(log_file)
    assert (len(left.states), len(left.controls), len(left.plans)) == (7, 6, 7)
    np.testing.assert_array_equal(left.states.joint_q, log.states.joint_q[:7])

    whole = bytearray(log_file.read_bytes())
    whole[-1000] ^= 1  # in a whole row
    log_file.write_bytes(whole)
    with pytest.raises(ValueError, match=r"a\.runlog: is no run log: it is damaged at byte"):
        RunLog.load(log_file)


def test_where_a_disk_is_full_the_log_ends_and_not_the_run(tmp_path, caplog):
    scene = make_scene(**SCENE)
    episode = Episode(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    recorder = RunRecorder(episode.plant, episode.controller, path=tmp_path / "a.runlog")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "a.runlog").stat().st_size + 3000, hard))
    try:
        result = episode.run(recorder=recorder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert result.steps == STEPS
    (message,) = caplog.messages
    assert "a.runlog': " in message
    assert 0 < len(RunLog.load(tmp_path / "a.runlog").controls) < STEPS


@pytest.mark.parametrize("name", ["a.npz", "a.csv", "a.runlog"])
def test_a_disk_that_is_full_leaves_the_file_that_was_there(log, tmp_path, name):
    (tmp_path / "elsewhere").mkdir()
    log.save(tmp_path / "elsewhere" / name)
    (tmp_path / name).symlink_to(tmp_path / "elsewhere" / name)
    before = (tmp_path / name).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            log.save(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / name).read_bytes() == before
    log.save(tmp_path / name)
    assert (tmp_path / name).is_symlink()
    assert sorted(file.name for file in tmp_path.rglob("*")) == sorted([name, "elsewhere", name])
