# SPDX-License-Identifier: Apache-2.0
"""Data sets opened by h5py hold what the planner saw and did, and how it ended."""

import json
from dataclasses import replace

import numpy as np
import pytest
from needs import need
from run_logs import changed

from warpmpc.extras.export.data_sets import Hdf5DataSet, demonstration

ENDS = [(True, "goal reached"), (False, "timeout"), (False, "failed: fell"), (None, None)]
"""Success and reason of the episodes of a data set."""


@pytest.fixture
def episodes(log):
    return [demonstration(log, success=success, reason=reason) for success, reason in ENDS]


def filled(data_set, episodes):
    for episode in episodes:
        data_set.add(episode)
    data_set.close()
    return data_set


def expected(log):
    """Observations ``[N + 1, n]`` by name, from the log and from what the test itself changed."""
    plans, end = log.plans, log.states[-1]
    goal = np.tile(np.float32([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), (11, 1))
    gate = np.tile(np.float32([0.0, 3.0, 1.0, 0.0, 0.0, 0.0, 1.0]), (11, 1))
    goal[4:, :2], gate[4:, 0] = (0.2, -0.5), 0.5
    return {
        "joint_q": np.vstack([plans.joint_q, end.joint_q]).astype(np.float32),
        "joint_qd": np.vstack([plans.joint_qd, end.joint_qd]).astype(np.float32),
        "act": np.vstack([plans.act, plans.act[-1]]),
        "mocap": np.vstack([plans.mocap[:, 0], plans.mocap[-1]]),
        "goal": goal,
        "gate": gate,
        "pace": np.float32([[0.5]] * 7 + [[0.75]] * 4),
    }


def test_hdf5_has_the_layout_of_robomimic(log, episodes, tmp_path):
    need("h5py")
    import h5py

    assert filled(Hdf5DataSet(tmp_path / "demos.hdf5"), episodes).steps == 40
    with h5py.File(tmp_path / "demos.hdf5") as file:
        data = file["data"]
        assert data.attrs["total"] == 40
        about = json.loads(data.attrs["env_args"])
        assert about["env_kwargs"]["names"]["controls"] == log.names["controls"]
        assert sorted(data) == ["demo_0", "demo_1", "demo_2", "demo_3"]
        assert [name.decode() for name in file["mask/success"]] == ["demo_0"]
        for name, (success, reason) in zip(sorted(data), ENDS, strict=True):
            demo = data[name]
            assert (demo.attrs.get("success"), demo.attrs.get("reason")) == (success, reason)
            assert (demo.attrs["num_samples"], demo.attrs["seed"]) == (10, log.origin["seed"])
            np.testing.assert_array_equal(demo["actions"], log.controls.control.astype(np.float32))
            np.testing.assert_array_equal(demo["dones"], [0] * 9 + [1])
            np.testing.assert_array_equal(demo["rewards"], [0.0] * 9 + [float(bool(success))])
            np.testing.assert_array_equal(demo["time"], log.states.time[:-1])
            assert set(demo["obs"]) == set(demo["next_obs"]) == set(expected(log))
            for key, rows in expected(log).items():
                np.testing.assert_array_equal(demo["obs"][key], rows[:-1], err_msg=key)
                np.testing.assert_array_equal(demo["next_obs"][key], rows[1:], err_msg=key)


def test_in_real_time_ticks_without_a_plan_or_a_command_are_left_out(log):
    columns = {"seen_q": log.plans.joint_q, "seen_qd": log.plans.joint_qd, "seen_act": log.plans.act}
    columns |= {"seen_mocap": log.plans.mocap, "clock": log.states.time[:-1], "control": log.controls.control.copy()}
    columns["control"][7] = np.nan
    plan = np.where(np.arange(10) < 2, -1, log.controls.plan - 2)  # the newest one is two ticks old
    ticks = replace(log, controls=changed(log.controls, plan=plan, **columns))
    found, kept = demonstration(ticks), [2, 3, 4, 5, 6, 8, 9]
    np.testing.assert_array_equal(found.actions, log.controls.control[kept].astype(np.float32))
    np.testing.assert_array_equal(found.observations["joint_q"][:-1], log.plans.joint_q[kept])
    np.testing.assert_array_equal(found.observations["goal"][:, 0], np.float32([0, 0, 0, 0, 0.2, 0.2, 0.2, 0.2]))
    np.testing.assert_array_equal(found.time, log.states.time[[*kept, 10]])
    with pytest.raises(ValueError, match="no control that a plan sent"):
        demonstration(replace(ticks, controls=changed(ticks.controls, plan=np.full(10, -1))))


def test_nothing_that_is_there_is_replaced(episodes, tmp_path):
    need("h5py")
    filled(Hdf5DataSet(tmp_path / "a.hdf5"), episodes[:1])
    before = (tmp_path / "a.hdf5").read_bytes()
    with pytest.raises(ValueError, match="is there already"):
        Hdf5DataSet(tmp_path / "a.hdf5")
    assert (tmp_path / "a.hdf5").read_bytes() == before
    filled(Hdf5DataSet(tmp_path / "none.hdf5"), [])
    assert not (tmp_path / "none.hdf5").exists()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: Hdf5DataSet(folder / "a.npz"), "is no .hdf5 file"),
        (lambda folder: Hdf5DataSet(folder / "nowhere" / "a.hdf5"), "no such folder"),
    ],
)
def test_names_that_cannot_be_are_refused(make, message, tmp_path):
    need("h5py")
    with pytest.raises(ValueError, match=message):
        make(tmp_path)


def test_a_missing_package_is_named_with_its_cure(monkeypatch, tmp_path):
    monkeypatch.setattr("warpmpc.extras.export.data_sets.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r'needs .*: pip install "warpmpc\[export\]"'):
        Hdf5DataSet(tmp_path / "a.hdf5")
