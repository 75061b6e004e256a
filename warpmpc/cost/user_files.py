# SPDX-License-Identifier: Apache-2.0
"""Users' Python files: what they define and register, and errors of their terms with the line of the file."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import itertools
import re
import sys
import textwrap
import traceback
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING

from ..scene.errors import SceneError
from ..scene.registry import ENGINES, ROBOTS, STRATEGIES, TERMS
from .kernel import GENERATED
from .term import ArrayCost, CostTerm, UserTerm

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from types import ModuleType


class TermsError(ValueError):
    """A file of cost terms that cannot be used."""


def load_terms(files: str | Path | Sequence[str | Path]) -> list[UserTerm]:
    """Execute Python files and collect the cost terms and ancillary controllers they define at module level.

    Terms that a file registers in ``warpmpc.scene.registry.TERMS`` are among them, under the names they are registered
    by, and not registered: they hold where the returned list is handed over. Strategies, engines and robots that it
    registers stay, in place of those that the same file registered before.

    Args:
        files: Python files, or one of them.

    Returns:
        These, in the order of the files and of the names in them.

    Raises:
        TermsError: If a file cannot be read or executed or brings nothing, or two terms share a name.
    """
    found: dict[str, UserTerm] = {}
    for path in map(Path, [files] if isinstance(files, str | Path) else files):
        terms, others = _execute(path, _module_name(path))
        if not terms and not others:
            raise TermsError(
                f"{path}: defines no cost term and no ancillary controller and registers nothing; write a term with "
                '@warpmpc.cost_term("name")'
            )
        for term in terms:
            if term.name in found:
                raise TermsError(f"{path}: there are two terms called '{term.name}'")
            found[term.name] = term
    return list(found.values())


def _module_name(path: Path) -> str:
    """A separate module for each file, the same one when it is executed again."""
    names = (f"warpmpc_terms_{number}" for number in itertools.count())
    return next(name for name in names if name not in sys.modules or _same_file(sys.modules[name], path))


def _same_file(module: ModuleType, path: Path) -> bool:
    return Path(module.__file__ or "").resolve() == path.resolve()


def _execute(path: Path, name: str) -> tuple[list[UserTerm], list[str]]:
    """Cost terms and ancillary controllers that a file defines, and names of all else that it registers."""
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
        with TERMS.apart() as registered, ExitStack() as stack:
            others = [stack.enter_context(each.replaced(str(path.resolve()))) for each in (ENGINES, STRATEGIES, ROBOTS)]
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise TermsError(f"{path}{_line(error, path)}: {type(error).__name__}: {_message(error)}") from error
    own = [value for value in (*vars(module).values(), *registered.values()) if isinstance(value, UserTerm)]
    names = {id(term): name for name, term in registered.items()}
    terms = {id(term): replace(term, name=names.get(id(term), term.name)) for term in own}
    return list(terms.values()), [name for found in others for name in found]


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


_PLACE = re.compile(r'Error while parsing function "[^"]*" at (.+?):(\d+):\s*(.*?)(?=;|$)', re.DOTALL)
"""Where Warp was when it met a mistake: file, line, source."""
_CALL = re.compile(r"(term|advance)(\d+)\(s")
"""How generated code calls the function of a term."""


def functions(term: CostTerm | ArrayCost) -> list[Callable]:
    """Python functions that a user wrote for a term."""
    if isinstance(term, ArrayCost):
        return [term.function]
    written = (term.written or term.function, term.advance)
    return [warp_function.func for warp_function in written if warp_function is not None]


def place(function: Callable, line: int | None = None) -> str:
    """``FILE:LINE`` of a function, or of a line in its file."""
    code = getattr(function, "__code__", None)
    if code is None:  # an object that can be called
        return type(function).__name__
    return f"{code.co_filename}:{line or code.co_firstlineno}"


def complaint(
    label: str, term: CostTerm | ArrayCost, what: str, *, file: Path | None, where: str | None = None
) -> SceneError:
    """The error about a user's term.

    Args:
        label: What the scene calls it.
        term: The term.
        what: What is wrong.
        file: Scene file.
        where: Place in the user's file; where the term's function begins if None.
    """
    return SceneError(f"{where or place(functions(term)[0])}: {what}", key=f"cost.{label}", file=file)


def raised_at(error: Exception, function: Callable) -> str:
    """``FILE:LINE`` where an exception left a user's function, or what that function called in its file."""
    name = getattr(getattr(function, "__code__", None), "co_filename", None)
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == name]
    return place(function, lines[-1] if lines else None)


def raised(error: Exception, label: str, term: ArrayCost, *, file: Path | None) -> SceneError:
    """The error for an exception that left the function of a term over whole arrays."""
    what = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return complaint(label, term, what, file=file, where=raised_at(error, term.function))


def refused(
    error: Exception, labels: Sequence[str], terms: Sequence[CostTerm | ArrayCost], *, file: Path | None
) -> SceneError | None:
    """The error for what Warp said while it compiled terms; None when it is not about a user's function.

    Args:
        error: What Warp raised.
        labels: What the scene calls the terms.
        terms: The terms.
        file: Scene file.
    """
    said = str(error.args[0] if error.args else error)
    places = _PLACE.findall(said)
    called = next((call for *_, text in places if (call := _CALL.search(text))), None)
    if called is None:
        return None
    reason, i = " ".join(said.rpartition(";")[2].split()), int(called[2])
    own = [f"{source}:{line}" for source, line, _ in places if not source.startswith(GENERATED)]
    if own:
        return complaint(labels[i], terms[i], f"Warp cannot compile this: {reason}", file=file, where=own[-1])
    return complaint(labels[i], terms[i], f"a cost term returns one float; Warp says: {reason}", file=file)


def require_returns(label: str, term: CostTerm, *, file: Path | None) -> None:
    """A term, and what it calls in its file, return a value on every way through; Warp leaves that to a C++ compiler.

    Raises:
        SceneError: If one may end without.
    """
    own = functions(term)[0]
    for function in _called(own, {}):
        try:
            (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        except (OSError, SyntaxError, ValueError):
            continue  # no source to look at: Warp will say so
        whole = isinstance(definition, ast.FunctionDef) and not _returns(definition.body)
        if whole and (function is own or function.__annotations__.get("return") is not None):
            what = "this function can end without returning a value: return one at its end"
            raise complaint(label, term, what, file=file, where=place(function))


def _called(function: FunctionType, found: dict[int, FunctionType]) -> Iterable[FunctionType]:
    """A Warp function's Python function, and those of its file that it calls."""
    found[id(function)] = function
    for name in function.__code__.co_names:
        value = getattr(function.__globals__.get(name), "func", None)
        ours = isinstance(value, FunctionType) and value.__code__.co_filename == function.__code__.co_filename
        if ours and id(value) not in found:
            _called(value, found)
    return found.values()


def _returns(body: Iterable[ast.stmt]) -> bool:
    """Return whether statements never end without a value returned."""
    for statement in body:
        if isinstance(statement, ast.Return) and statement.value is not None:
            return True
        if isinstance(statement, ast.If) and _returns(statement.body) and _returns(statement.orelse):
            return True
    return False
