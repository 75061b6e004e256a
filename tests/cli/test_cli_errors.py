# SPDX-License-Identifier: Apache-2.0
"""Wrong input: exit code 2 and one message that says where, what and what instead; never a traceback."""

from subprocess import CompletedProcess

import pytest
from program import SCENE, warpmpc


@pytest.fixture
def folder(tmp_path):
    """The folder in which commands run, with a scene file in it."""
    (tmp_path / "mine.toml").write_text(SCENE)
    return tmp_path


def message(done: CompletedProcess[str]) -> str:
    """The one line on stderr of a command that must refuse its input."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("samples = 16", "sampels = 16", ["planner.sampels", "unknown key", "horizon", "Did you mean 'samples'?"]),
        ("mass = 1.0", "mass = -1.0", ["object.box.mass", "must be above 0", "found -1.0"]),
        ("horizon = 4", "horizon = 0", ["planner.horizon", "must be at least 1", "found 0"]),
        ("[planner]", "[planner", ["mine.toml:", "is not valid TOML"]),
        (
            'asset = "omni_base.urdf"',
            'asset = "omni_bse.urdf"',
            ["robot.base.asset", "no such file", "'omni_bse.urdf'"],
        ),
        ('term = "distance"', 'term = "distence"', ["cost.distence.term", "height", "Did you mean 'distance'?"]),
        ('"base/tip", "box"', '"base/tup", "box"', ["cost.distance.between", "found 'base/tup'", "'base/tip'?"]),
        (
            '"base/tip", "box"]',
            '"base/tip", "box"]\nmetrik = 1',
            ["cost.distance.metrik", "'metric'? (straight, or geodesic)"],
        ),
        ('link = "base_link"', 'link = "base_lnk"', ["robot.base.frames.tip.link", "'base_link'?"]),
    ],
    ids=["key", "mass", "horizon", "syntax", "asset", "term", "frame", "term key", "link"],
)
def test_a_mistake_in_the_file(folder, command, old, new, says):
    assert old in SCENE
    (folder / "mine.toml").write_text(SCENE.replace(old, new, 1))
    text = message(command("run", "mine.toml"))
    assert str(folder / "mine.toml") in text
    for part in says:
        assert part in text


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["omni_push_bax"], ["no such scene file", "point_reach", "Did you mean 'omni_push_box'?"]),
        (["mine.toml:naer"], ["mine.toml", "no such variant", "allowed: near", "Did you mean 'near'?"]),
        (["mine.toml", "--set", "planner.discount=nan"], ["--set", "planner.discount", "must be finite", "found nan"]),
        (["mine.toml", "--set", "planner.samples"], ["--set", "KEY=VALUE"]),
        (["mine.toml", "--engine", "mujocco"], ["--engine", "'mujocco'", "auto, mujoco, mujoco_warp, newton"]),
        (["mine.toml", "--device", "cuda:7"], ["cpu", "'cuda:7'"]),
        (["mine.toml", "--terms", "none.py"], ["none.py", "cannot be read", "No such file"]),
        (["mine.toml", "--terms", "."], [".: cannot be read", "a folder"]),
        (
            ["mine.toml", "--set", "planner.samples=1_000_000_000"],
            ["planner.samples", "physics steps", "found 1000000000"],
        ),
        (["mine.toml", "--set", "cost.distance.weight=1e39"], ["cost.distance.weight", "single precision"]),
        (["."], [".: is a folder"]),
        (["mine.toml", "--record", "no/where.rrd"], ["--record", "no such folder"]),
        (["mine.toml", "--envs", "2", "--record", "a.rrd"], ["--record", "leave out --envs"]),
        (["point_reach", "--envs", "2", "--episodes", "2"], ["obstacle.*.position", "without --envs"]),
    ],
    ids=[
        "scene",
        "variant",
        "nan",
        "no value",
        "engine",
        "device",
        "terms",
        "a folder of terms",
        "samples",
        "weight",
        "folder",
        "record",
        "record a batch",
        "drawn",
    ],
)
def test_a_mistake_in_the_command(folder, command, args, says):
    text = message(command("run", *args))
    for part in says:
        assert part in text


def test_every_mistake_has_a_line(folder, command):
    text = (folder / "mine.toml").read_text()
    (folder / "mine.toml").write_text(text.replace("samples = 16", "sampels = 16\nhorzon = 3"))
    done = command("check", "mine.toml")
    assert (done.returncode, done.stdout) == (2, "")
    keys = [line.partition("mine.toml: ")[2].partition(":")[0] for line in done.stderr.splitlines()]
    assert sorted(keys) == ["planner.horzon", "planner.sampels"]


def test_check_refuses_like_run(folder, command):
    done = command("check", "mine.toml", "--set", "cost.distance.between=['base/tup', 'box']")
    assert "Did you mean 'base/tip'?" in message(done)


def test_check_reads_variants_that_it_does_not_build(folder, command):
    (folder / "mine.toml").write_text(SCENE.replace("goal.position = [1.2, 0.0]", "goal.posision = [1.2, 0.0]"))
    found = message(command("check", "mine.toml"))
    for part in ("[variants.near]", "goal.posision", "Did you mean 'position'?"):
        assert part in found


def test_a_program_of_its_own_refuses_alike(folder, command):
    """Warp starts there, with a banner and a complaint about a missing GPU that are not for users."""
    args = ("run", "mine.toml", "--set", "cost.distance.between=['base/tup', 'box']")
    assert message(warpmpc(*args, folder=folder)) == message(command(*args))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def f(:\n", ["terms.py:1", "SyntaxError"]),
        ("\nimport warpmpc\nwarpmpc.nothing\n", ["terms.py:3", "AttributeError", "nothing"]),
        ("x = 1\n", ["terms.py", "defines no cost term"]),
        ("import sys\nsys.exit(0)\n", ["terms.py:2", "SystemExit"]),
    ],
    ids=["syntax", "exception", "no term", "exit"],
)
def test_a_mistake_in_a_file_of_terms(folder, command, text, says):
    (folder / "terms.py").write_text(text)
    found = message(command("run", "mine.toml", "--terms", "terms.py"))
    for part in says:
        assert part in found


@pytest.mark.parametrize("what", ["check", "run"])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            '@warpmpc.cost_term("own")\ndef own(s: warpmpc.StepView, p: P) -> float:\n    return p.a * p.i\n',
            "terms.py:10: ",
        ),
        ('@warpmpc.array_cost("own")\ndef own(batch):\n    return batch["nothing"]\n', "terms.py:10: KeyError"),
        ('@warpmpc.array_cost("own")\ndef own(batch):\n    return None\n', "terms.py:8: an array cost returns"),
    ],
    ids=["types", "exception", "None"],
)
def test_a_mistake_in_a_term(folder, command, what, text, says):
    head = "import warp as wp\nimport warpmpc\n\n@wp.struct\nclass P:\n    a: float\n    i: int\n"
    (folder / "terms.py").write_text(head + text)
    cost = '[[cost]]\nterm = "own"\na = 1.0\ni = 1\n\n[planner]'
    (folder / "mine.toml").write_text(SCENE.replace("[planner]", cost))
    found = message(command(what, "mine.toml", "--terms", "terms.py"))
    assert "mine.toml: cost.own: " in found
    assert says in found


@pytest.mark.parametrize(
    "args",
    [
        ["run"],
        ["run", "mine.toml", "--nonsense"],
        ["run", "mine.toml", "--episodes", "0"],
        ["run", "mine.toml", "--envs", "0"],
        ["fly"],
    ],
)
def test_wrong_usage(folder, command, args):
    done = command(*args)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("Error: ") == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("option", "real_time"),
    [
        *((option, []) for option in ("--npz", "--csv", "--record", "--results")),
        *((option, ["--real-time"]) for option in ("--npz", "--csv", "--record")),
    ],
)
def test_files_that_cannot_be_written_are_refused_before_the_run(command, tmp_path, monkeypatch, option, real_time):
    monkeypatch.setattr("warpmpc.loop.run.real_time.run_real_time", None)
    monkeypatch.setattr("warpmpc.loop.run.episode.Episode.run", None)
    suffix = {"--record": "rrd", "--results": "jsonl"}.get(option, option[2:])
    (tmp_path / f"folder.{suffix}").mkdir()
    for file in (f"folder.{suffix}", f"/proc/a.{suffix}"):
        done = command("run", "omni_push_box", option, file, *real_time)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert f"cannot write '{file}'" in done.stderr
    several = ["--seed", "3", "--episodes", "2"] if option != "--results" else []
    if several:
        (tmp_path / f"a-4.{suffix}").mkdir()
        done = command("run", "omni_push_box", option, f"a.{suffix}", *several, *real_time)
        assert (done.returncode, f"cannot write 'a-4.{suffix}'" in done.stderr) == (2, True)
