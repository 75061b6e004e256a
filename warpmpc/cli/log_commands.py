# SPDX-License-Identifier: Apache-2.0
"""Commands for what runs have left: replay, diagnose, plot, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import TermsOption

RunPathArgument = Annotated[
    Path, typer.Argument(metavar="PATH", help="What warpmpc run --out or --npz wrote: a folder, .npz or .runlog.")
]


def replay(
    path: RunPathArgument,
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Plan again what was logged, and verify that the same commands come out, bit for bit.

    Exit code 0 when they do, 1 when one differs, 2 for wrong input.
    """
    from .replay import replay as cli_replay

    raise typer.Exit(cli_replay(path, term_files=terms))


def diagnose(
    path: RunPathArgument,
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """Find why states that the planner foresaw are not those that came.

    Rolls the controls that were sent out again as the planner foresaw them, with one thing changed at a time: physics
    step, solver, properties, delay, noise, engine. Prints the error of the states with and without each change, the
    cause and its cure.
    """
    from .diagnose import diagnose as cli_diagnose

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
    from .plot import plot as cli_plot

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
    minari: Annotated[
        str | None, typer.Option(metavar="NAME-v0", help="A new data set of Minari, in its local folder.")
    ] = None,
) -> None:
    """Write a run in the formats of others; pip install "warpmpc[export]".

    Failed episodes are in the data sets, too, marked as such.
    """
    from .export import export as cli_export

    raise typer.Exit(cli_export(path, mcap=mcap, hdf5=hdf5, minari=minari))
