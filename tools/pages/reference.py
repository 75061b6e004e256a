# SPDX-License-Identifier: Apache-2.0
"""What the documentation has from the source: keys of scene files and cost terms, commands, the change log."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import get_args, get_origin

import click
import typer.main
from examples import Examples, examples
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from warpmpc import Scene
from warpmpc.cli.main import app
from warpmpc.cost.term import CostTerm
from warpmpc.cost.terms import TERMS
from warpmpc.scene.describe import default, keys, takes, unit

ROOT = Path(__file__).parents[2]

_GROUPS = {
    "general": "Distances, controls, contacts",
    "joints": "Joints",
    "residuals": "Residuals",
    "pushing": "Pushing",
    "grasping": "Picking up",
    "clearance": "Outlines and clearance",
    "arm": "Arms",
    "collision": "Collision, as spheres",
    "cloud": "Point clouds",
    "learned": "Learned",
    "rolling": "Rolling",
}
"""What the modules of the terms are about."""


def bodies() -> dict[str, str]:
    """What follows on pages that say by hand what they are about, in Markdown, by their path."""
    found = examples()
    return {
        "reference/scene.md": "\n".join(_sections(Scene, "", found, {})),
        "reference/terms.md": "\n".join(_terms(found)),
        "reference/commands.md": "\n".join(_commands()),
    }


def changelog() -> str:
    """The change log as a page of the site."""
    return (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")


def _sections(
    section: type[BaseModel], path: str, found: Examples, seen: dict[type, str], head: str = ""
) -> Iterator[str]:
    """A section of a scene file, below its head as a file writes it, and the sections in it."""
    title = path or "the file"
    seen[section] = title
    level = "##" if path.count(".") == 0 else "###"
    yield f"\n{level} {f'`{head}`' if path else 'The file'} {{ #{_anchor(title)} }}\n"
    yield f"{inspect.cleandoc(section.__doc__ or '')}\n"
    yield from _table(section, path)
    yield from _example(section, head, found)
    for key, field in keys(section).items():
        inner = next(_models(field.annotation), None)
        if inner is None:
            continue
        below = f"{path}.{key}".strip(".") + (".NAME" if get_origin(field.annotation) is dict else "")
        inner_head = f"[[{below}]]" if "array" in takes(field) else f"[{below}]"
        if inner in seen:
            level = "##" if "." not in below else "###"
            yield f"\n{level} `{inner_head}` {{ #{_anchor(below)} }}\n"
            yield f"The keys of [`{seen[inner]}`](#{_anchor(seen[inner])}).\n"
        else:
            yield from _sections(inner, below, found, seen, inner_head)


def _anchor(title: str) -> str:
    return title.lower().replace(" ", "-").replace(".", "-")


def _table(section: type[BaseModel], path: str) -> Iterator[str]:
    """The keys of a section; those of tables lead to the tables' own keys."""
    if not keys(section):
        return
    yield "| key | takes | unit | default | meaning |\n|---|---|---|---|---|"
    for key, field in keys(section).items():
        name = f"`{key}`"
        if next(_models(field.annotation), None):
            many = ".NAME" if get_origin(field.annotation) is dict else ""
            name = f"[{name}](#{_anchor(f'{path}.{key}'.strip('.') + many)})"
        cells = (name, takes(field), unit(field), _code(default(field)), _meaning(field))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _example(section: type[BaseModel], head: str, found: Examples, *more: str) -> Iterator[str]:
    """An example of every key of a section that takes values, below its head."""
    lines = [f"{key} = {found[section, key]}" for key in keys(section) if (section, key) in found]
    shown = [line for line in (head, *more, *lines) if line]
    if shown:
        yield "\n```toml\n# one example of each\n" + "\n".join(shown) + "\n```\n"


def _code(text: str) -> str:
    return text if text in ("required", "-") else f"`{text}`"


def _meaning(field: FieldInfo) -> str:
    """What a key means, and what each of its choices does where that is said."""
    text = " ".join((field.description or "").split())
    choices = next((kind for kind in _kinds(field.annotation) if issubclass(kind, StrEnum)), None)
    said = _said(choices) if choices else {}
    return text + "".join(f"<br>`{value}`: {about}" for value, about in said.items())


def _said(choices: type[StrEnum]) -> Mapping[str, str]:
    """What is written below the members of an enumeration, by their values."""
    body = ast.parse(inspect.getsource(choices)).body[0].body
    said = {}
    for line, after in pairwise(body):
        if isinstance(line, ast.Assign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            said[choices[line.targets[0].id].value] = " ".join(after.value.value.split())
    return said


def _kinds(kind: object) -> Iterator[type]:
    """The classes in a type such as ``tuple[Robot, ...] | None``."""
    if isinstance(kind, type) and get_origin(kind) is None:
        yield kind
    for part in get_args(kind):
        yield from _kinds(part)


def _models(kind: object) -> Iterator[type[BaseModel]]:
    return (found for found in _kinds(kind) if issubclass(found, BaseModel))


def _terms(found: Examples) -> Iterator[str]:
    """All built-in cost terms, by their family."""
    groups: dict[str, list[CostTerm]] = {}
    tables: dict[str, type[BaseModel]] = {}
    for term in TERMS.values():
        groups.setdefault((term.written or term.function).func.__module__, []).append(term)
    for module, terms in groups.items():
        name = module.rsplit(".", 1)[-1]
        yield f"\n## {_GROUPS.get(name, name.replace('_', ' ').capitalize())}\n"
        for term in terms:
            yield f"### `{term.name}` {{ #{term.name} }}\n\n{term.summary}\n"
            yield from _table(term.keys, "")
            yield from _example(term.keys, "[[cost]]", found, f'term = "{term.name}"')
            tables |= {key: inner for key, field in keys(term.keys).items() for inner in _models(field.annotation)}
    if tables:
        yield "\n## Tables in cost terms\n"
    for key, inner in tables.items():
        yield f"\n### `{key}` {{ #{_anchor(key)} }}\n\n{inspect.cleandoc(inner.__doc__ or '')}\n"
        yield from _table(inner, "")
        yield from _example(inner, f"[cost.{key}]", found)


def _commands() -> Iterator[str]:
    """The commands with their arguments and options."""
    program = typer.main.get_command(app)
    context = click.Context(program, info_name="warpmpc")
    for name, command in program.commands.items():
        inner = click.Context(command, info_name=name, parent=context)
        usage = " ".join(piece.strip("{}") for piece in command.collect_usage_pieces(inner))
        yield f"\n## `{name}`\n\n```text\nwarpmpc {name} {usage}\n```\n\n{inspect.cleandoc(command.help or '')}\n"
        rows = [record for param in command.params if (record := _parameter(param, inner))]
        if rows:
            yield "| option | meaning |\n|---|---|"
            yield from (f"| `{option}` | {meaning.replace('|', chr(92) + '|')} |" for option, meaning in rows)


def _parameter(param: click.Parameter, context: click.Context) -> tuple[str, str] | None:
    if param.param_type_name == "argument":
        return param.metavar or param.name.upper(), getattr(param, "help", None) or ""
    return param.get_help_record(context)
