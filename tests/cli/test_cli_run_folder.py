# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run --out`` and ``warpmpc replay``: a folder from which a result can be traced and had again."""

import json
import os
import platform
import shutil
import subprocess

import mujoco
import numpy as np
import pytest
from program import PROGRAM, SCENE, TINY

import warpmpc

TERMS = """
import numpy as np
import warpmpc


@warpmpc.array_cost("far")
def far(batch):
    return batch["params"]["gain"] * np.square(batch["control"]).sum(axis=-1)
"""


@pytest.fixture
def folder(command, tmp_path, tmp_path_factory):
    """A run of two episodes of a changed scene, with a term of a user's own."""
    kept = tmp_path_factory.getbasetemp() / "kept run"  # by the first test that takes it
    if kept.exists():
        shutil.copytree(kept, tmp_path, dirs_exist_ok=True)
        return tmp_path / "run"
    (tmp_path / "mine.toml").write_text(
        SCENE + '\n[[cost]]\nterm = "far"\ngain = 0.5\n\n[variants.turned]\ngoal.yaw = 0.5\n'
    )
    (tmp_path / "far.py").write_text(TERMS)
    options = ["--episodes", "2", "--seed", "4", "--terms", "far.py", "--engine", "mujoco", "--quiet", *TINY]
    done = command("run", "mine.toml:turned", "--out", "run", *options)
    assert (done.returncode, done.stderr) == (1, "")  # ten controls lead nowhere
    shutil.copytree(tmp_path, kept)
    return tmp_path / "run"


def test_a_folder_tells_all_about_its_run(folder, command):
    names = {"run.json", "scene.toml", "results.jsonl", "terms"}
    names |= {
        f"{kind}-{seed}.{suffix}" for seed in (4, 5) for kind, suffix in (("episode", "runlog"), ("recording", "rrd"))
    }
    assert {path.name for path in folder.iterdir()} == names
    about = json.loads((folder / "run.json").read_text())
    assert (about["scene"], about["variant"], about["seeds"]) == ("mine", "turned", [4, 5])
    assert about["versions"]["warpmpc"] == warpmpc.__version__
    assert about["versions"]["mujoco"] == mujoco.__version__
    assert about["versions"]["numpy"] == np.__version__
    assert about["versions"]["python"] == platform.python_version()
    assert about["hardware"]["cores"] >= 1
    assert about["engine"] == "mujoco"
    results = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
    assert [(r["seed"], r["engine"], r["steps"]) for r in results] == [(4, "mujoco", 10), (5, "mujoco", 10)]

    scene = warpmpc.load_scene(folder / "scene.toml")
    assert (scene.planner.samples, scene.goal.yaw) == (16, 0.5)  # --set and the variant
    again = command(
        "run", "run/scene.toml", "--seed", "4", "--terms", "run/terms/0_far.py", "--engine", "mujoco", "--json"
    )
    assert json.loads(again.stdout)["final"] == results[0]["final"]

    done = command("run", "mine.toml", "--out", "run", "--terms", "far.py", *TINY)
    assert done.returncode == 2
    assert "--out: 'run' is not empty: give a new folder" in done.stderr


@pytest.mark.parametrize("options", [[], ["--real-time"], ["--jobs", "1"]], ids=["run", "real time", "jobs"])
def test_a_start_that_failed_leaves_the_folder_free(command, tmp_path, options):
    (tmp_path / "mine.toml").write_text(SCENE + '\n[[cost]]\nterm = "far"\ngain = 0.5\n')
    (tmp_path / "far.py").write_text(TERMS.replace('["control"]', '["contrl"]'))
    done = command("run", "mine.toml", "--out", "run", "--terms", "far.py", "--engine", "mujoco", *TINY, *options)
    assert done.returncode == 2
    assert "contrl" in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_folder_is_replayed_and_a_changed_log_is_found(folder, command, tmp_path):
    done = command("replay", "run", "--terms", "run/terms/0_far.py")
    assert (done.returncode, done.stderr) == (0, "")
    for seed in (4, 5):
        head = f"episode-{seed}.runlog: mine:turned, seed {seed}, mujoco on cpu, 16 samples: "
        assert f"{head}10 of 10 commands agree bit for bit" in done.stdout
    assert "otherwise" not in done.stdout

    log = warpmpc.RunLog.load(folder / "episode-5.runlog")
    log.plans.command[7, 1] += 1e-3
    log.origin["versions"]["mujoco"] = "1.0"
    log.save(tmp_path / "other.npz")
    done = command("replay", "other.npz", "--terms", "far.py")
    assert (done.returncode, done.stderr) == (1, "")
    assert f"otherwise than in the log: mujoco: 1.0, now {mujoco.__version__}" in done.stdout
    assert "9 of 10 commands agree" in done.stdout
    assert "first that differs: command 7 at t = 0.280 s: base/y was" in done.stdout
    assert "then bits may differ" in done.stdout

    done = command("replay", "other.npz")
    assert done.returncode == 2
    assert "no such cost term" in done.stderr


def test_what_is_in_a_folder_is_not_executed_unasked(folder, command, tmp_path):
    (folder / "terms" / "1_more.py").write_text("open('executed', 'w')")
    done = command("replay", "run")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "run: its scene needs far" in done.stderr
    assert "--terms run/terms/0_far.py --terms run/terms/1_more.py" in done.stderr
    assert command("plot", "run").returncode == 0  # nothing that is drawn needs a term
    judged = (folder / "episode-4.runlog", tmp_path / "judged")
    judged[1].mkdir()
    log = warpmpc.RunLog.load(judged[0])
    log.origin["text"] += '\n[[success.conditions]]\nterm = "far"\nbelow = 1.0\n'
    log.save(judged[1] / "episode.runlog")
    (judged[1] / "terms").mkdir()
    (judged[1] / "terms" / "0_more.py").write_text("open('executed', 'w')")
    assert command("plot", "judged").returncode == 2
    assert not (tmp_path / "executed").exists()


def test_terms_that_a_scene_does_not_name_are_not_executed(command, tmp_path):
    assert command("run", "omni_push_box", "--out", "run", "--engine", "mujoco", "--quiet", *TINY).returncode == 1
    (tmp_path / "run" / "terms").mkdir()
    (tmp_path / "run" / "terms" / "0_more.py").write_text("open('executed', 'w')")
    for name in ("replay", "plot"):
        done = command(name, "run")
        assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(("answer", "code"), [("y\n", 0), ("\n", 2)])
def test_on_a_terminal_there_is_a_question(folder, tmp_path, answer, code):
    ours, theirs = os.openpty()
    command = [*PROGRAM, "replay", "run"]
    with subprocess.Popen(command, cwd=tmp_path, stdin=theirs, stdout=subprocess.PIPE, stderr=theirs) as process:
        os.close(theirs)
        os.write(ours, answer.encode())  # it waits there until it is read
        out, _ = process.communicate(timeout=120)
    said = os.read(ours, 4096).decode()
    os.close(ours)
    assert process.returncode == code
    assert "These files are programs: 'run/terms/0_far.py'" in said
    assert "Execute them? [y/N]" in said
    assert (b"10 of 10 commands agree" in out) == (code == 0)


def test_a_folder_is_diagnosed(folder, command, tmp_path):
    done = command("diagnose", "run", "--terms", "far.py")
    assert (done.returncode, done.stderr) == (0, "")
    for seed in (4, 5):
        assert f"episode-{seed}.runlog: mine:turned, seed {seed}" in done.stdout
    assert done.stdout.count("observations without delay") == 2
    assert done.stdout.count("nothing found: ") == 2
    done = command("diagnose", "run")
    assert done.returncode == 2
    assert "run: its scene needs far" in done.stderr


def test_what_cannot_be_replayed_is_refused_in_one_line(command, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "episode.runlog").write_bytes(b"PK\x03\x04, and no more came")
    arrays = {"time": np.zeros(1), "control": np.zeros((0, 2))}
    np.savez(tmp_path / "part.npz", **arrays)
    wrong = {
        "empty": "no run's folder",
        "text.npz": "is no run log",
        "part.npz": "is no run log",
        "no.npz": "No such file",
        "cut": "episode.runlog: is no run log",
    }
    for name, message in wrong.items():
        for verb in ("replay", "plot", "diagnose"):
            done = command(verb, name)
            assert done.returncode == 2
            assert message in done.stderr
            assert done.stderr.count("\n") == 1


def test_figures_of_a_folder_are_beside_what_they_show(folder, command, tmp_path, monkeypatch):
    done = command("plot", "run")
    assert (done.returncode, done.stderr) == (0, "")
    for seed in (4, 5):
        files = {path.name for path in (folder / "plots" / f"episode-{seed}").iterdir()}
        assert files >= {"history.csv", "path.png", "costs.png", "controls.png", "plan_times.png", "errors.png"}
        assert f"run/plots/episode-{seed}/path.png" in done.stdout

    done = command("plot", "run/episode-4.runlog", "--out", "here", "--terms", "far.py")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "here" / "path.png").exists()

    done = command("plot", "run", "-o", "x.png")
    assert (done.returncode, done.stdout.split()) == (0, ["x-episode-4.png", "x-episode-5.png"])
    assert (tmp_path / "x-episode-4.png").stat().st_size > 10_000
    for wrong in ("x.jpeg", "nothere/x.png"):
        done = command("plot", "run", "-o", wrong)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)

    done = command("plot", "no.npz")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = command("plot", "run")
    assert done.returncode == 2
    assert 'figures need matplotlib: pip install "warpmpc[plot]"' in done.stderr
