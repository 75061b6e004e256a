# SPDX-License-Identifier: Apache-2.0
"""Cost terms and ancillary controllers from a user's Python file."""

from __future__ import annotations

import importlib.util
import itertools
import shlex
import sys
import traceback
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..registry import TERMS
from .run_folder import terms_in

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from ..cost.term import UserTerm
    from ..scene.schema import Scene


class TermsError(ValueError):
    """A file of cost terms that cannot be used."""


class FolderTerms:
    """Cost terms and ancillary controllers of runs that are read again.

    Files in a run's folder are programs of whoever made it: they are executed if a scene needs them and somebody at a
    terminal says so, or if they were given.

    Args:
        path: A run log or a run's folder.
    """

    def __init__(self, path: Path, given: Sequence[Path]):
        self._path, self._files, self._terms = path, [*given], None

    def of(self, scene: Scene, *, planned: bool) -> list[UserTerm]:
        """Return those that a scene needs.

        Args:
            planned: Whether plans are made; else what success, failures and phases look at is needed alone.

        Raises:
            TermsError: If files cannot be used, or are those of the folder and may not be executed.
        """
        missing = [] if self._files else _own(scene, planned=planned)
        if missing:
            self._files = _allowed(self._path, terms_in(self._path), missing)
        if self._terms is None and self._files:
            self._terms = load_terms(self._files)
        return self._terms or []


def _own(scene: Scene, *, planned: bool) -> list[str]:
    """Names of a scene's terms and ancillary controllers that warpmpc does not have."""
    labelled = zip(scene.cost_labels, scene.cost, strict=True)
    used = [cost.term for label, cost in labelled if planned or label in scene.watched_terms]
    used += [row.function for row in scene.planner.ancillary if planned and row.function is not None]
    return sorted({*used} - {*TERMS})


def _allowed(path: Path, files: list[Path], missing: list[str]) -> list[Path]:
    """Files of a folder that may be executed: all of them, once somebody has said so.

    Raises:
        TermsError: If nobody has.
    """
    if not files:
        return []
    what, names = ", ".join(missing), ", ".join(repr(str(file)) for file in files)
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{path}: its scene needs {what}. These files are programs: {names}", file=sys.stderr)
        print("Execute them? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return files
    cure = " ".join(f"--terms {shlex.quote(str(file))}" for file in files)
    raise TermsError(f"{path}: its scene needs {what}; files of it are not executed unasked: look at them, then {cure}")


def load_terms(files: str | Path | Sequence[str | Path]) -> list[UserTerm]:
    """Execute Python files and collect the cost terms and ancillary controllers they define at module level.

    Terms that a file registers in ``warpmpc.registry.TERMS`` are among them, under the names they are registered by,
    and not registered: they hold where the returned list is handed over.

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
        with TERMS.apart() as registered:
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise TermsError(f"{path}{_line(error, path)}: {type(error).__name__}: {_message(error)}") from error
    own = [value for value in (*vars(module).values(), *registered.values()) if isinstance(value, UserTerm)]
    names = {id(term): name for name, term in registered.items()}
    return list({id(term): replace(term, name=names.get(id(term), term.name)) for term in own}.values())


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
