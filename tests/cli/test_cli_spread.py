# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run`` in several processes, with results that are kept and files of every step."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import calls
import pytest
from program import TINY, results, untimed

import warpmpc
from warpmpc.cli.spread import shares

RUN = ["run", "omni_push_box", "--engine", "mujoco", *TINY]


@pytest.fixture
def in_seeds(command):
    """The results of ``warpmpc run ... --json``, by seed."""

    def run(*args: str) -> list[dict]:
        done = command(*RUN, "--json", *args)
        assert (done.returncode, done.stderr) == (1, "")
        return sorted(results(done), key=lambda result: result["seed"])

    return run


def test_processes_give_the_results_of_one_and_keep_them(in_seeds, tmp_path):
    alone = in_seeds("--episodes", "3")
    first = in_seeds("--episodes", "2", "--jobs", "2", "--results", "r.jsonl", "--npz", "a.npz")
    assert [untimed(result) for result in first] == [untimed(result) for result in alone[:2]]
    lines = (tmp_path / "r.jsonl").read_text().splitlines()
    assert in_seeds("--episodes", "3", "--results", "r.jsonl")[:2] == first
    assert (tmp_path / "r.jsonl").read_text().splitlines()[:2] == lines
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == 3
    for seed in (0, 1):
        log = warpmpc.RunLog.load(tmp_path / f"a-{seed}.npz")
        assert len(log.controls) == alone[seed]["steps"]
        assert log.plans.cost[-1] == alone[seed]["final"]["cost"]


def test_environments_are_divided_among_processes(in_seeds):
    found = in_seeds("--episodes", "4", "--envs", "4", "--jobs", "2")
    assert [(result["seed"], result["envs"]) for result in found] == [(0, 2), (1, 2), (2, 2), (3, 2)]
    assert [untimed(result) for result in found[:2]] == [
        untimed(result) for result in in_seeds("--episodes", "2", "--envs", "2")
    ]


@pytest.mark.parametrize(
    ("count", "envs", "workers", "sizes"),
    [(5, 1, 3, [1] * 5), (8, 8, 4, [2] * 4), (8, 4, 4, [1] * 8), (7, 6, 4, [2, 2, 2, 1]), (3, 64, 2, [2, 1])],
)
def test_shares_are_as_large_as_environments_allow(count, envs, workers, sizes):
    found = shares(range(10, 10 + count), envs, workers)
    assert [len(share) for share in found] == sizes
    assert [seed for share in found for seed in share] == list(range(10, 10 + count))


def test_files_of_an_episode_hold_what_its_result_says(command, tmp_path):
    done = command(*RUN, "--json", "--csv", "a.csv", "--npz", "b.npz", "--record", "c.rrd")
    (result,) = results(done)
    assert done.stderr == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "b.npz", "c.rrd"]
    log = warpmpc.RunLog.load(tmp_path / "b.npz")
    assert (log.states.time[-1], len(log.controls)) == (pytest.approx(result["sim_time_s"]), result["steps"])
    assert log.plans.cost[-1] == result["final"]["cost"]
    header, *rows = (tmp_path / "a.csv").read_text().splitlines()
    assert header.split(",") == list(log.columns())
    assert len(rows) == result["steps"] + 1


def test_results_of_other_code_are_told(command, tmp_path):
    command(*RUN, "--quiet", "--results", "r.jsonl")
    record = json.loads((tmp_path / "r.jsonl").read_text())
    (tmp_path / "r.jsonl").write_text(json.dumps({**record, "code": "before"}) + "\n")
    done = command(*RUN, "--results", "r.jsonl")
    assert done.stderr == "warning: r.jsonl: 1 of its results were made by another state of warpmpc\n"


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--jobs", "many"], "--jobs must be a number of processes, gpus, ray"),
        (["--jobs", "2", "--record", "a.rrd"], "--record: a recording is made here: leave out --jobs"),
        (["--envs", "2", "--csv", "a.csv"], "--csv: a file shows one environment"),
        (["--csv", "a.npz"], "--csv: must be a .csv file, not 'a.npz'"),
        (["--npz", "no/such/a.npz"], "--npz: no such folder"),
        (["--envs", "2", "--results", "r.jsonl"], "add --jobs"),
        (["--results", "bad.jsonl"], "bad.jsonl:1: is no record"),
        (["--jobs", "1", "--set", 'engine.name="nothing"'], "engine.name"),
        (["--jobs", "1", "--device", "cuda:0"], "cuda:0"),
        (["--jobs", "2", "--set", 'planner.samples="auto"'], "planner.samples: is measured, which parallel jobs"),
    ],
)
def test_a_mistake_is_one_message_and_exit_code_2(args, says, command, tmp_path):
    (tmp_path / "bad.jsonl").write_text("nothing\n")
    done = command(*RUN, *args)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr


INSTALLED = "import sys; del sys.path[0]; from warpmpc.cli.main import main; main()"
"""The program as a package manager installs it: the working directory is not on its path."""


def children(process: int) -> list[int]:
    """Workers of a process."""
    found = [stat for stat in Path("/proc").glob("[0-9]*/stat") if stat.exists()]
    found = [int(stat.parent.name) for stat in found if stat.read_text().rpartition(")")[2].split()[1] == str(process)]
    return [child for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.parametrize(("killed", "number", "code"), [("worker", 9, 1), ("program", 9, -9), ("program", 2, 130)])
def test_a_series_that_ended_goes_on_and_nothing_is_left_over(killed, number, code, in_seeds, tmp_path):
    for name in ("socket", "pickle", "numpy"):  # nothing of the working directory is executed
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')")
    args = ["--episodes", "300", "--jobs", "2", "--results", "r.jsonl"]
    command = [sys.executable, "-c", INSTALLED, *RUN, "--json", *args]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        printed = [program.stdout.readline() for _ in range(2)]
        workers = children(program.pid)
        os.kill(workers[0] if killed == "worker" else program.pid, number)
        rest, errors = program.communicate(timeout=60.0)
    assert (program.returncode, len(workers)) == (code, 2), errors
    assert not (tmp_path / "executed").exists()
    assert ("error: a process of --jobs died" in errors) == (killed == "worker")
    assert ("of 300 episodes are done; the same command continues" in errors) == (number == 2)
    end = time.monotonic() + 20.0
    while not all(map(calls.gone, workers)):
        assert time.monotonic() < end
        time.sleep(0.05)
    printed = {line for line in [*printed, *rest.splitlines(keepends=True)] if line.endswith("}\n")}
    kept = [json.loads(line)["result"]["seed"] for line in (tmp_path / "r.jsonl").read_bytes().splitlines()]
    again = in_seeds("--episodes", str(1 + max(kept)), "--results", "r.jsonl")
    assert [result["seed"] for result in again] == list(range(1 + max(kept)))
    assert {json.loads(line)["seed"] for line in printed} <= {*kept}
    assert all(result in again for result in map(json.loads, printed))
