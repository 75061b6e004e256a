# SPDX-License-Identifier: Apache-2.0
"""A command whose subcommands are the modules of a package that have ``main(arguments)``, in its folders, too."""

from __future__ import annotations

import ast
import importlib
import signal
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

FOLDER = Path(__file__).parents[1]


def modules(package: str) -> dict[str, str]:
    """Modules of a package's subcommands, by name."""
    files = {file.stem: file for pattern in ("*.py", "*/*.py") for file in (FOLDER / package).glob(pattern)}
    found = {name: file for name, file in sorted(files.items()) if _has_main(ast.parse(file.read_text("utf-8")))}
    return {name: ".".join(file.relative_to(FOLDER).with_suffix("").parts) for name, file in found.items()}


def _has_main(tree: ast.Module) -> bool:
    return any(isinstance(node, ast.FunctionDef) and node.name == "main" and node.args.args for node in tree.body)


def subcommands(package: str) -> dict[str, str]:
    """Names of a package's subcommands, with the first sentence of what each says of itself."""
    files = {name: FOLDER.joinpath(*module.split(".")).with_suffix(".py") for name, module in modules(package).items()}
    texts = {name: ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) for name, file in files.items()}
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
        return importlib.import_module(modules(package)[name]).main(arguments[1:]) or 0
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if not isinstance(error, BrokenProcessPool | ValueError | OSError):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, BrokenProcessPool) else 2
