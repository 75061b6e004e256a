# SPDX-License-Identifier: Apache-2.0
"""Names that pages have in code marks and in blocks of commands and TOML, and a search for them."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from types import UnionType
from typing import Annotated, Union, get_args, get_origin

import typer.main
from pages import ROOT, blocks
from pydantic import BaseModel

from warpmpc import Scene
from warpmpc.cli.main import app
from warpmpc.cost.terms import TERMS
from warpmpc.scene.describe import keys
from warpmpc.scene.registry import ROBOTS

FOREIGN = frozenset(
    [
        "actearly",
        "actuatorgravcomp",
        "actuation",
        "extension",
        "diagexact",
        "ipc",
        "nativeccd",
        "refsite",
        "solreffriction",
        "statistic",
        "surfacevel",
        "tactile",
        "transmission",
    ]  # MJCF
    + ["body_geom", "body_joint", "body_site", "gyro_imu", "Class", "Keys", "Kind"]  # examples of names
    + ["Changelog", "Documentation", "Repository", "Unreleased", "project", "repo_url", "urls"]  # of projects
    + ["SameSite", "Strict", "pipx", "pypi"]
)
"""Words of MJCF and of other programs."""
OPTIONS = {"--head", "--address", "--no-deps", "--version", "--help", "--strict", "--dist", "--from", "--site-dir"}
"""Options of other programs."""
FILE = re.compile(r"\.(?:py|toml|md|h|json|xml|urdf|npz|npy|csv|yml|png|webp|cff|onnx|rrd|jsonl|whl)$")
WORD = re.compile(r"[A-Za-z_]\w*")
PLACEHOLDER = re.compile(r"[A-Z][A-Z_]*s?")


@cache
def repository() -> tuple[str, ...]:
    """Paths of all files, from the checkout's root, and of all folders."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    files = [path for path in listed if path and (ROOT / path).exists()]
    folders = {str(parent) for path in files for parent in (ROOT / path).relative_to(ROOT).parents}
    return (*files, *folders)


@cache
def vocabulary() -> frozenset[str]:
    """Names that the sources define or write as text, keys and names of scenes, cost terms, commands, packages."""
    known = {*FOREIGN, *TERMS}
    for path in repository():
        text = (ROOT / path).read_text(encoding="utf-8") if FILE.search(path) and path.endswith((".py", ".h")) else ""
        if path.endswith(".py") and not path.startswith("tests/test"):
            known |= set(_names(ast.parse(text)))
        elif path.endswith(".h"):
            known |= set(WORD.findall(text))
        elif path.startswith("scenes/") and path.endswith((".toml", ".xml", ".urdf")):
            known |= set(WORD.findall((ROOT / path).read_text(encoding="utf-8")))
        known |= set(WORD.findall(path))
    known |= set(WORD.findall((ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    return frozenset(known | section_keys())


def _names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name):
                yield name
            case ast.Constant(value=str(text)) if re.fullmatch(r"[\w.:/-]+", text):
                yield from (text, *WORD.findall(text))


def models(kind: object) -> list[type[BaseModel]]:
    """Sections in a type."""
    if get_origin(kind) in (Annotated, Union, UnionType, tuple, dict, list):
        return [model for part in get_args(kind) for model in models(part)]
    return [kind] if isinstance(kind, type) and issubclass(kind, BaseModel) else []


@cache
def section_keys() -> frozenset[str]:
    """Every key of every section and cost term."""
    found, left = set(), [Scene, *(term.keys for term in TERMS.values())]
    visited: set[type[BaseModel]] = set()
    while left:
        section = left.pop()
        if section not in visited:
            visited.add(section)
            found |= set(keys(section))
            left += [model for field in keys(section).values() for model in models(field.annotation)]
    return frozenset(found)


def is_key(path: list[str], within: list[type[BaseModel]] | None = None) -> bool:
    """Return whether a dotted key leads somewhere from a scene's root; names of things count as any name."""
    sections = within or [Scene]
    for i, part in enumerate(path):
        fields = [keys(section)[part] for section in sections if part in keys(section)]
        if not fields:
            return i == 1 and len(path) > 2 and is_key(path[2:], sections)  # the name of a robot, an object ...
        if any(_takes_names(field.annotation) for field in fields):
            inner = [model for field in fields for model in models(field.annotation)]
            return not inner or i + 2 >= len(path) or is_key(path[i + 2 :], inner)
        sections = [model for field in fields for model in models(field.annotation)]
        if not sections:
            return i + 1 == len(path)
        sections += [term.keys for term in TERMS.values()] if part == "cost" else []
    return True


def _takes_names(kind: object) -> bool:
    """Return whether a type takes a table with names of things as its keys."""
    return get_origin(kind) is dict or any(_takes_names(part) for part in get_args(kind))


@cache
def options() -> frozenset[str]:
    """Options of ``warpmpc`` and of the tools."""
    program = typer.main.get_command(app)
    found = {name for command in (program, *program.commands.values()) for p in command.params for name in p.opts}
    for path in repository():
        if path.startswith(("tools/", "tests/conftest")) and path.endswith(".py"):
            found |= set(re.findall(r'"(--[a-z][a-z-]*)"', (ROOT / path).read_text(encoding="utf-8")))
    return frozenset(found | OPTIONS)


@cache
def pages() -> tuple[str, ...]:
    """README and every page of the documentation, from the checkout's root."""
    return ("README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md"))))


@cache
def shown() -> str:
    """The blocks of all pages: programs and commands there make files."""
    return "\n".join(text for page in pages() for _, text in blocks(page))


def is_file(path: str) -> bool:
    """Return whether a path, its last parts or a pattern with ``*`` is in the repository or in a page's blocks."""
    shape = re.escape(path.strip("/").removeprefix("./")).replace(r"\*", "[^/]*")
    if any(re.search(rf"(?:^|/){shape}$", known) for known in repository()):
        return True
    return bool(re.search(rf"(?:^|[\s\"/=]){shape}(?=[\s\":]|$)", shown(), re.MULTILINE))


def missing(page: str) -> list[str]:
    """Names on a page that lead nowhere."""
    text = (ROOT / page).read_text(encoding="utf-8")
    own = set(WORD.findall("\n".join(body for _, body in blocks(page))))
    prose = re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.MULTILINE | re.DOTALL)
    found = [name for span in re.findall(r"`([^`\n]+)`", prose) for name in _span(span, own)]
    for kind, body in blocks(page):
        if kind == "sh":
            found += [name for line in body.splitlines() for name in _command(line.partition(" #")[0])]
        elif kind == "toml":
            files = [[driver.settings] for driver in ROBOTS.values() if driver.settings]
            paths = list(_paths(tomllib.loads(body)))
            if not any(all(is_key(path, [*sections]) for path in paths) for sections in files):
                found += [".".join(path) for path in paths if not is_key(path)]
    return sorted(set(found))


def _paths(table: dict, above: tuple[str, ...] = ()) -> Iterator[list[str]]:
    for key, value in table.items():
        if above == ("cost",) and table.get("term") not in TERMS:
            return  # keys of a user's own term
        inner = value if isinstance(value, list) else [value]
        tables = [item for item in inner if isinstance(item, dict)]
        yield [*above, key]
        for item in tables:
            yield from _paths(item, (*above, key))


def _command(line: str) -> Iterator[str]:
    for word in line.split():
        word = word.split("=")[0].rstrip(",;")
        if (word.startswith("--") and word not in options()) or (
            re.match(r"(?:tools|tests)/", word) and not is_file(word.split("::")[0])
        ):
            yield word


def _span(span: str, own: set[str]) -> Iterator[str]:
    """Names of one pair of code marks that do not exist."""
    if found := re.fullmatch(r"\[+([\w.]+)\]+", span):
        path = found[1].split(".")
        yield from [] if is_key(path) or (not span.startswith("[[") and _known(found[1], own)) else [span]
        return
    if re.match(r"(?:python|pip|pytest|warpmpc|ssh|git|ray|xacro|MUJOCO_GL)\b.*\s", span):
        yield from _command(span)
        words = span.split()
        commands = typer.main.get_command(app).commands
        if words[0] == "warpmpc" and not words[1].startswith("-") and words[1] not in commands:
            yield span
        return
    for word in re.split(r"[\s,;(){}\[\]\"'=|<>@]+", span):
        word = word.rstrip(".:")
        if word.startswith("--"):
            yield from [] if word in options() else [word]
        elif _is_path(word):
            path = word.split("::")[0]
            if not re.search(r"NAME|SCENE|VERSION|FILE|FAMILY|://|^/|~", path) and not is_file(path):
                yield word
        elif re.fullmatch(r"warpmpc(?:\.\w+)+", word):
            yield from [] if word in vocabulary() or _importable(word) else [word]
        elif re.fullmatch(r"[a-z_]+(?:\.[a-z_]+)+", word) and word.split(".")[0] in keys(Scene):
            yield from [] if is_key(word.split(".")) or _known(word, own) else [word]
        elif re.fullmatch(r"[A-Za-z_]\w*(?:[.:][A-Za-z_]\w*)*", word) and not _known(word, own):
            yield word


def _known(word: str, own: set[str]) -> bool:
    parts = [part for part in re.split(r"[.:]", word) if not PLACEHOLDER.fullmatch(part)]
    return all(part in vocabulary() or part in own or len(part) < 3 for part in parts)


def _is_path(word: str) -> bool:
    """Return whether a word is meant as a file: by its ending, or as it begins with a folder."""
    folder = word.partition("/")[0] if "/" in word else ""
    above = [ROOT / above / folder for above in ("", "warpmpc")] if folder else []
    return (bool(FILE.search(word)) and not word.startswith(".")) or any(path.is_dir() for path in above)


def _importable(name: str) -> bool:
    parts = name.split(".")
    for i in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:i]))
        except ImportError:
            continue
        for part in parts[i:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False
