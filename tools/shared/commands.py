# SPDX-License-Identifier: Apache-2.0
"""A command whose subcommands are the modules of a package, each with ``main(arguments)``."""

from __future__ import annotations

import ast
import importlib
import signal
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

FOLDER = Path(__file__).parents[1]


def subcommands(package: str) -> dict[str, str]:
    """Names of a package's subcommands, with the first sentence of what each says of itself."""
    files = sorted(file for file in (FOLDER / package).glob("*.py") if file.stem != "__init__")
    texts = {file.stem: ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) for file in files}
    return {name: text.split("\n\n")[0].replace("\n", " ") for name, text in texts.items()}


def run(package: str, about: str, arguments: list[str]) -> int:
    """Run a subcommand, or say which there are.

    Returns:
        The exit code: the subcommand's own, else 0; 1 when an episode's process died every time, 2 for bad input, 130
        for Ctrl-C, 143 where it is terminated, which ends what it started, too.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    found, program = subcommands(package), Path(sys.argv[0]).name
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help"):
        width = max(map(len, found))
        print(about, f"usage: {program} SUBCOMMAND ...; SUBCOMMAND --help tells more", "", sep="\n")
        print(*(f"  {key:{width}}  {text}" for key, text in found.items()), sep="\n")
        return 0
    if name not in found:
        print(f"error: no subcommand '{name}'; there is: {', '.join(found)}", file=sys.stderr)
        return 2
    sys.argv[0] = f"{program} {name}"
    try:
        return importlib.import_module(f"{package}.{name}").main(arguments[1:]) or 0
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if not isinstance(error, BrokenProcessPool | ValueError | OSError):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, BrokenProcessPool) else 2
