# SPDX-License-Identifier: Apache-2.0
"""The command ``warpmpc robot``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import SceneArgument, SeedOption, SetOption, TermsOption


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
    delay: Annotated[
        str, typer.Option(metavar="MS|LOW..HIGH", help="Delay of each message, both ways; drawn between the two.")
    ] = "0",
    drop: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of messages that is lost, both ways.")] = 0.0,
    reorder: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of messages that the next ones overtake, both ways.")
    ] = 0.0,
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
    link = {"delay": delay, "drop": drop, "reorder": reorder}
    raise typer.Exit(cli_robot(arguments, transport=transport, seed=seed, speed=speed, seconds=seconds, link=link))
