# SPDX-License-Identifier: Apache-2.0
"""Files that cannot be written: one line names each, exit code 1, and all others are whole."""

import json
import os
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from needs import need
from program import PROGRAM, SCENE, TINY, small_disk

from warpmpc import Controller, Plant, RecordingSwitch, RunLog, load_scene
from warpmpc.cli.run_folder import RunFolder

ENDLESS = SCENE.replace("[success]\nposition = 0.05\n", "")
OUTPUTS = {"record": "a.rrd", "csv": "a.csv", "npz": "a.npz", "export": "a.hdf5", "results": "a.jsonl", "out": "a"}


@pytest.fixture
def folder(tmp_path):
    """The folder in which commands run, with a scene whose episodes pass at their timeout."""
    (tmp_path / "mine.toml").write_text(ENDLESS)
    return tmp_path


def test_a_full_disk_costs_the_files_that_do_not_fit(folder, command):
    need("rerun")
    need("h5py")
    assert command("run", "mine.toml", *TINY).returncode == 0  # all is compiled
    wanted = [part for name, path in OUTPUTS.items() for part in (f"--{name}", path)]
    with small_disk(4000):
        done = command("run", "mine.toml", *TINY, *wanted)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    lost = ["a.rrd", "a.csv", "a.npz", "a.hdf5", "a/episode.runlog", "a/recording.rrd"]
    assert len(lines) == len(lost), done.stderr
    for path in lost:
        assert sum(line.startswith(f"error: cannot write '{path}': File too large") for line in lines) == 1, path
    for path in ("a.csv", "a.npz", "a.hdf5"):
        assert not (folder / path).exists()
    for path in ("a.jsonl", "a/results.jsonl", "a/run.json"):
        json.loads((folder / path).read_text())
    assert "1 of 1" in done.stdout or "timeout" in done.stdout


def test_a_file_that_fits_is_whole_beside_one_that_does_not(folder, command):
    """Rows that the disk did not take are in memory: what is made of them has them."""
    assert command("run", "mine.toml", *TINY, "--out", "whole", "--csv", "whole.csv").returncode == 0
    rows = (folder / "whole.csv").read_bytes().splitlines()
    limit = sum(map(len, rows)) + 40 * len(rows)  # times of plans differ, and so do their digits
    assert limit < (folder / "whole" / "episode.runlog").stat().st_size
    with small_disk(limit):
        done = command("run", "mine.toml", *TINY, "--out", "a", "--csv", "a.csv")
    assert done.returncode == 1
    assert "cannot write 'a/episode.runlog'" in done.stderr
    assert len((folder / "a.csv").read_text().splitlines()) == len(rows) == 12
    assert 1 <= len(RunLog.load(folder / "a" / "episode.runlog").states) < 11


@pytest.mark.parametrize(("option", "name"), [("--mcap", "a.mcap"), ("--hdf5", "a.hdf5")], ids=["mcap", "hdf5"])
def test_a_full_disk_ends_an_export_in_one_line(folder, command, option, name):
    for package in ("h5py", "mcap", "rosbags"):
        need(package)
    assert command("run", "mine.toml", *TINY, "--npz", "a.npz").returncode == 0
    with small_disk(4000):
        done = command("export", "a.npz", option, name)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: cannot write '")
    assert f"{name}': File too large" in line
    assert not (folder / name).exists()


@pytest.mark.parametrize(("option", "name"), OUTPUTS.items(), ids=OUTPUTS)
@pytest.mark.parametrize("kind", ["long", "loop"])
def test_a_target_is_tried_before_the_run(folder, command, kind, option, name):
    if option == "export":
        need("h5py")
    stem, dot, suffix = name.partition(".")
    path = ("x" * (256 - len(suffix)) if kind == "long" else stem) + dot + suffix
    if kind == "loop":
        os.symlink(path, folder / path)
    done = command("run", "mine.toml", *TINY, f"--{option}", path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert path in line
    assert done.stdout == ""


def test_a_name_may_be_as_long_as_the_system_allows(folder, command):
    name = "x" * 251 + ".npz"
    assert command("run", "mine.toml", *TINY, "--npz", name).returncode == 0
    assert [file.name for file in folder.iterdir() if file.name != "mine.toml"] == [name]


def test_of_two_runs_one_gets_the_folder(folder):
    scene = load_scene(folder / "mine.toml")

    def begin(_):
        try:
            RunFolder(folder / "a", scene, seeds=[0], term_files=(), asked={})
        except ValueError as error:
            return str(error)
        return None

    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(begin, range(8)))
    assert said.count(None) == 1
    assert all(line is None or "is another run's" in line for line in said)


def test_of_two_runs_one_gets_the_recording(folder, command):
    need("rerun")
    scene = load_scene(folder / "mine.toml", overrides=TINY[1::2])
    mpc, plant = Controller(scene, seed=0), Plant(scene, seed=0)
    first, second = RecordingSwitch(), RecordingSwitch()
    first.start(folder / "a.rrd", mpc, plant)
    begun = (folder / "a.rrd").read_bytes()
    done = command("run", "mine.toml", *TINY, "--record", "a.rrd")
    assert done.returncode == 2
    assert done.stderr == "error: cannot write 'a.rrd': another run is writing it; give another name\n"
    with pytest.raises(OSError, match="another run is writing it"):
        second.start(folder / "a.rrd", mpc, plant)
    first.stop()
    assert (folder / "a.rrd").read_bytes().startswith(begun)
    assert command("run", "mine.toml", *TINY, "--record", "a.rrd").returncode == 0


def test_a_run_in_real_time_that_is_killed_leaves_its_log(folder, command):
    args = ["run", "mine.toml", "--real-time", "--npz", "a.npz", "--set", "planner.samples=16"]
    log = folder / "a.npz.runlog"
    program = subprocess.Popen([*PROGRAM, *args], cwd=folder, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        until = time.monotonic() + 100
        while not (log.exists() and len(RunLog.load(log).controls) > 20) and time.monotonic() < until:
            time.sleep(0.1)
    finally:
        os.killpg(program.pid, signal.SIGKILL)
        program.wait()
    assert len(RunLog.load(log).controls) > 20
    assert not (folder / "a.npz").exists()
    again = command(*args)
    assert again.returncode == 2
    assert "'a.npz.runlog' is left from a run that was killed" in again.stderr


@pytest.mark.parametrize(
    ("args", "redirection", "error"),
    [
        (["keys", "planner"], "> /dev/full", "error: cannot write 'standard output': No space left on device\n"),
        (
            ["run", "mine.toml", *TINY],
            "> /dev/full",
            "error: cannot write 'standard output': No space left on device\n",
        ),
        (["run", "mine.toml", "--engine", "none"], ">&-", "error: --engine: no engine 'none'"),
    ],
    ids=["keys", "run", "closed"],
)
def test_standard_output_that_takes_nothing(folder, args, redirection, error):
    command = ["bash", "-c", f'"$@" {redirection}', "bash", *PROGRAM, *args]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=280)
    assert done.stderr.startswith(error)
    assert len(done.stderr.splitlines()) == 1
    assert done.returncode == (2 if "engine" in error else 1)
