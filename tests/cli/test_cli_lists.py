# SPDX-License-Identifier: Apache-2.0
"""What is printed before anything runs: version, help, scenes, terms, and what a check built."""

import re
import subprocess
import sys
import textwrap
import tomllib

import mujoco
import pytest
from program import SCENE, warpmpc

from warpmpc import load_scene, shipped_scenes
from warpmpc.loop.run.result import EpisodeResult
from warpmpc.scene.model.control_values import effort_words


def test_version():
    done = warpmpc("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "warpmpc 0.1.0\n"


def test_scenes_lists_every_shipped_scene_with_its_variants():
    done = warpmpc("scenes")
    assert (done.returncode, done.stderr) == (0, "")
    row = next(line for line in done.stdout.splitlines() if "omni_push_box" in line)
    for part in ("A, B", "base", "×", "pushes a box"):
        assert part in row
    assert "point_reach" in done.stdout


def test_show_prints_a_scene_that_loads_again(command, tmp_path):
    done = command("show", "pendulum")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == shipped_scenes()["pendulum"].read_text()
    shown = command("show", "omni_push_box:B").stdout
    (tmp_path / "b.toml").write_text(shown)
    assert load_scene(tmp_path / "b.toml").goal == load_scene("omni_push_box:B").goal
    done = command("show", "pendulm")
    assert (done.returncode, done.stdout) == (2, "")
    assert "Did you mean 'pendulum'?" in done.stderr


def test_listing_scenes_loads_no_physics():
    slow = "{'warp', 'mujoco', 'scipy'}"
    code = f"import sys, warpmpc.cli.report as r; r.print_scenes(); print(sorted({slow} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, encoding="utf-8")
    assert done.stdout.splitlines()[-1] == "[]"


def test_terms_lists_every_term_in_a_line():
    from warpmpc.cost.terms import TERMS

    done = warpmpc("terms")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()[: len(TERMS)]
    assert [line.split()[0] for line in lines] == list(TERMS)
    for line, term in zip(lines, TERMS.values(), strict=True):
        told = line[len(term.name) :].strip().removesuffix(" ...")
        assert told
        assert term.summary.replace("``", "`").startswith(told)


def test_terms_of_a_file_are_listed_and_described(command, tmp_path):
    (tmp_path / "mine.py").write_text(
        "import warp as wp\nimport warpmpc\n\n@wp.struct\nclass LeanParams:\n    frame: int\n\n"
        '@warpmpc.cost_term("lean")\ndef lean(s: warpmpc.StepView, p: LeanParams) -> float:\n'
        '    """How far a frame leans."""\n    return float(0.0)\n\n'
        '@warpmpc.array_cost("waste")\ndef waste(batch):\n    """What is wasted."""\n'
    )
    done = command("terms", "--terms", str(tmp_path / "mine.py"))
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.split(maxsplit=1) for line in done.stdout.splitlines()]
    assert ["lean", "How far a frame leans."] in lines
    assert ["waste", "What is wasted."] in lines
    done = command("terms", "lean", "waste", "--terms", str(tmp_path / "mine.py"))
    for part in (
        "How far a frame leans.",
        "frame = name or whole number; required",
        'term = "lean"',
        "What is wasted.",
        'term = "waste"',
    ):
        assert part in done.stdout
    assert "no such cost term" in command("terms", "lean").stderr


def test_terms_that_are_named_have_every_key_with_type_default_and_meaning(command):
    from warpmpc.cost.terms import TERMS

    done = command("terms", *TERMS)
    assert (done.returncode, done.stderr) == (0, "")
    words = done.stdout.split()
    for name, term in TERMS.items():
        assert name in words
        assert set(term.keys.model_fields) <= set(words)
    for part in (
        "straight | geodesic",
        "number ≥ 0",
        "number > 0",
        "[text, text]",
        "true | false",
        "required",
        "[m]",
        "[[text, text], ...]",
    ):
        assert part in done.stdout


@pytest.mark.parametrize("args", [("terms",), ("keys",), ("keys", "planner"), ("terms", "distance")])
def test_lists_fit_a_narrow_terminal(command, args):
    done = command(*args)
    assert done.returncode == 0
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_a_named_term_has_an_example_that_is_a_table_of_a_scene(command):
    from warpmpc.cost.terms import TERMS

    done = command("terms", *TERMS)
    blocks = re.findall(r"^    \[\[cost\]\].*?(?=^$|\Z)", done.stdout, re.MULTILINE | re.DOTALL)
    tables = [tomllib.loads(textwrap.dedent(block))["cost"][0] for block in blocks]
    assert [table["term"] for table in tables] == list(TERMS)
    for table in tables:
        own = {key: value for key, value in table.items() if key not in ("term", "name", "weight", "terminal", "when")}
        TERMS[table["term"]].keys.model_validate(own)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ("planner.noise", ["[planner.noise]", "spread = [number > 0, number > 0]; default [", "Factors (low, high)"]),
        ("robot.panda.drive", ["[[robot.drive]]", "effort_limit = "]),
        ("robot.drive.mode", ["mode = velocity | position", "What a control sets at the joints."]),
        ("randomize.box", None),
        ("randomize", ["[randomize.NAME]", "friction"]),
        ("planner.noise.sigma", ["sigma = number > 0 or", "Share of the range"]),
        ("cost", ["term = text; required", "warpmpc terms NAME"]),
    ],
)
def test_keys_of_a_table(command, table, says):
    done = command("keys", table)
    if says is None:
        assert (done.returncode, done.stdout) == (2, "")
        return
    assert (done.returncode, done.stderr) == (0, "")
    for part in says:
        assert part in done.stdout


def test_keys_alone_lists_the_tables_and_an_unknown_one_is_an_error(command):
    lines = command("keys").stdout.splitlines()
    assert {"[planner.noise]", "[[robot]]", "[robot.frames.NAME]", "[success]"} <= {*lines}
    for args in (("keys", "planner.nois"), ("terms", "distanc")):
        done = command(*args)
        assert done.returncode == 2
        assert "Did you mean" in done.stderr


@pytest.mark.parametrize("reason", ["goal reached", "the plant's physics diverged", "failed: ball_lost"])
def test_results_are_whole_at_eighty_columns(monkeypatch, capsys, reason):
    monkeypatch.setenv("COLUMNS", "80")
    from warpmpc.cli.report import print_results

    plan = {"p50": 123.4, "p90": 1.0, "p99": 1234.5, "max": 1.0}
    shared = {"scene": "s", "variant": None, "engine": "fused", "device": "cpu", "steps": 9, "cost": 1.0}
    shared |= {"plan_ms": plan, "stages_ms": {}, "diverged_worlds": 0, "samples": 9, "horizon": 9, "fallbacks": 12}
    shared |= {"position_error": 1.234, "yaw_error": 3.123, "max_force": 1234.5, "time_in_contact": 12.34, "reached": 4}
    print_results([EpisodeResult(seed=12, success=False, reason=reason, sim_time=45.0, **shared)], sys.stdout)
    out = capsys.readouterr().out
    for word in (*reason.split(), "45.00", "1.234", "3.123", "1234.5", "12.34", "123.4"):
        assert word in out.split()
    assert "…" not in out


def test_many_failures_have_a_line_each_with_their_cause(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    from warpmpc.cli.report import print_results

    plan = {"p50": 1.0, "p90": 1.0, "p99": 1.0, "max": 1.0}
    shared = {"scene": "s", "variant": None, "engine": "fused", "device": "cpu", "steps": 9, "cost": 1.0}
    shared |= {"plan_ms": plan, "stages_ms": {}, "diverged_worlds": 0, "samples": 9, "horizon": 9, "fallbacks": 0}
    shared |= {"position_error": 1.0, "yaw_error": 0.0, "max_force": 0.0, "time_in_contact": 0.0, "reached": None}
    verdicts = [("not met: x is 1", "r fell at 1 s: a start"), ("not met: x is 2",), ("not met: x is 3", "it: why"), ()]
    results = [
        EpisodeResult(seed=n, success=not verdict, reason="timeout", sim_time=1.0, verdict=verdict, **shared)
        for n, verdict in enumerate(verdicts)
    ]
    print_results(results, sys.stdout)
    rows = [line.strip().split(maxsplit=2) for line in capsys.readouterr().out.split("why it failed")[1].splitlines()]
    rows = [row for row in rows if row[1:2] == ["timeout"]]
    assert rows == [["0", "timeout", "r fell at 1 s"], ["1", "timeout", "not met: x is 2"], ["2", "timeout", "it"]]


def test_check_shows_what_was_built(tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    done = warpmpc("check", "mine.toml:near", "--set", "cost.distance.weight=2.5", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for part in (
        "mine, variant near",
        "nothing: other seeds differ in noise alone",
        "base: 3 DoF",
        "box [x, y, z] = [0.3, 0.5, 0.3] m, 1 kg",
        "base/tip",
        "box at [1.2, 0] m; reached within position 0.05",
        "16 worlds × 4 controls × 2 substeps = 128 physics steps",
        "mujoco on cpu",
        "rad/s",
        "100 N·m",
        "between = [base/tip, box]",
    ):
        assert part in done.stdout
    row = next(line for line in done.stdout.splitlines() if "distance" in line and "between" in line)
    assert "2.5" in row.split()


ACTUATED = """<mujoco><worldbody><body><joint name="a" actuatorfrcrange="-9 9"/><geom size=".1"/><body>
<joint name="b" type="slide"/><geom size=".1"/></body></body></worldbody><actuator>
<motor joint="a" forcerange="-5 6" gear="2"/><motor joint="a" forcerange="-2 2" gear="-3"/><motor joint="a"/>
<motor joint="b" forcerange="-7 7"/><motor joint="b"/></actuator></mujoco>"""


def test_an_actuator_of_a_file_has_the_least_of_its_limits_at_the_joint():
    model = mujoco.MjModel.from_xml_string(ACTUATED)
    assert [effort_words(model, a) for a in range(5)] == ["9 N·m", "6 N·m", "9 N·m", "7 N", "-"]
