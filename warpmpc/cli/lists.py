# SPDX-License-Identifier: Apache-2.0
"""Commands that print what there is: scenes, cost terms, keys of scene files, and their schema."""

from __future__ import annotations

import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_origin

import typer

# what takes long to import is imported where it is used, as in main.py
if TYPE_CHECKING:
    from pydantic import BaseModel as Section
    from pydantic.fields import FieldInfo

    from ..cost.term import CostTerm

EXAMPLES = Path(__file__).parent / "examples.toml"
"""A scene that has every key that no shipped one has; it is not meant to be run."""
WIDTH = 80
"""Width of what is printed, but for the table of scenes."""


def scenes() -> None:
    """List the scenes that come with warpmpc."""
    from .report import print_scenes
    from .setup import user_errors

    with user_errors():
        print_scenes()


def terms(
    names: Annotated[list[str], typer.Argument(metavar="[NAME...]", help="Terms; all when left out.")] = [],  # noqa: B006
) -> None:
    """Describe cost terms: meaning and keys; for those that are named, an example too."""
    from ..scene.errors import SceneError
    from .setup import start_warp, user_errors

    start_warp()
    from ..terms import TERMS

    with user_errors():
        for name in names:
            if name not in TERMS:
                raise SceneError("no such cost term", found=name, allowed=TERMS)
    for name in names or TERMS:
        _print_term(TERMS[name], example=name in names)
    _echo("Every [[cost]] table has a weight besides (1.0 when left out), and a name where one term is used twice.", "")
    _echo("A frame is robot/frame, robot/link, an object, an obstacle or goal.", "")


def robots(
    names: Annotated[list[str], typer.Argument(metavar="[NAME...]", help="Drivers; all when left out.")] = [],  # noqa: B006
) -> None:
    """List drivers of robots: where they come from, what they need; for those that are named, the keys of their files.

    A driver is chosen by warpmpc run --real-time --robot NAME, with its file by NAME:FILE.toml.
    """
    from ..registry import ROBOTS
    from .setup import start_warp, user_errors

    start_warp()
    for name in names or ROBOTS:
        with user_errors():
            driver, origin = ROBOTS.find(name), ROBOTS.origin(name)
        typer.echo(f"{typer.style(name, bold=True)} (from {origin})")
        _echo(getattr(driver, "summary", None) or (driver.__doc__ or "").partition("\n\n")[0], "  ")
        if missing := getattr(driver, "missing", None):
            _echo(missing, "  ")
        if name in names and (section := getattr(driver, "settings", None)):
            _print_section(section)
            for head, below in _tables(section, ""):
                typer.echo(typer.style(head, bold=True))
                _print_section(below)


def keys(
    table: Annotated[
        str, typer.Argument(metavar="[TABLE]", help="Table or key of a scene file, such as planner.noise.")
    ] = "",
) -> None:
    """Describe the keys of a table of scene files: type, default, meaning; without TABLE, list the tables."""
    from ..scene.schema import Scene
    from .setup import user_errors

    if not table:
        _print_tables(Scene)
        return
    with user_errors():
        head, section, field = _find(table)
    if field is not None:
        _print_key(table.rpartition(".")[2], field, indent="")
    if section is not None:
        typer.echo(typer.style(head, bold=True))
        _print_section(section)
        if table == "cost":
            typer.echo("  Each term has keys of its own: warpmpc terms NAME.")


def schema() -> None:
    """Print the JSON Schema of scene files, with which editors complete and check them."""
    from .setup import start_warp

    start_warp()
    from .schema import schema_text

    typer.echo(schema_text(), nl=False)


def _print_term(term: CostTerm, *, example: bool) -> None:
    typer.echo(typer.style(term.name, bold=True))
    _echo(term.summary, "  ")
    for name, field in term.keys.model_fields.items():
        _print_key(name, field, indent="  ")
    if example:
        typer.echo()
        for line in _example(term.name):
            typer.echo(f"    {line}")
    typer.echo()


def _print_section(section: type[Section]) -> None:
    from ..scene.describe import keys

    _echo(section.__doc__ or "", "  ")
    for name, field in keys(section).items():
        _print_key(name, field, indent="  ")


def _print_key(name: str, field: FieldInfo, *, indent: str) -> None:
    """Print a key: a line of what it takes, then its meaning."""
    from ..scene.describe import default, takes

    left_out = default(field)
    if left_out not in ("required", "-"):
        left_out = f"default {left_out}"
    facts = takes(field) + (f"; {left_out}" if left_out != "-" else "")
    _echo(f"{name} = {facts}", indent, hanging=indent + "        ")
    _echo(field.description or "", indent + "    ")


def _echo(text: str, indent: str, *, hanging: str | None = None) -> None:
    """Print a text in lines of :data:`WIDTH`."""
    text = " ".join(text.replace("``", "`").split())
    for line in textwrap.wrap(
        text, WIDTH, initial_indent=indent, subsequent_indent=hanging or indent, break_on_hyphens=False
    ):
        typer.echo(line)


def _example(name: str) -> list[str]:
    """A ``[[cost]]`` table of a term: the first in the shipped scenes, in examples, or its name alone."""
    from ..scene.describe import written
    from ..scene.load import shipped_scenes

    for file in (*shipped_scenes().values(), EXAMPLES):
        for cost in tomllib.loads(file.read_text(encoding="utf-8")).get("cost", ()):
            if cost["term"] == name:
                where = "" if file == EXAMPLES else f"    # as in {file.stem}"
                return [f"[[cost]]{where}", *(f"{key} = {written(value)}" for key, value in cost.items())]
    return ["[[cost]]", f'term = "{name}"']


def _print_tables(root: type[Section]) -> None:
    for head, section in _tables(root, ""):
        typer.echo(typer.style(head, bold=True))
        _echo((section.__doc__ or "").partition("\n\n")[0], "    ")
    typer.echo("\nwarpmpc keys TABLE, such as planner.noise, has the keys of one.")


def _tables(section: type[Section], path: str, seen: tuple[type, ...] = ()) -> Iterator[tuple[str, type[Section]]]:
    """Tables in a section and below, as a file heads them; one that is of its own kind is not followed."""
    from ..scene.describe import keys
    from ..scene.errors import section_in

    for name, field in keys(section).items():
        inner = section_in(field.annotation)
        if inner is not None and inner not in seen:
            below = _below(path, name, field)
            yield _head(below, field), inner
            yield from _tables(inner, below, (*seen, inner))


def _below(path: str, name: str, field: FieldInfo) -> str:
    """Path of the table of a key; tables by name have one of their own."""
    return f"{path}.{name}".strip(".") + (".NAME" if get_origin(field.annotation) is dict else "")


def _head(path: str, field: FieldInfo) -> str:
    from ..scene.describe import takes

    return f"[[{path}]]" if "array" in takes(field) else f"[{path}]"


def _find(path: str) -> tuple[str, type[Section] | None, FieldInfo | None]:
    """Table or key at a dotted path; names of robots, objects and others may stand in it.

    Returns:
        Head of the table, its section, and the field of a key that takes values.

    Raises:
        SceneError: If there is none.
    """
    from ..scene.describe import keys, takes
    from ..scene.errors import SceneError, file_keys, section_in
    from ..scene.schema import Scene

    section, field, at, parts = Scene, None, "", path.strip("[]").split(".")
    for i, part in enumerate(parts):
        there: Mapping[str, FieldInfo] = keys(section) if section else {}
        if part not in there and field is not None and "table" in takes(field) and (i + 1 < len(parts)):
            continue  # the name of a robot, an object, a frame
        if part not in there:
            key = ".".join(parts[:i]) or None
            raise SceneError("unknown key", key=key, found=part, allowed=file_keys(section) if section else ())
        field = there[part]
        section, at = section_in(field.annotation), _below(at, part, field)
    kinds = takes(field).split(" or ")
    return _head(at, field), section, None if kinds[0] in ("table", "tables by name", "array of tables") else field
