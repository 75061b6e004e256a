# SPDX-License-Identifier: Apache-2.0
"""Files and names from elsewhere: one line where they are not what they should be, nothing that steers the terminal."""

import json
import os
import subprocess
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from needs import need
from program import SCENE, TINY, warpmpc

from warpmpc.loop.log.writer import ORIGIN
from warpmpc.scene.registry import ROBOTS

COMMANDS = {"replay": (), "diagnose": (), "plot": (), "export": ("--hdf5", "new.hdf5")}


def refused(done) -> str:
    """The one line of a command that refuses its input."""
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert line.isprintable()
    return line


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A run's log as arrays."""
    folder = tmp_path_factory.mktemp("log")
    (folder / "mine.toml").write_text(SCENE)
    warpmpc("run", "mine.toml", *TINY, "--npz", "a.npz", folder=folder)
    with np.load(folder / "a.npz") as arrays:
        return dict(arrays)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_has_no_end_is_not_read(command, tmp_path, name):
    if name == "export":
        need("h5py")
    os.mkfifo(tmp_path / "fifo")
    for path in ("/dev/zero", "fifo"):
        assert f"{path}: is no run log: is no regular file" in refused(command(name, path, *COMMANDS[name]))


def test_settings_of_a_robot_are_a_file(command, tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    assert "is no regular file" in refused(command("check", "mine.toml", "--robot", "zmq:zero.toml"))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_forged_origin_is_refused_in_a_line(command, tmp_path, log, name):
    about = json.loads(str(log["about"]))
    forged = [{}, [], "x", 1.5, dict.fromkeys(about["origin"])]
    forged += [{**about["origin"], key: value} for key in ORIGIN for value in (["x"], 1e300, {"a": 1})]
    forged += [{k: v for k, v in about["origin"].items() if k != key} for key in ORIGIN]
    for i, origin in enumerate(forged):
        if isinstance(origin, dict) and all(
            type(origin.get(key)) is type(value) for key, value in about["origin"].items()
        ):
            continue  # a dictionary for a dictionary
        np.savez(tmp_path / f"{i}.npz", **{**log, "about": np.array(json.dumps({**about, "origin": origin}))})
        refused(command(name, f"{i}.npz", *COMMANDS[name]))


def test_names_do_not_steer_the_terminal(command, tmp_path, log):
    about = json.loads(str(log["about"]))
    about["origin"]["scene"] = "\x1b[2Jgone[/x]\x07"
    np.savez(tmp_path / "a.npz", **{**log, "about": np.array(json.dumps(about))})
    for name in ("replay", "diagnose"):
        done = command(name, "a.npz")
        assert not {"\x1b", "\x07"} & set(done.stdout + done.stderr)
        assert "gone[/x]" in done.stdout
    assert r"\x1b" in refused(command("replay", "\x1b[2J.npz"))


def test_a_driver_that_cannot_be_loaded_hides_no_other(command, monkeypatch):
    broken = EntryPoint("broken", "no_such_package:make", ROBOTS._group)
    monkeypatch.setattr(ROBOTS, "_points", {"broken": broken, **ROBOTS._points})
    done = command("robots")
    assert done.returncode == 0
    assert {"zmq", "simulated"} <= {line.split()[0] for line in done.stdout.splitlines()}
    assert "'broken'" in done.stderr
    assert "cannot be loaded" in refused(command("robots", "broken"))


def test_python_m_warpmpc_takes_nothing_of_the_working_directory(tmp_path):
    (tmp_path / "random.py").write_text("raise SystemExit('taken')")
    done = subprocess.run(
        [sys.executable, "-m", "warpmpc", "keys", "planner"], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert (done.returncode, done.stderr) == (0, "")
