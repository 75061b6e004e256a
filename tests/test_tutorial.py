# SPDX-License-Identifier: Apache-2.0
"""The documentation's files, programs and commands work as they stand there.

Slow ones by hand: pytest -m slow tests/test_tutorial.py
"""

import ast
import runpy

import pytest
import typer.main
from needs import needs
from pages import ROOT, blocks, commands, files, write_files
from program import results

from warpmpc import Controller, Plant, State, load_scene, load_terms, run_episode
from warpmpc import __all__ as public
from warpmpc.cli.lists import make_starter
from warpmpc.cli.main import app

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("docs/**/*.md")))]
WATCH = ROOT / "examples" / "watch.py"
TUTORIAL = [page for page in PAGES if page.startswith("docs/tutorial/")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of ``warpmpc new`` with the files of the tutorial."""
    path = tmp_path_factory.mktemp("tutorial") / "mine"
    make_starter(path)
    for page in (*TUTORIAL, "docs/scenes.md"):
        write_files(page, path)
    return path


@pytest.fixture
def reaches_its_goal(command, folder, monkeypatch):
    """Whether a run in the folder does."""
    monkeypatch.chdir(folder)

    def run(*args: str) -> bool:
        done = command("run", *args, "--json")
        assert done.stderr == ""
        return results(done)[0]["success"]

    return run


def shown(*args: str) -> tuple[str, ...]:
    """A command of the tutorial, which has to be there."""
    assert list(args) in [command for page in TUTORIAL for command in commands(page)]
    return args[1:]


@needs("example-robot-data")
def test_a_ur5_from_its_urdf_reaches_the_goal(reaches_its_goal):
    assert reaches_its_goal(*shown("run", "ur5.toml"), "--engine", "mujoco")


def test_a_cost_of_the_users_own_moves_the_arm(reaches_its_goal):
    assert reaches_its_goal(*shown("run", "reach_up.toml", "--terms", "reach_up.py"), "--engine", "mujoco")


def test_a_term_reads_everything_there_is():
    names = runpy.run_path(str(WATCH))
    scene = load_scene("cylinder_push", overrides=[names["COST"], names["WALL"], "scalar.speed=0.2"])
    mpc = Controller(scene, terms=[names["watch"], names["mass_at_speed"]])
    mpc.step(State.start(mpc.layout))
    assert mpc.info.terms["watch"] > 0.6
    assert not mpc.info.fallback


def test_a_cart_pole_keeps_the_motor_of_its_file(folder, command, monkeypatch):
    assert load_scene(folder / "cartpole.toml").robot[0].drive == ()
    monkeypatch.chdir(folder)
    done = command("check", "cartpole.toml", "--engine", "mujoco")
    assert (done.returncode, done.stderr) == (0, "")
    assert "cartpole/push" in done.stdout
    assert "the file's own" in done.stdout


@pytest.mark.slow
def test_the_cart_pole_swings_up(reaches_its_goal):
    assert reaches_its_goal(*shown("run", "cartpole.toml"))


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


@pytest.mark.usefixtures("optimized")
@pytest.mark.parametrize("joint_q", [None, pytest.param("{x=0.5, y=1.3}", marks=pytest.mark.slow)])
def test_a_disc_pulls_a_door_open_that_has_no_motor(folder, joint_q):
    scene = load_scene(folder / "door.toml", overrides=[f"robot.disc.joint_q={joint_q}"] * (joint_q is not None))
    result = run_episode(scene)
    assert result.success
    assert result.sim_time < 6.0
    assert result.time_in_contact > 0.1


def test_a_wanted_speed_is_followed_when_it_changes_half_way(folder):
    scene, terms = load_scene(folder / "cruise.toml"), load_terms(folder / "cruise.py")
    mpc = Controller(scene, terms=terms, seed=0)
    plant = Plant(scene, seed=1, task=mpc.task, terms=terms)
    for step in range(60):
        if step == 30:
            mpc.task["speed"] = -0.3
        plant.apply(mpc.step(plant.observe()))
    assert plant.state.joint_qd[0] == pytest.approx(-0.3, abs=0.15)


def test_the_gpu_page_runs_without_a_gpu():
    names: dict[str, object] = {}
    for kind, text in blocks("docs/tutorial/gpu.md"):
        if kind == "python":
            exec(compile(text, "gpu.md", "exec"), names)
    assert names["mpc"].device == names["device"]


def test_every_public_name_is_used_in_a_program_that_runs():
    run = [text for kind, text in blocks("docs/tutorial/loop.md") if kind == "python"]
    run += [text for page in PAGES for name, text in files(page).items() if name.endswith(".py")]
    run.append(WATCH.read_text(encoding="utf-8"))
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
