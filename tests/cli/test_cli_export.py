# SPDX-License-Identifier: Apache-2.0
"""``warpmpc export`` and ``warpmpc run --export``: what is written, what is left out, what is refused."""

import json

import numpy as np
import pytest
from needs import need
from program import SCENE, TINY

from warpmpc import RunLog

NEAR_OR_FAR = """
[[robot]]
name = "base"
asset = "omni_base.urdf"
drive = { damping = 600.0, effort_limit = 100.0, limit = [0.8, 0.8, 1.0] }
frames.tip = { link = "base_link" }

[goal]
frame = "base/tip"
position = [1.0, 0.0]

[[cost]]
term = "distance"
between = ["base/tip", "goal"]

[planner]
samples = 16
horizon = 4
dt = 0.04

[timing]
timeout = 0.6

[success]
position = 0.15

[randomize_task.draw]
"goal.position" = { low = [0.2, 0.0], high = [0.8, 0.0] }
"""
"""Some goals are too far for the time."""


@pytest.fixture
def folder(tmp_path):
    for package in ("h5py", "mcap", "rosbags"):
        need(package)
    (tmp_path / "goals.toml").write_text(NEAR_OR_FAR)
    return tmp_path


RUN = ("run", "goals.toml", "--episodes", "5", "--engine", "mujoco")


def demos(path):
    import h5py

    with h5py.File(path) as file:
        return {
            int(demo.attrs["seed"]): (bool(demo.attrs["success"]), demo["actions"][:], demo["obs/goal"][0, 0])
            for demo in file["data"].values()
        }


def test_a_data_set_has_the_successful_runs_and_an_export_has_all(folder, command):
    done = command(*RUN, "--out", "run", "--export", "demos")
    results = [json.loads(line) for line in (folder / "run" / "results.jsonl").read_text().splitlines()]
    successful = {result["seed"] for result in results if result["success"]}
    assert 0 < len(successful) < 5
    steps = sum(result["steps"] for result in results if result["success"])
    said = f"demos.hdf5: {len(successful)} of 5 episodes, {steps} steps; {5 - len(successful)} that failed"
    assert said in done.stdout
    found = demos(folder / "demos.hdf5")
    assert set(found) == successful

    done = command("export", "run", "--hdf5", "all.hdf5", "--mcap", "run.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    everything = demos(folder / "all.hdf5")
    assert {seed for seed, (success, *_) in everything.items() if success} == successful
    for seed, (_, actions, goal) in everything.items():
        log = RunLog.load(folder / "run" / f"episode-{seed}.runlog")
        np.testing.assert_array_equal(actions, log.controls.control.astype(np.float32))
        assert goal == pytest.approx(log.plans.task[0, 0])
        assert (folder / f"run-{seed}.mcap").is_file()
        if seed in found:
            np.testing.assert_array_equal(found[seed][1], actions)

    refused = {
        ("run", "--hdf5", "all.hdf5"): "'all.hdf5' is there already",
        ("run",): "say what to write: --mcap FILE.mcap or --hdf5 FILE.hdf5",
        ("run", "--mcap", "run.bag"): "--mcap: must be a .mcap file, not 'run.bag'",
        ("nowhere", "--hdf5", "b.hdf5"): "error: nowhere",
    }
    refused["run", "--hdf5", "b.hdf5"] = "results.jsonl: has no results of episodes"
    for arguments, message in refused.items():
        if "results" in message:
            (folder / "run" / "results.jsonl").write_text("[3]\n")
        done = command("export", *arguments)
        assert done.returncode == 2
        assert message in done.stderr
        assert len(done.stderr.splitlines()) == 1
    (folder / "run" / "results.jsonl").unlink()
    bad = sorted((folder / "run").glob("*.runlog"))[-1]
    bad.write_bytes(bad.read_bytes()[:200])
    done = command("export", "run", "--hdf5", "b.hdf5", "--mcap", "b.mcap")
    assert done.returncode == 2
    assert bad.name in done.stderr
    assert not list(folder.glob("b*"))


@pytest.mark.slow
def test_processes_write_the_same_data_set(folder, command):
    command(*RUN, "--export", "one")
    command(*RUN, "--export", "two", "--jobs", "2")
    one, two = demos(folder / "one.hdf5"), demos(folder / "two.hdf5")
    assert set(one) == set(two)
    for seed in one:
        np.testing.assert_array_equal(one[seed][1], two[seed][1])


def test_options_that_do_not_go_together(folder, command):
    (folder / "mine.toml").write_text(SCENE)
    for options, message in (
        (("--envs", "2", "--episodes", "2"), "--export: logs are of one environment"),
        (("--real-time",), "--export: not with --real-time"),
    ):
        done = command("run", "mine.toml", "--export", "demos", *options, *TINY)
        assert done.returncode == 2
        assert message in done.stderr
    assert not (folder / "demos.hdf5").exists()


def test_a_missing_package_is_one_line(folder, command, monkeypatch):
    monkeypatch.setattr("warpmpc.extras.export.data_sets.find_spec", lambda name: None)
    (folder / "mine.toml").write_text(SCENE)
    done = command("run", "mine.toml", "--export", "demos", *TINY)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == 'error: --hdf5 needs h5py: pip install "warpmpc[export]"\n'
