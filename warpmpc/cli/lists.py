# SPDX-License-Identifier: Apache-2.0
"""Commands that print what there is: scenes, cost terms, keys of scene files, and their schema.

``warpmpc new``, a folder with a scene, a robot, a cost term and a loop that run as they are; the schema in it.
"""

from __future__ import annotations

import json
import shutil
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_origin

import typer

from ..physics.runtime.files import writing
from .setup import SceneArgument, TermsOption
from .terminal import headline, say

if TYPE_CHECKING:
    from pydantic import BaseModel as Section
    from pydantic.fields import FieldInfo

    from ..cost.term import ArrayCost, CostTerm

# what takes long to import is imported where it is used, as in main.py

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


def show(scene: SceneArgument) -> None:
    """Print a scene's file, such as a shipped one to begin with; with SCENE:VARIANT, the scene with the variant."""
    from ..scene.load import dump_scene, load_scene
    from .setup import user_errors

    with user_errors():
        found = load_scene(scene)
        text = dump_scene(found) if found.variant else found.path.read_text(encoding="utf-8")
    say(text, end="")


def terms(
    names: Annotated[
        list[str], typer.Argument(metavar="[NAME...]", help="Terms to describe; a line for each term when left out.")
    ] = [],  # noqa: B006
    terms: TermsOption = [],  # noqa: B006
) -> None:
    """List cost terms, a line each; for those that are named, meaning, keys and an example."""
    from ..scene.errors import SceneError
    from ..scene.registry import TERMS
    from .setup import start_warp, user_errors

    start_warp()
    from ..cost.term import ArrayCost, CostTerm
    from ..cost.user_files import load_terms

    with user_errors():
        own = {term.name: term for term in load_terms(terms) if isinstance(term, CostTerm | ArrayCost)}
        known = {**TERMS, **own}
        for name in names:
            if name not in known:
                raise SceneError("no such cost term", found=name, allowed=known)
    for name in names:
        _print_term(known[name])
    if not names:
        wide = max(map(len, known)) + 2
        for name, term in known.items():
            summary = term.summary.replace("``", "`") or "..."
            say(f"{name:{wide}}{textwrap.shorten(summary, WIDTH - wide, placeholder=' ...')}")
        say("\nwarpmpc terms NAME describes one and its keys.")
    _echo("Every [[cost]] table also has a weight (default 1.0), and a name if a term is used twice.", "")
    _echo("A frame is robot/frame, robot/link, an object, an obstacle or goal.", "")


def robots(
    names: Annotated[list[str], typer.Argument(metavar="[NAME...]", help="Drivers; all when left out.")] = [],  # noqa: B006
) -> None:
    """List drivers of robots: where they come from, what they need; for those that are named, the keys of their files.

    A driver is chosen by warpmpc run --real-time --robot NAME, with its file by NAME:FILE.toml.
    """
    from ..scene.registry import ROBOTS
    from .setup import start_warp, user_errors

    start_warp()
    for name in names or ROBOTS:
        try:
            with user_errors():
                driver, origin = ROBOTS.find(name), ROBOTS.origin(name)
        except typer.Exit:
            if names:
                raise
            continue  # the others are there
        headline(name, f" (from {origin})")
        _echo(getattr(driver, "summary", None) or (driver.__doc__ or "").partition("\n\n")[0], "  ")
        if missing := getattr(driver, "missing", None):
            _echo(missing, "  ")
        if name in names and (section := getattr(driver, "settings", None)):
            _print_section(section)
            for head, below in _tables(section, ""):
                headline(head)
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
        headline(head)
        _print_section(section)
        if table == "cost":
            say("  Each term also has its own keys: warpmpc terms NAME.")


def schema() -> None:
    """Print the JSON Schema of scene files, with which editors complete and check them."""
    from .setup import start_warp

    start_warp()

    say(schema_text(), end="")


def _print_term(term: CostTerm | ArrayCost) -> None:
    from ..scene.describe import keys

    headline(term.name)
    _echo(term.summary, "  ")
    for name, field in keys(term.keys).items() if getattr(term, "keys", None) else ():
        _print_key(name, field, indent="  ")
    own = {} if getattr(term, "keys", None) else getattr(getattr(term, "params", None), "vars", {})
    for name, field in own.items():  # of a struct
        kind = {"float32": "number", "int32": "name or whole number"}.get(field.type.__name__, field.type.__name__)
        _echo(f"{name} = {kind}; required", "  ")
    say("")
    for line in _example(term.name):
        say(f"    {line}")
    say("")


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
        say(line)


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
        headline(head)
        _echo((section.__doc__ or "").partition("\n\n")[0], "    ")
    say("\nwarpmpc keys TABLE, such as planner.noise, has the keys of one.")


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
    """Path of the table of a key; tables by name have their own."""
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


STARTER = Path(__file__).parent / "starter"
"""The files, but for the schema, which is that of this version."""
SCHEMA = "scene.schema.json"


def make_starter(folder: Path) -> list[str]:
    """Write the starter into a new or empty folder.

    Args:
        folder: Where; it is made if there is none.

    Returns:
        The names of the files.

    Raises:
        ValueError: If there is something in the way.
        Unwritable: If it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: is a file; name a folder that is empty or not there yet")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder}: is not empty; name a folder that is empty or not there yet")
    names = sorted(file.name for file in STARTER.iterdir() if file.is_file())
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            shutil.copyfile(STARTER / name, folder / name)
        (folder / SCHEMA).write_text(schema_text(), encoding="utf-8")
    return [*names, SCHEMA]


def schema_text() -> str:
    """The JSON Schema of scene files, built-in cost terms included, as JSON."""
    from ..cost.terms import TERMS
    from ..scene.describe import scene_json_schema  # slow to import: a folder in the way is told at once

    terms = {name: (term.keys, term.summary) for name, term in TERMS.items()}
    return json.dumps(scene_json_schema(terms), indent=2, ensure_ascii=False) + "\n"
