# SPDX-License-Identifier: Apache-2.0
"""Cost terms and ancillary controllers from a user's Python file."""

from __future__ import annotations

import importlib.util
import itertools
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from ..cost.term import UserTerm


class TermsError(ValueError):
    """A file of cost terms that cannot be used."""


def load_terms(files: str | Path | Sequence[str | Path]) -> list[UserTerm]:
    """Execute Python files and collect the cost terms and ancillary controllers they define at module level.

    Args:
        files: Python files, or one of them.

    Returns:
        These, in the order of the files and of the names in them.

    Raises:
        TermsError: If a file cannot be read or executed or defines none, or two of them share a name.
    """
    found: dict[str, UserTerm] = {}
    for path in map(Path, [files] if isinstance(files, str | Path) else files):
        terms = _execute(path, _module_name(path))
        if not terms:
            raise TermsError(
                f'{path}: defines no cost term and no ancillary controller; write one with @warpmpc.cost_term("name")'
            )
        for term in terms:
            if term.name in found:
                raise TermsError(f"{path}: there are two terms called '{term.name}'")
            found[term.name] = term
    return list(found.values())


def _module_name(path: Path) -> str:
    """A module of its own for each file, the same one when it is executed again."""
    names = (f"warpmpc_terms_{number}" for number in itertools.count())
    return next(name for name in names if name not in sys.modules or _same_file(sys.modules[name], path))


def _same_file(module: ModuleType, path: Path) -> bool:
    return module.__file__ == str(path.absolute())


def _execute(path: Path, name: str) -> list[UserTerm]:
    from ..cost.term import UserTerm

    if path.exists() and not path.is_file():
        raise TermsError(f"{path}: cannot be read: is {'a folder' if path.is_dir() else 'no regular file'}")
    try:
        path.read_bytes()
    except OSError as error:
        raise TermsError(f"{path}: cannot be read: {error.strerror}") from error
    spec = importlib.util.spec_from_file_location(name, path.absolute())
    if spec is None:
        raise TermsError(f"{path}: is not a Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Warp looks the globals of functions and structs up there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise TermsError(f"{path}{_line(error, path)}: {type(error).__name__}: {_message(error)}") from error
    unique = {id(value): value for value in vars(module).values() if isinstance(value, UserTerm)}
    return list(unique.values())


def _line(error: BaseException, path: Path) -> str:
    """The line of a user's file that an error comes from, as ``:LINE``."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f":{error.lineno}"
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path.absolute())
    ]
    return f":{lines[-1]}" if lines else ""


def _message(error: BaseException) -> str:
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    return " ".join(text.split())
