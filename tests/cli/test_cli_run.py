# SPDX-License-Identifier: Apache-2.0
"""Episodes from the command line: what stdout carries, exit codes, seeds, recordings, Ctrl-C, users' terms."""

import json
import logging
import os
import re
import signal
import subprocess
import time

import pytest
from program import PROGRAM, SCENE, TINY, results, untimed, warpmpc

import warpmpc as package
from warpmpc.cli.progress import Messages
from warpmpc.cli.setup import RunArguments, Setup

KEYS = [
    "scene",
    "variant",
    "seed",
    "engine",
    "device",
    "success",
    "reason",
    "time_to_goal_s",
    "sim_time_s",
    "steps",
    "final",
    "collisions",
    "plan_ms",
    "stages_ms",
    "diverged_worlds",
    "samples",
    "horizon",
    "fallbacks",
    "envs",
]

PLAIN = ["--engine", "mujoco"]
"""An engine that compiles nothing for a scene, for programs that are started."""
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "encoding": "utf-8"}

TERMS = """
import numpy as np
import warp as wp
import warpmpc


@wp.struct
class LeanParams:
    frame: int


@warpmpc.cost_term("lean")
def lean(s: warpmpc.StepView, p: LeanParams) -> float:
    return 1.0 - wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), wp.vec3(0.0, 0.0, 1.0))[2]


@warpmpc.array_cost("effort")
def effort(batch):
    print("a term may chatter")
    return batch["params"]["gain"] * np.square(batch["control"]).sum(axis=-1)
"""


@pytest.fixture
def mine(tmp_path):
    """A scene that compiles nothing."""
    (tmp_path / "mine.toml").write_text(SCENE)
    return "mine.toml"


def test_json_is_all_there_is_on_stdout_and_the_same_seed_gives_the_same_result(command):
    done = command("run", "omni_push_box:B", "--json", "--seed", "3", "--episodes", "2", *TINY)
    assert (done.returncode, done.stderr) == (1, "")  # the runs fail
    first, second = results(done)
    for result in (first, second):
        assert list(result) == [*KEYS, "foresight", "verdict"]
        assert list(result["final"]) == ["position_error_m", "yaw_error_rad", "cost", "axis_error_m"]
        assert list(result["collisions"]) == ["max_force_N", "time_in_contact_s"]
        assert list(result["plan_ms"]) == ["p50", "p90", "p99", "max"]
        assert list(result["stages_ms"]) == ["begin", "noise", "evaluate", "update"]
        assert (result["scene"], result["variant"]) == ("omni_push_box", "B")
        assert (result["engine"], result["device"]) == ("fused", "cpu")
        assert (result["samples"], result["horizon"], result["steps"]) == (16, 4, 10)
        assert (result["success"], result["reason"], result["time_to_goal_s"]) == (False, "timeout", None)
        assert result["sim_time_s"] == pytest.approx(0.4)
        assert 0.0 < result["plan_ms"]["p50"] <= result["plan_ms"]["p99"] <= result["plan_ms"]["max"]
    assert [first["seed"], second["seed"]] == [3, 4]
    assert first["final"]["cost"] != second["final"]["cost"]
    again = command("run", "omni_push_box:B", "--json", "--seed", "4", *TINY)
    assert [untimed(result) for result in results(again)] == [untimed(second)]


def test_success_ends_in_exit_code_0(mine, command):
    easy = ["--set", "success.position=5.0", "--set", "success.hold=0.08"]
    done = command("run", mine, "--json", *TINY, *easy)
    assert done.returncode == 0
    (result,) = results(done)
    assert (result["success"], result["reason"], result["steps"]) == (True, "goal reached", 2)
    assert result["time_to_goal_s"] == result["sim_time_s"] == pytest.approx(0.08)


FAILURE = ["--set", "failure=[{name='stuck', after=0.2}]"]


def test_a_run_that_fails_says_so_and_ends_in_exit_code_1(mine, command):
    done = command("run", mine, "--json", *TINY, *FAILURE)
    (result,) = results(done)
    assert done.returncode == 1
    assert (result["success"], result["reason"], result["steps"]) == (False, "failed: stuck", 5)
    table = command("run", mine, *TINY, *FAILURE)
    assert table.returncode == 1
    (row,) = [line.split() for line in table.stdout.splitlines() if "failed: stuck" in line]
    assert row[:4] == ["0", "failed:", "stuck", "0.20"]


def test_a_goal_that_is_reached_at_the_start_needs_no_plan(mine, command):
    done = command("run", mine, "--json", *TINY, "--set", "success={ position = 5.0 }")
    (result,) = results(done)
    assert (done.returncode, result["success"], result["steps"], result["time_to_goal_s"]) == (0, True, 0, 0.0)
    assert set(result["plan_ms"].values()) == {None}
    assert result["final"]["cost"] is None


def test_drawn_tasks_say_what_was_drawn(tmp_path, command):
    draw = '[randomize_task.draw]\n"goal.position" = { low = [1.0, -1.0], high = [2.0, 1.0] }\n\n[planner]'
    (tmp_path / "mine.toml").write_text(SCENE.replace("[planner]", draw))
    done = command("run", "mine.toml", "--engine", "mujoco", "--json", "--episodes", "2", *TINY)
    first, second = results(done)
    assert list(first) == [*KEYS, "drawn", "foresight", "verdict"]
    assert first["drawn"].keys() == second["drawn"].keys() == {"goal.position"}
    assert first["drawn"] != second["drawn"]


def test_the_table_has_one_row_per_episode_and_a_sum(mine, command):
    done = command("run", mine, "--episodes", "2", *TINY)
    assert (done.returncode, done.stderr) == (1, "")
    rows = [line.split()[:3] for line in done.stdout.splitlines() if "timeout" in line.split()]
    assert rows == [["0", "timeout", "0.40"], ["1", "timeout", "0.40"]]
    assert "0 of 2 reached the goal\nwhy seed 0 did not succeed:\n  - not met: " in done.stdout


@pytest.mark.parametrize("more", [[], ["--envs", "2"]])
@pytest.mark.parametrize("wall", [False, True])
def test_contact_is_told_where_a_pair_is_watched(tmp_path, command, wall, more):
    obstacle = '[[obstacle]]\nname = "wall"\nshape = "box"\nsize = [0.1, 0.1, 0.1]\nposition = [5.0, 5.0, 0.05]\n'
    (tmp_path / "mine.toml").write_text(SCENE + obstacle * wall)
    done = command("run", "mine.toml", "--episodes", "2", *more, *TINY)
    assert ("contact" in done.stdout) == wall
    if not more:
        assert ("peak force" in done.stdout) == wall
        told = results(command("run", "mine.toml", "--json", *TINY))[0]["collisions"]
        assert told == {"max_force_N": 0.0 if wall else None, "time_in_contact_s": 0.0 if wall else None}


def test_many_episodes_at_once(tmp_path, command):
    (tmp_path / "mine.toml").write_text(SCENE)
    many = ("run", "mine.toml", "--json", "--seed", "3", "--episodes", "5", "--envs", "2", *TINY)
    done = command(*many)
    assert (done.returncode, done.stderr) == (1, "")
    found = results(done)
    assert [result["seed"] for result in found] == [3, 4, 5, 6, 7]
    assert [list(result) for result in found] == [[*KEYS, "verdict"]] * 5
    assert {(result["envs"], result["steps"], result["reason"]) for result in found} == {(2, 10, "timeout")}
    alone = results(command("run", "mine.toml", "--json", "--seed", "3", *TINY))[0]
    assert alone["envs"] == 1
    assert alone.pop("foresight")  # which batches do not look at: a verdict may rest on it
    assert found[0].pop("verdict")[0] == alone.pop("verdict")[0]
    assert {**untimed(found[0]), "envs": 1} == untimed(alone)


def test_many_episodes_make_a_short_table(mine, command):
    easy = ["--set", "success={ position = 5.0 }"]
    done = command("run", mine, "--episodes", "3", "--envs", "2", *TINY, *easy)
    assert (done.returncode, done.stderr) == (0, "")
    (row,) = [line.split() for line in done.stdout.splitlines() if "goal reached" in line]
    assert row[2:4] == ["3", "0.00"]
    assert "plan of 2 environments: p50 - ms, - ms each" in done.stdout  # there was none
    assert "\n100.0 %: 3 of 3 reached the goal; time to goal 0.00 ± 0.00 s\n" in done.stdout
    done = command("run", mine, "--episodes", "3", "--envs", "8", *TINY)
    (row,) = [line.split() for line in done.stdout.splitlines() if "timeout" in line.split()]
    assert (done.returncode, row[:3], row[-3:]) == (1, ["timeout", "3", "0.40"], ["0,", "1,", "2"])
    assert re.search(r"plan of 3 environments: p50 \d+\.\d ms, \d+\.\d ms each", done.stdout)


def test_a_run_says_what_is_judged_and_what_is_hardly_meant(tmp_path, command):
    (tmp_path / "mine.toml").write_text(SCENE)
    odd = ["--set", "planner.noise.sigma=100", "--set", "success.hold=9.0", "--engine", "mujoco"]
    done = command("run", "mine.toml", *TINY, *odd)
    assert (done.returncode, done.stderr) == (1, "")
    assert "worst axis" in done.stdout  # of the goal, whose tolerance is one along each axis
    asked = [line for line in done.stdout.splitlines() if line.startswith("Advice: ")]
    assert [line.split()[1] for line in asked][:2] == ["success.hold", "planner.noise.sigma"]
    done = command("check", "mine.toml", *TINY, *odd)
    asked = [line for line in done.stdout.splitlines() if line.startswith("advice")]
    assert [line.split()[1] for line in asked][:2] == ["success.hold", "planner.noise.sigma"]


def test_plans_too_slow_for_real_time_are_told_by_check_and_not_after_a_run_in_lock_step(tmp_path, command):
    (tmp_path / "mine.toml").write_text(SCENE)
    quick = [*TINY, "--engine", "mujoco", "--set", "timing.control_dt=0.0002", "--set", "timing.timeout=0.001"]
    assert "real time would need" not in command("run", "mine.toml", *quick).stdout
    done = command("check", "mine.toml", *quick)
    assert "real time would need a plan every 0.2 ms" in " ".join(done.stdout.split())
    assert "median of several" in done.stdout


def test_files_whose_sizes_differ_are_no_matter_for_a_warning(tmp_path, command):
    robot = '[[robot]]\nname = "{0}"\nasset = "{0}.xml"\nposition = [{1}, 0.0, 1.0]\n'
    for name, size in (("a", 1), ("b", 7)):
        (tmp_path / f"{name}.xml").write_text(
            f'<mujoco><size nkey="{size}" nuserdata="{size}"/><worldbody><body name="l"><joint name="j" axis="0 1 0"/>'
            '<geom type="sphere" size=".1" mass="1"/></body></worldbody>'
            '<actuator><motor name="m" joint="j" ctrlrange="-1 1"/></actuator></mujoco>'
        )
    rest = '[goal]\nframe = "a/l"\nposition = [0.0, 0.0]\n[[cost]]\nterm = "distance"\nbetween = ["a/l", "goal"]\n'
    (tmp_path / "two.toml").write_text(robot.format("a", 0.0) + robot.format("b", 1.0) + rest)
    done = command("run", "two.toml", *TINY, "--engine", "mujoco")
    assert (done.returncode, done.stderr) == (0, "")


def test_what_the_machine_chose_is_never_too_slow(tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    for samples, late in (("64", 1), ('"auto"', 0)):
        setup = Setup(RunArguments(source=str(tmp_path / "mine.toml"), overrides=(f"planner.samples={samples}",)))
        assert len([s for s in setup.advice(setup.compiled, plan_ms=1e4) if s.startswith("real time")]) == late


ALIKE = "seeds differ in noise alone"
DRAWS = {
    "nothing": ("", None),
    "noise": ("[plant]\nnoise.position = 0.01\n", None),
    "a goal": (
        "[randomize_task.draw]\n'goal.position' = { low = [2.0, -0.1], high = [2.2, 0.1] }\n",
        "goal.position = [2.",
    ),
    "a mass": ("[randomize.box]\nmass.uniform = 0.2\n", "box's mass"),
    "a mass in plans alone": ("[randomize.box]\nmass.uniform = 0.2\n[plant]\nrandomize = false\n", None),
}


@pytest.mark.parametrize("what", DRAWS)
def test_seeds_that_differ_in_noise_alone_are_told(tmp_path, command, what):
    more, drawn = DRAWS[what]
    (tmp_path / "mine.toml").write_text(SCENE.replace("[variants", more + "[variants"))
    quick = [*TINY, "--engine", "mujoco"]
    checked = " ".join(command("check", "mine.toml", *quick).stdout.split())
    assert (f"drawn, seed 0 {drawn}" if drawn else "drawn, seed 0 nothing: other " + ALIKE) in checked
    told = command("run", "mine.toml", *quick, "--episodes", "2").stdout
    assert (ALIKE in told) is (drawn is None)
    if what == "nothing":
        assert ALIKE not in command("run", "mine.toml", *quick).stdout


def test_check_tells_the_phases_and_the_spread_of_the_noise(tmp_path, command):
    phases = """
[[phase]]
name = "over"
goal = { position = [1.5, 0.0] }
until = { frame = "box", below = 0.5 }
hold = 0.2

[[phase]]
name = "there"
"""
    (tmp_path / "mine.toml").write_text(SCENE + phases)
    done = command("check", "mine.toml", *TINY, "--engine", "mujoco", "--set", "planner.noise.spread=[0.1, 2.0]")
    assert (done.returncode, done.stderr) == (0, "")
    assert "over: goal at [1.5, 0] m, until box below 0.5, for 0.2 s\n" in re.sub(" +\n", "\n", done.stdout)
    table = done.stdout.partition("phase over waits for")[2].splitlines()[2:]
    assert table[0].split()[:6] == ["height", "of", "box", "0.15", "≤", "0.5"]
    assert " × 0.1 to 2, discount" in " ".join(done.stdout.split())


def test_check_tells_the_weights_that_hold_in_each_phase(tmp_path, command):
    ends = "after = 1.0"
    phases = [("first", f"weight.distance = 0.0\n{ends}"), ("second", ends), ("third", "weight.near = 2.5")]
    more = '[[cost]]\nterm = "distance"\nname = "near"\nbetween = ["base/tip", "box"]\n'
    text = SCENE + more + "".join(f'[[phase]]\nname = "{name}"\n{keys}\n' for name, keys in phases)
    (tmp_path / "mine.toml").write_text(text)
    done = command("check", "mine.toml", *TINY, "--engine", "mujoco")
    shown = [line.split("; ")[1].strip() for line in done.stdout.splitlines() if "; weights" in line]
    assert shown == [f"weights distance 0, near {near}" for near in ("1", "1", "2.5")]


@pytest.mark.parametrize(
    ("until", "row"),
    [
        ('until = { term = "distance", below = 0.5 }', "distance - ≤ 0.5 - a cost term: known once the plant runs"),
        ("after = 3.0", "time in the phase [s] 0 ≥ 3 - ends it, whatever holds"),
    ],
)
def test_check_tells_what_a_phase_waits_for_besides_places(tmp_path, command, until, row):
    (tmp_path / "mine.toml").write_text(f'{SCENE}\n[[phase]]\nname = "a"\n{until}\n[[phase]]\nname = "b"\n')
    done = command("check", "mine.toml", *TINY, "--engine", "mujoco")
    table = done.stdout.partition("phase a waits for")[2].splitlines()[2:]
    assert " ".join(table[0].split()) == row


def test_without_a_terminal_there_is_a_line_now_and_then(mine, command, monkeypatch):
    monkeypatch.setattr("warpmpc.cli.progress.LINES", 0.0)
    told = command("run", mine, *TINY).stderr.splitlines()
    assert [line.split(" s  cost")[0] for line in told[1:]] == [f"seed 0:  {0.04 * i:.1f}" for i in range(1, 11)]
    monkeypatch.setattr("warpmpc.cli.progress.LINES", 60.0)
    assert command("run", mine, *TINY).stderr == ""


def test_notices_are_shown_once_and_warnings_once_per_episode(capsys):
    logger = logging.getLogger("warpmpc")
    with Messages(notices=True, warnings=True) as messages:
        for _ in range(2):
            logger.info("taking newton")
            logger.warning("every rollout diverged")
            logger.warning("every rollout diverged again")
            messages.warned = False
    assert capsys.readouterr().err.splitlines() == [
        "taking newton",
        "warning: every rollout diverged",
        "warning: every rollout diverged",
    ]
    with Messages(notices=False, warnings=False):
        logger.info("taking newton")
        logger.warning("every rollout diverged")
    assert capsys.readouterr().err == ""


def test_quiet_says_nothing(mine, command):
    done = command("run", mine, "--quiet", *TINY)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def test_terms_of_a_user(tmp_path):
    (tmp_path / "terms.py").write_text(TERMS)
    costs = '[[cost]]\nterm = "lean"\nframe = "box"\n\n[[cost]]\nterm = "effort"\ngain = 0.5\n\n[planner]'
    (tmp_path / "mine.toml").write_text(SCENE.replace("[planner]", costs))
    args = ["--json", "--engine", "mujoco", "--terms", "terms.py", *TINY]
    done = warpmpc("run", "mine.toml", *args, folder=tmp_path)
    (result,) = results(done)
    assert result["steps"] == 10
    assert "a term may chatter" in done.stderr


def test_recordings_of_several_episodes_carry_their_seeds(mine, tmp_path, command):
    done = command("run", mine, "--quiet", "--seed", "7", "--episodes", "2", "--record", "a.rrd", *TINY)
    assert (done.returncode, done.stderr) == (1, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-7.rrd", "a-8.rrd", mine]


def test_ctrl_c_prints_what_there_is(tmp_path):
    # samples and horizon of TINY, but an episode long enough to be interrupted
    command = ["run", "omni_push_box", *PLAIN, "--json", "--episodes", "100", "--record", "a.rrd", *TINY[:6]]
    with subprocess.Popen(
        [*PROGRAM, *command, "--set", "timing.timeout=4.0"],
        cwd=tmp_path,
        **PIPES,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),  # as a shell does in the background
    ) as process:
        lines = [process.stdout.readline()]
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=120)
    found = [json.loads(line) for line in [*lines, *rest.splitlines()]]
    assert process.returncode == 130
    done = sum(result["reason"] == "timeout" for result in found)
    assert errors == f"interrupted: {done} of 100 episodes are done; a command with --results FILE can be continued\n"
    assert found[0]["reason"] == "timeout"
    assert all(result["reason"] == "timeout" for result in found[:-1])
    assert len(found) < 100
    assert (tmp_path / "a-0.rrd").stat().st_size > 0


def test_a_signal_ends_a_run_in_real_time_and_its_files_are_whole(tmp_path):
    command = [*PROGRAM, "run", "omni_push_box", *PLAIN, "--json", "--npz", "a.npz", "--record", "a.rrd", *TINY[:6]]
    endless = ["--set", "timing.timeout=1e4", "--set", "success={ position = 1e-9 }"]  # its goal takes 2 s else
    command += [*endless, "--real-time"]
    with subprocess.Popen(command, cwd=tmp_path, **PIPES, env={**os.environ, "TMPDIR": str(tmp_path)}) as process:
        end, log = time.monotonic() + 120.0, tmp_path / "a.npz.runlog"  # of every tick
        while not (log.exists() and len(package.RunLog.load(log).controls) > 100):
            assert time.monotonic() < end, "it never began"
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        out, errors = process.communicate(timeout=60)
    late = "sending the safe command"  # a loaded machine plans late, and the watchdog says so
    assert (process.returncode, [line for line in errors.splitlines() if late not in line]) == (143, [])
    (result,) = map(json.loads, out.splitlines())
    assert result["reason"] == "interrupted"
    assert len(package.RunLog.load(tmp_path / "a.npz").controls) > 10
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
