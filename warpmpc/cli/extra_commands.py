# SPDX-License-Identifier: Apache-2.0
"""Commands that need the extras: check, replay, diagnose, plot, export, tune, live.

``warpmpc live``: a session is built and its page served.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .interrupts import Interrupts
from .setup import (
    LAST_SEED,
    DeviceOption,
    EngineOption,
    RunArguments,
    SceneArgument,
    SeedOption,
    SetOption,
    TermsOption,
    begin,
    run_arguments,
    user_errors,
)
from .terminal import say

if TYPE_CHECKING:
    from ..extras.live.page import Access

RunPathArgument = Annotated[
    Path, typer.Argument(metavar="PATH", help="What warpmpc run --out or --npz wrote: a folder, .npz or .runlog.")
]


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

    arguments = run_arguments(scene, overrides, terms, engine, device)
    if robot is not None:
        from .robot import listen

        raise typer.Exit(listen(arguments, robot))
    raise typer.Exit(cli_run.check(arguments, seed=seed, measure=measure))


def replay(
    path: RunPathArgument,
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Plan again what was logged, and verify that the same commands come out, bit for bit.

    Exit code 0 when they do, 1 when one differs, 2 for wrong input.
    """
    from .run_logs import replay as cli_replay

    raise typer.Exit(cli_replay(path, term_files=terms))


def diagnose(
    path: RunPathArgument,
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Find why the planner's predictions were wrong.

    Rolls the controls that were sent out again as the planner predicted them, with one thing changed at a time: physics
    step, solver, properties, delay, noise, engine. Prints the error of the states with and without each change, the
    cause and its cure.
    """
    from .run_logs import diagnose as cli_diagnose

    raise typer.Exit(cli_diagnose(path, term_files=terms))


def plot(
    path: RunPathArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR|FILE.png",
            help="Folder for the files, beside or in PATH when left out; or one picture with path, costs, controls "
            "and errors.",
        ),
    ] = None,
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Draw a run: its path, costs, controls, plan times, errors and forces as PNG, all numbers as CSV."""
    from .run_logs import plot as cli_plot

    raise typer.Exit(cli_plot(path, out=out, term_files=terms))


def export(
    path: RunPathArgument,
    mcap: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.mcap",
            help="Joint states, tf, commands, costs and plans as ROS 2 messages, for Foxglove and ros2 bag; several "
            "episodes put their seed into the name.",
        ),
    ] = None,
    hdf5: Annotated[
        Path | None,
        typer.Option(metavar="FILE.hdf5", help="A new data set of observations and actions as robomimic reads it."),
    ] = None,
) -> None:
    """Write a run in the formats of others; pip install "warpmpc[export]".

    Failed episodes are in the data set, too, marked as such.
    """
    from .outputs import export as cli_export

    raise typer.Exit(cli_export(path, mcap=mcap, hdf5=hdf5))


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

    The first trial is the scene as it is. A trial is worth the mean time to the goal, at least twice the timeout where
    it is not reached, more where the run fails; in a scene without success, the mean cost. The best one passes at
    least as often as the first. Ctrl-C ends the search and keeps the best so far.
    """
    from .tune import tune as cli_tune

    raise typer.Exit(
        cli_tune(
            [run_arguments(scene, overrides, terms, engine, device) for scene in scenes],
            keys=keys,
            trials=trials,
            seeds=range(seed, seed + episodes),
            jobs=jobs,
            study_file=study,
            out=output,
            contact_penalty=contact_penalty,
        )
    )


def live(
    scene: SceneArgument,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for all who have the URL.")] = "127.0.0.1",
    overrides: SetOption = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
    seed: SeedOption = 0,
    engine: EngineOption = "auto",
    device: DeviceOption = "auto",
) -> None:
    """Watch and steer the controller on a page in the browser; Ctrl-C ends it."""
    _serve(run_arguments(scene, overrides, terms, engine, device), host=host, port=port, seed=seed)


NEEDED = ("viser", "tomlkit")
"""Packages of the extra ``live``."""


def _serve(arguments: RunArguments, *, host: str, port: int, seed: int) -> None:
    """Serve a scene's page until Ctrl-C or SIGTERM."""
    with Interrupts(), user_errors():
        missing = [name for name in NEEDED if find_spec(name) is None]
        if missing:
            raise ValueError(f"the page needs {' and '.join(missing)}: pip install 'warpmpc[live]'")
        from ..extras.live.page import Access, require_port, serve
        from ..extras.live.session import Session

        require_port(host, port)
        scene, terms = arguments.load()
        begin(scene, arguments.device, say=partial(say, out=sys.stderr), quick=True)
        try:
            options = {"engine": arguments.engine, "device": arguments.device, "terms": terms}
            session = Session(arguments.source, overrides=arguments.overrides, seed=seed, **options)
            access = Access(host, port)
            serve(session, access, ready=lambda: _say_where(access))
        except KeyboardInterrupt:
            say("ended")


def _say_where(access: Access) -> None:
    say(f"{access.url}  (Ctrl-C ends it)")
    if not access.local:
        say("Other machines can reach this page: anyone with this URL and its token can use it. Not encrypted.")
