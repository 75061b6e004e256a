# SPDX-License-Identifier: Apache-2.0
"""The documentation's files, programs and commands work as they stand there."""

import ast

import pytest
import typer.main
from needs import needs
from pages import ROOT, blocks, commands, files, write_files
from program import results, warpmpc

from warpmpc import Controller, State, load_scene, load_terms, run_episode
from warpmpc import __all__ as public
from warpmpc.cli.main import app
from warpmpc.cli.new import make_starter

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("docs/**/*.md")))]
TUTORIAL = [page for page in PAGES if page.startswith("docs/tutorial/")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of ``warpmpc new`` with the files of the tutorial."""
    path = tmp_path_factory.mktemp("tutorial") / "mine"
    make_starter(path)
    for page in (*TUTORIAL, "docs/scenes.md"):
        write_files(page, path)
    return path


def reaches_its_goal(folder, *args: str) -> bool:
    done = warpmpc("run", *args, "--json", folder=folder)
    assert done.stderr == ""
    return results(done)[0]["success"]


def shown(*args: str) -> tuple[str, ...]:
    """A command of the tutorial, which has to be there."""
    assert list(args) in [command for page in TUTORIAL for command in commands(page)]
    return args[1:]


@needs("example-robot-data")
def test_a_ur5_from_its_urdf_reaches_the_goal(folder):
    assert reaches_its_goal(folder, *shown("run", "ur5.toml"), "--engine", "mujoco")


def test_a_cost_of_the_users_own_moves_the_arm(folder):
    assert reaches_its_goal(folder, *shown("run", "reach_up.toml", "--terms", "reach_up.py"), "--engine", "mujoco")


def test_a_term_reads_everything_there_is(folder):
    scene, terms = load_scene(folder / "watch.toml"), load_terms(folder / "watch.py")
    mpc = Controller(scene, terms=terms)
    mpc.step(State.start(mpc.layout))
    assert mpc.info.terms["watch"] > 0.6
    assert not mpc.info.fallback


def test_a_cart_pole_keeps_the_motor_of_its_file(folder):
    assert load_scene(folder / "cartpole.toml").robot[0].drive == ()
    done = warpmpc("check", "cartpole.toml", "--engine", "mujoco", folder=folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "cartpole/push" in done.stdout
    assert "the file's own" in done.stdout


@pytest.mark.slow
def test_the_cart_pole_swings_up(folder):
    assert reaches_its_goal(folder, *shown("run", "cartpole.toml"))


@pytest.mark.slow
@needs("mjlab")
def test_the_quadruped_crouches(folder):
    assert reaches_its_goal(folder, *shown("run", "go1.toml"))


def test_the_loop_runs_block_by_block(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    for kind, text in blocks("docs/tutorial/loop.md"):
        if kind == "python":
            exec(compile(text, "loop.md", "exec"), names)
    assert names["result"].reason == "timeout"


def test_a_task_in_parts_goes_through_its_phases(folder):
    result = run_episode(load_scene(folder / "rounds.toml"))
    assert result.success
    assert [name for name, _ in result.phases] == ["home"]


def test_a_wanted_speed_is_followed_when_it_changes_half_way(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    program = next(text for kind, text in blocks("docs/scenes.md") if kind == "python" and "cruise.toml" in text)
    exec(compile(program, "scenes.md", "exec"), names)
    assert names["plant"].state.joint_qd[0] == pytest.approx(-0.3, abs=0.15)


def test_the_gpu_page_runs_without_a_gpu():
    names: dict[str, object] = {}
    for kind, text in blocks("docs/tutorial/gpu.md"):
        if kind == "python":
            exec(compile(text, "gpu.md", "exec"), names)
    assert names["mpc"].device == names["device"]


def test_every_public_name_is_used_in_a_program_that_runs():
    run = [text for kind, text in blocks("docs/tutorial/loop.md") if kind == "python"]
    run += [text for page in PAGES for name, text in files(page).items() if name.endswith(".py")]
    used = {
        node.attr
        for text in run
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "warpmpc"
    }
    assert set(public) - used == set()


@pytest.mark.parametrize("page", PAGES)
def test_shown_commands_have_options_that_exist(page):
    program = typer.main.get_command(app)
    for name, *arguments in commands(page):
        if name.startswith("-"):
            continue
        program.commands[name].make_context(name, list(arguments), parent=program.context_class(program))
