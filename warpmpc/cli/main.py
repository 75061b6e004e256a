# SPDX-License-Identifier: Apache-2.0
"""The command line: list scenes and cost terms, print their schema, begin, check and run a scene."""

from __future__ import annotations

import atexit
import gc
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import lists, log_commands, robot_command
from .options import LAST_SEED, SceneArgument, SeedOption, SetOption, TermsOption

if TYPE_CHECKING:
    from .setup import RunArguments

# physics, kernels and tables take seconds to import: every command imports what it needs, when it needs it

app = typer.Typer(
    name="warpmpc",
    help="Real-time model-predictive control that uses a parallel physics simulator as its model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        metavar="ENGINE",
        help="Engine of the rollouts: fused, mujoco (on the CPU), newton (on a GPU), kinematic (no physics), or auto: "
        "the scene's choice, else fused where it can do what the scene asks for.",
    ),
]
DeviceOption = Annotated[
    str,
    typer.Option(
        "--device",
        metavar="DEVICE",
        help="Device of the rollouts: cpu, a GPU such as cuda:0, or auto: the faster, measured once.",
    ),
]


def main() -> None:
    """Entry point of the program ``warpmpc``."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell leaves it to what it starts in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ["PYTHONSAFEPATH"] = "1"  # processes that are started import nothing of the working directory
    gc.set_threshold(100_000, 50, 100)  # a million objects of imports and models stay: looking at them takes seconds,
    atexit.register(gc.freeze)  # at the end, too
    app(prog_name="warpmpc")


def _version(wanted: bool) -> None:
    if wanted:
        from .. import __version__

        typer.echo(f"warpmpc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


for _command in (lists.scenes, lists.terms, lists.robots, lists.keys, lists.schema):
    app.command()(_command)


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make; it may be there and empty.")],
) -> None:
    """Write a starter: a scene, a robot, a cost term, a loop in Python, and what to do with them."""
    from .new import make_starter
    from .setup import start_warp, user_errors

    start_warp()
    with user_errors():
        for name in make_starter(folder):
            typer.echo(folder / name)
    typer.echo(f"next: cd {folder} && warpmpc run scene.toml --terms cost.py")


@app.command()
def check(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    seed: Annotated[int, typer.Option(min=0, max=LAST_SEED, help="Seed of a scene that draws its tasks.")] = 0,
    engine: EngineOption = "auto",
    device: DeviceOption = "auto",
    measure: Annotated[bool, typer.Option("--measure", help="Time plans anew for what is auto.")] = False,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:FILE]", help="Listen to a robot for some seconds instead, and send nothing (see robots)."
        ),
    ] = None,
) -> None:
    """Build everything a run would, make one plan, and show what was built."""
    from . import run as cli_run

    arguments = _arguments(scene, overrides, terms, engine, device)
    if robot is not None:
        from .robot import listen

        raise typer.Exit(listen(arguments, robot))
    raise typer.Exit(cli_run.check(arguments, seed=seed, measure=measure))


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
            "it; of Minari where NAME ends in -v0, -v1, ...",
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
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per episode and line.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table: the exit code alone.")] = False,
) -> None:
    """Run episodes: control the simulated plant until it reaches its goal or runs out of time.

    Exit code 0 when every episode reached its goal (its timeout, where the scene has no success), 1 when one did not,
    2 for wrong input, 130 after Ctrl-C, 143 after SIGTERM.
    """
    from . import run as cli_run
    from .export import SuccessfulRuns
    from .outputs import Outputs

    arguments, seeds = _arguments(scene, overrides, terms, engine, device), range(seed, seed + episodes)
    files = {"record": record, "csv": csv, "npz": npz, "out": out}
    outputs = Outputs(**files, export=SuccessfulRuns(export) if export else None, several=episodes > 1)
    options = {"seeds": seeds, "outputs": outputs, "json_lines": json, "quiet": quiet}
    if real_time:
        from .real_time import run_real_time

        given = {"--envs": envs > 1, "--jobs": jobs, "--results": results, "--export": export}
        refused = [option for option, value in given.items() if value]
        options |= {"robot": robot or "simulated", "speed": 1.0 if speed is None else speed}
        raise typer.Exit(run_real_time(arguments, refused=refused, **options))
    for option, value in (("--speed", speed), ("--robot", robot)):
        if value is not None:
            raise typer.BadParameter("goes with --real-time", param_hint=option)
    raise typer.Exit(cli_run.run(arguments, envs=envs, jobs=jobs, results_file=results, **options))


for _command in (
    robot_command.robot,
    log_commands.replay,
    log_commands.diagnose,
    log_commands.plot,
    log_commands.export,
):
    app.command()(_command)


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
            _arguments(scene, overrides, terms, "auto", device),
            engines=engine,
            samples=samples,
            against=against,
            plans=plans,
            seed=seed,
            json_lines=json,
        )
    )


@app.command()
def tune(
    scenes: Annotated[
        list[str], typer.Argument(metavar="SCENE...", help="Shipped scenes or TOML files; several are tuned together.")
    ],
    keys: Annotated[
        list[str],
        typer.Option(
            "--key",
            metavar="KEY=SPEC",
            help="What to search, or a file of such lines: LOW..HIGH, LOW..HIGH:log, xLOW..HIGH (a factor) or A|B|C; "
            "weights, noise, horizon, knots and temperature within factors of the scene's when left out.",
        ),
    ] = [],  # noqa: B006
    trials: Annotated[int, typer.Option(min=1, help="Trials that the study holds in the end.")] = 50,
    episodes: Annotated[int, typer.Option(min=1, help="Seeds of a trial, for each scene.")] = 4,
    seed: Annotated[int, typer.Option(min=0, max=999, help="First of them; tuning has seeds 0 to 999.")] = 0,
    jobs: Annotated[str, typer.Option(metavar="WHERE", help="Where episodes run, as for warpmpc run.")] = "1",
    study: Annotated[
        Path | None, typer.Option(metavar="FILE.db", help="Keep the study; the same command goes on with it.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.toml", help="Write the scene with the best values.")
    ] = None,
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    engine: EngineOption = "auto",
    device: DeviceOption = "auto",
    contact_penalty: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="Price of a hard contact with an obstacle.")
    ] = 5.0,
) -> None:
    """Search weights and planner settings over seeds, and print what is best as a change of the scene's file.

    The first trial is the scene as it is. A trial is worth the mean time to the goal, failures at least twice the
    timeout; in a scene without success, the mean cost. Ctrl-C ends the search and keeps the best so far.
    """
    from .tune import tune as cli_tune

    raise typer.Exit(
        cli_tune(
            [_arguments(scene, overrides, terms, engine, device) for scene in scenes],
            keys=keys,
            trials=trials,
            seeds=range(seed, seed + episodes),
            jobs=jobs,
            study_file=study,
            out=output,
            contact_penalty=contact_penalty,
        )
    )


@app.command()
def live(
    scene: SceneArgument,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for whoever has the URL.")] = "127.0.0.1",
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    seed: SeedOption = 0,
    engine: EngineOption = "auto",
    device: DeviceOption = "auto",
) -> None:
    """Watch and steer the controller on a page in the browser; Ctrl-C ends it."""
    from .live import live as cli_live

    cli_live(_arguments(scene, overrides, terms, engine, device), host=host, port=port, seed=seed)


def _arguments(scene: str, overrides: list[str], terms: list[Path], engine: str, device: str) -> RunArguments:
    from .setup import RunArguments

    return RunArguments(source=scene, overrides=tuple(overrides), term_files=tuple(terms), engine=engine, device=device)


if __name__ == "__main__":
    main()
