# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SceneArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        help="Shipped scene (see warpmpc scenes) or TOML file; SCENE:A or SCENE:A+B for variants of it.",
    ),
]
SetOption = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="Change the scene, such as planner.samples=500; repeatable."),
]
LAST_SEED = 2**28
"""Largest seed; the kernels' seeds derived from it stay 32-bit integers."""
SeedOption = Annotated[int, typer.Option(min=0, max=LAST_SEED, help="Seed of the episode.")]
TermsOption = Annotated[
    list[Path],
    typer.Option("--terms", metavar="FILE.py", help="Python file with cost terms of your own; it is executed."),
]
