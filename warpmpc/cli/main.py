# SPDX-License-Identifier: Apache-2.0
"""The command line: list scenes and cost terms, print their schema, begin, check and run a scene."""

from __future__ import annotations

import atexit
import gc
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ..physics.runtime.files import Output, Unwritable
from ..scene.errors import SceneError
from ..scene.registry import COMMANDS
from . import lists
from .setup import (
    LAST_SEED,
    DeviceOption,
    EngineOption,
    SceneArgument,
    SeedOption,
    SetOption,
    TermsOption,
    run_arguments,
    user_errors,
)
from .terminal import Plain, say

# physics, kernels and tables take seconds to import: every command imports what it needs, when it needs it

app = typer.Typer(
    name="warpmpc",
    help="Real-time model-predictive control that uses a parallel physics simulator as its model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Entry point of the program ``warpmpc``."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell leaves it to what it starts in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ["PYTHONSAFEPATH"] = "1"  # processes that are started import nothing of the working directory
    atexit.register(gc.freeze)  # looking at what imports and models leave takes long at the end, too
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed by the parent: files that are opened would take its number
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    logging.lastResort.setFormatter(Plain())
    options = {"encoding": sys.stdout.encoding, "line_buffering": sys.stdout.isatty()}
    sys.stdout = Output(sys.stdout.detach(), **options)
    try:
        try:
            app(prog_name="warpmpc")
        finally:
            sys.stdout.flush()
    except (Unwritable, BrokenPipeError) as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python flushes once more
        if isinstance(error, Unwritable):
            say(f"error: {error}", out=sys.stderr)
        sys.exit(1)


def _version(wanted: bool) -> None:
    if wanted:
        from .. import __version__

        say(f"warpmpc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


for _command in (lists.scenes, lists.show, lists.terms, lists.robots, lists.keys, lists.schema):
    app.command()(_command)


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make; it may be there and empty.")],
) -> None:
    """Write a starter: a scene, a robot, a cost term, a loop in Python, and what to do with them."""
    from .lists import make_starter
    from .setup import start_warp

    start_warp()
    with user_errors():
        for name in make_starter(folder):
            say(folder / name)
    say(f"next: cd {folder} && warpmpc run scene.toml --terms cost.py")


@app.command()
def run(
    scene: SceneArgument,
    seed: Annotated[int, typer.Option(min=0, max=LAST_SEED, help="Seed of the first episode.")] = 0,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes, with seeds SEED, SEED + 1, ...")] = 1,
    envs: Annotated[
        int,
        typer.Option(min=1, help="Episodes that run at once, planned for together; not for scenes that draw bodies."),
    ] = 1,
    engine: EngineOption = "auto",
    device: DeviceOption = "auto",
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd",
            help='Record for rerun, pip install "warpmpc[record]"; several episodes put their seed into the name.',
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Write states, controls, forces and plan times of every step; cost and cost/NAME are those of the "
            "plan's best sample over its horizon, weights included; the last row is the final state, with no control.",
        ),
    ] = None,
    npz: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="The same as NumPy arrays, see warpmpc.RunLog.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="A new folder that tells all about the run: scene, command, versions, hardware, results, logs, "
            "and recordings of episodes that run here.",
        ),
    ] = None,
    export: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help='A data set of the episodes that succeed, pip install "warpmpc[export]": NAME.hdf5 as robomimic reads '
            "it.",
        ),
    ] = None,
    jobs: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="Where episodes run: a number of processes, gpus (a process for each GPU), ray or ray:HOST:PORT (a "
            "Ray cluster); --envs is divided among them.",
        ),
    ] = None,
    results: Annotated[
        Path | None, typer.Option(metavar="FILE.jsonl", help="Keep results in a file; those it has are not run again.")
    ] = None,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="Plan in another process while the plant moves on in real time; report rates, jitter and latency.",
        ),
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(
            min=0.001, max=1.0, help="With --real-time: simulated seconds in a second; 1 when left out, 0.1 is slow."
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:FILE]", help="With --real-time: driver of the robot, and its file (see warpmpc robots)."
        ),
    ] = None,
    advise: Annotated[
        bool,
        typer.Option("--advise", help="Run the first episode that fails again, with one change each: which reach it?"),
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per episode and line.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table: the exit code alone.")] = False,
) -> None:
    """Run episodes: control the simulated plant until it reaches its goal or runs out of time.

    Exit code 0 when every episode reached its goal (its timeout, where the scene has no success), 1 when one did not,
    2 for wrong input, 130 after Ctrl-C, 143 after SIGTERM.
    """
    from . import run as cli_run
    from .outputs import Outputs, SuccessfulRuns

    arguments, seeds = run_arguments(scene, overrides, terms, engine, device), range(seed, seed + episodes)
    files = {"record": record, "csv": csv, "npz": npz, "out": out}
    outputs = Outputs(**files, export=SuccessfulRuns(export) if export else None, several=episodes > 1)
    options = {"seeds": seeds, "outputs": outputs, "json_lines": json, "quiet": quiet}
    if real_time:
        from .real_time import run_real_time

        given = {"--envs": envs > 1, "--jobs": jobs, "--results": results, "--export": export, "--advise": advise}
        refused = [option for option, value in given.items() if value]
        options |= {"robot": robot or "simulated", "speed": 1.0 if speed is None else speed}
        raise typer.Exit(run_real_time(arguments, refused=refused, **options))
    for option, value in (("--speed", speed), ("--robot", robot)):
        if value is not None:
            raise typer.BadParameter("goes with --real-time", param_hint=option)
    raise typer.Exit(cli_run.run(arguments, envs=envs, jobs=jobs, results_file=results, advise=advise, **options))


@app.command()
def robot(
    scene: SceneArgument,
    zmq: Annotated[
        int | None,
        typer.Option(min=1, max=65534, help="Port on which it publishes its states; the next one takes commands."),
    ] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="A ROS 2 node, on the topics of the driver ros2.")] = False,
    topics: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --ros2: the driver's file, for other topics.")
    ] = None,
    seed: SeedOption = 0,
    speed: Annotated[float, typer.Option(min=0.001, max=1.0, help="Simulated seconds in a second.")] = 1.0,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="End so long after the start, on the robot's clock.")
    ] = None,
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Be a robot: the scene's plant in real time, which others command over a transport; Ctrl-C ends it.

    Prints one line of JSON at its end: commands that came, were refused and why, and how soon it was safe without.
    Noise and delay of what it measures are the scene's: --set plant.noise.position=0.005.
    """
    from .robot import robot as cli_robot
    from .setup import RunArguments

    arguments = RunArguments(source=scene, overrides=tuple(overrides), term_files=tuple(terms), device="cpu")
    transport = {"zmq": zmq, "ros2": ros2, "topics": topics}
    raise typer.Exit(cli_robot(arguments, transport=transport, seed=seed, speed=speed, seconds=seconds))


@app.command()
def bench(
    scene: SceneArgument,
    engine: Annotated[
        list[str], typer.Option("--engine", metavar="ENGINE", help="Engine of the rollouts, as for run; repeatable.")
    ] = ["auto"],  # noqa: B006
    samples: Annotated[
        list[int], typer.Option("--samples", min=2, help="Number of samples, the scene's when left out; repeatable.")
    ] = [],  # noqa: B006
    against: Annotated[
        list[str],
        typer.Option(
            "--against",
            metavar="'KEY=VALUE ...'",
            help="Another setting to compare with, such as planner.samples=128; repeatable.",
        ),
    ] = [],  # noqa: B006
    plans: Annotated[int, typer.Option(min=5, help="Plans of every setting that count.")] = 100,
    seed: SeedOption = 0,
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    device: DeviceOption = "auto",
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Time plans in closed loop: median and tails, several settings beside each other at the same states.

    The settings plan in turn at every observation, so that the machine's drifts meet all alike; ratios are taken plan
    by plan, to the first setting.
    """
    from .bench import bench as cli_bench

    raise typer.Exit(
        cli_bench(
            run_arguments(scene, overrides, terms, "auto", device),
            engines=engine,
            samples=samples,
            against=against,
            plans=plans,
            seed=seed,
            json_lines=json,
        )
    )


def _add_commands() -> None:
    """Add the commands of entry points; one that cannot be used says so when it is called."""
    core = {known.name or known.callback.__name__ for known in app.registered_commands}
    if "check" not in COMMANDS and (Path(__file__).parents[1] / "extras").is_dir():
        say("warning: commands are missing: warpmpc was installed before it had them, install it again", out=sys.stderr)
    for name in sorted(COMMANDS):
        if name in core:
            say(f"warning: the command '{name}' of {COMMANDS.origin(name)} is left out: warpmpc has it", out=sys.stderr)
            continue
        try:
            command = COMMANDS[name]
            if COMMANDS.origin(name) != "warpmpc":
                alone = typer.Typer(add_completion=False)
                alone.command(name)(command)
                typer.main.get_command(alone)
                command = user_errors((SceneError,))(command)
        except Exception as error:  # of a package that is not ours
            command = _refusing(name, error)
        app.command(name)(command)


def _refusing(name: str, error: Exception) -> Callable[[], None]:
    """A command that cannot be used."""

    def command() -> None:
        """Cannot be used."""
        say(f"error: the command '{name}' of {COMMANDS.origin(name)}: {error}", out=sys.stderr)
        raise typer.Exit(2)

    command.__annotations__ = {}
    return command


if multiprocessing.parent_process() is None:  # processes that are started have no commands
    _add_commands()


if __name__ == "__main__":
    main()
