# SPDX-License-Identifier: Apache-2.0
"""From a scene file to a validated scene; nothing in the file is ever executed.

A scene as the text of a scene file, complete: variant and changes applied, every key written out.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..physics.runtime.files import require_regular
from .check import check_scene
from .errors import SceneError, file_keys, join_key
from .overrides import leaves, merge, nest, parse_override, split_key, validated
from .schema import Scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from .overrides import Key


def load_scene(source: str | Path, *, overrides: Sequence[str] = ()) -> Scene:
    """Read, vary and validate a scene.

    Args:
        source: Name of a shipped scene or path of a TOML file; ``:VARIANT`` at its end picks a variant, and
            ``:VARIANT+VARIANT`` several, laid one over the other in that order.
        overrides: Changes ``KEY=VALUE`` with a TOML value, such as ``planner.samples=500`` or
            ``robot.base.joint_q=[0, 0, 0]``; laid over the variant, in order.

    Returns:
        The scene. It makes sense by itself; whether its robots have the links and joints it names shows when its
        physics is built.

    Raises:
        SceneError: If anything is wrong with it.
    """
    path, variant = _find(source)
    try:
        return _load(path, variant, overrides)
    except RecursionError:
        raise SceneError("is nested too deeply", file=path) from None


def _load(path: Path, variant: str | None, overrides: Sequence[str]) -> Scene:
    data = read_toml(path)
    patches = data.pop("variants", {})
    origins: list[tuple[Key, str]] = []
    first = _free_names(data)
    for name in split_variant(variant) or (None,):
        patch, origin = _pick(patches, name, path), f"{path} [variants.{name}]"
        data = _apply(data, patch, file=origin)
        origins += [(key, origin) for key in leaves(patch)]
    for text in overrides:
        key, value = parse_override(text)
        data = _apply(data, nest(key, value), file=f"--set {text}")
        origins.append((key, f"--set {text}"))
    try:
        for name in {"path", "variant", "variants"} & data.keys():
            raise SceneError("this key cannot be set", key=name, found=name, allowed=file_keys(Scene))
        scene = validated(data).model_copy(update={"path": path, "variant": variant})
        check_scene(scene)
        _check_new_names(data, first)
    except SceneError as error:
        for each in error.each:
            each.file = next((origin for key, origin in reversed(origins) if _touches(each.key, key)), path)
        raise
    return scene


def _free_names(data: dict) -> dict[Key, list[str]]:
    """Names in the tables whose entries may have any name, scalars and frames, by the tables' keys."""
    robots = data.get("robot", [])
    tables = {("scalar",): data.get("scalar", {})}
    if isinstance(robots, list):
        tables |= {("robot", str(r.get("name")), "frames"): r.get("frames", {}) for r in robots if isinstance(r, dict)}
    return {key: list(table) if isinstance(table, dict) else [] for key, table in tables.items()}


def _check_new_names(data: dict, first: Mapping[Key, list[str]]) -> None:
    """Refuse scalars and frames that a change adds and nothing reads: their names are mistaken.

    Args:
        data: Data of the scene with all changes.
        first: What :func:`_free_names` had found in the file.

    Raises:
        SceneError: If there are such.
    """
    said, found = set(_words(data, ())), []
    for key, names in _free_names(data).items():
        there = first.get(key, [])
        for name in names:
            if name not in there and name not in said:
                what = f"no such {'scalar' if key[0] == 'scalar' else 'frame'}, and nothing reads a new one"
                found.append(SceneError(what, key=join_key((*key, name)), found=name, allowed=there))
    if found:
        raise SceneError.of(found)


def _words(data: object, at: Key) -> Iterator[str]:
    """Words in all values of a scene, and in all keys but those of its scalars and frames."""
    if isinstance(data, dict):
        for name, value in data.items():
            if at[-1:] not in (("scalar",), ("frames",)) or at[0] == "phase":
                yield from re.findall(r"[\w-]+", name)
            yield from _words(value, (*at, name))
    elif isinstance(data, list):
        for value in data:
            yield from _words(value, at)
    elif isinstance(data, str):
        yield from re.findall(r"[\w-]+", data)


def shipped_folder() -> Path:
    """Folder of the shipped scenes: inside an installed package, beside it in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def shipped_scenes() -> dict[str, Path]:
    """Scenes that come with warpmpc: name → file."""
    return {path.stem: path for path in sorted(shipped_folder().glob("*.toml"))}


def variants(source: str | Path) -> tuple[str, ...]:
    """Names of a scene's variants, in the file's order.

    Raises:
        SceneError: If there is no such file or it is not TOML.
    """
    path, _ = _find(source)
    found = read_toml(path).get("variants", {})
    return tuple(found) if isinstance(found, dict) else ()


def split_variant(variant: str | None) -> tuple[str, ...]:
    """Names of the variants that ``VARIANT+VARIANT`` lays one over the other."""
    return tuple(variant.split("+")) if variant is not None else ()


def _find(source: str | Path) -> tuple[Path, str | None]:
    """The file and the variant that a source means."""
    text = str(source)
    path = _file(text)
    if path is not None:
        return path, None
    name, colon, variant = text.rpartition(":")
    if colon and not set(variant) & set("/\\"):
        path = _file(name)
        if path is not None:
            return path, variant
        text = name
    folder = Path(text).parent
    beside = [str(path) for path in folder.glob("*.toml")] if text.endswith(".toml") and folder.is_dir() else []
    found = text if beside else Path(text).stem
    raise SceneError("no such scene file", file=text, found=found, allowed=[*beside, *shipped_scenes()])


def _file(text: str) -> Path | None:
    try:
        path = Path(text).expanduser()
        if path.is_file():
            return path.absolute()
        if path.exists() and text not in shipped_scenes():
            kind = "a folder" if path.is_dir() else "no regular file"
            raise SceneError(f"is {kind}: give a scene file (.toml) or the name of a shipped scene", file=text)
    except (OSError, RuntimeError):
        pass  # a name too long for a file, or the home folder of no user
    return shipped_scenes().get(text)


def read_toml(path: Path) -> dict:
    """Content of a TOML file.

    Raises:
        SceneError: If it cannot be read, or is no TOML.
    """
    try:
        require_regular(path)
    except ValueError as error:
        raise SceneError(str(error), file=path) from None
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise SceneError(f"cannot be read: {error.strerror}", file=path) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError("is not UTF-8 text", file=f"{path}:{line}") from error
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).rpartition(" (at ")
        position = re.findall(r"\d+", where)
        line = position[0] if position else path.read_bytes().count(b"\n") + 1
        raise SceneError(f"is not valid TOML: {what[:1].lower()}{what[1:]}", file=f"{path}:{line}") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"is not valid TOML: {error}", file=path) from error


def _pick(patches: object, variant: str | None, path: Path) -> dict:
    if not isinstance(patches, dict):
        raise SceneError("must be tables: write [variants.NAME]", key="variants", file=path, found=patches)
    if variant is None:
        return {}
    if variant not in patches:
        raise SceneError("no such variant", key="variants", file=path, found=variant, allowed=patches)
    if not isinstance(patches[variant], dict):
        raise SceneError("must be a table", key=join_key(("variants", variant)), file=path, found=patches[variant])
    if "variants" in patches[variant]:
        key = join_key(("variants", variant, "variants"))
        raise SceneError("a variant cannot contain variants: write each as [variants.NAME]", key=key, file=path)
    return patches[variant]


def _apply(data: dict, patch: dict, *, file: Path | str | None) -> dict:
    try:
        return merge(data, patch)
    except SceneError as error:
        error.file = file
        raise


def _touches(key: str | None, origin: Key) -> bool:
    """Return whether a change of one key can be behind a mistake at another: one lies at or below the other."""
    try:
        parts = split_key(key or "")
    except SceneError:
        return False
    return bool(parts) and all(b in ("*", a) for a, b in zip(parts, origin, strict=False))


def dump_scene(scene: Scene) -> str:
    """The text of a scene file that says all of a scene, defaults included.

    Files that lie beside the scene are named by their absolute paths, except those that ship with warpmpc.
    """
    import tomlkit  # slow to import

    data = scene.model_dump(mode="json", exclude_none=True, exclude={"path", "variant"})
    if scene.ground is None:
        data["ground"] = False
    if scene.path is not None and scene.path.parent != shipped_folder():
        data = _placed(data, scene.path.parent)
    return tomlkit.dumps(data)


def parse_scene(text: str, *, path: Path | None = None, variant: str | None = None) -> Scene:
    """The scene that :func:`dump_scene` wrote.

    Args:
        text: Text of the scene file.
        path: The file that the scene was made from, for its name.
        variant: The variant that was applied.

    Raises:
        SceneError: If it is no scene of this warpmpc.
    """
    scene = validated(tomllib.loads(text), file=path).model_copy(update={"path": path, "variant": variant})
    check_scene(scene)
    return scene


def _placed(value: Any, folder: Path) -> Any:
    """The same data with names of files in a folder made absolute."""
    if isinstance(value, dict):
        return {key: _placed(item, folder) for key, item in value.items()}
    if isinstance(value, list):
        return [_placed(item, folder) for item in value]
    if isinstance(value, str) and Path(value).suffix and (folder / value).is_file():
        return str((folder / value).absolute())
    return value
