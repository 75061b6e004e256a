# SPDX-License-Identifier: Apache-2.0
"""Lookup of the files that a scene names: beside the scene, in robot packages, or shipped with warpmpc and Newton.

Every file that a robot's asset is read from: the asset, what it includes, its meshes, textures and height fields.
"""

from __future__ import annotations

import difflib
import importlib.util
import itertools
import re
import sys
import warnings
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from ..errors import SceneError
from ..load import shipped_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

_XML_ROOTS = {"robot": "urdf", "mujoco": "mjcf"}
_URI = re.compile(r"[a-z]+://|file:")
_SLASHES = re.compile(r"^(package|model):/{3,}")
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


class AssetKind(StrEnum):
    """Formats of a robot's asset file."""

    URDF = "urdf"
    MJCF = "mjcf"
    USD = "usd"


def package_dirs(path: Path | None = None) -> tuple[Path, ...]:
    """Folders in which ``package://`` URIs are looked up, besides those that ROS's environment variables name.

    Args:
        path: File that contains the URIs; the folders it lies in count too, so that a URDF finds its own package.

    Returns:
        Existing folders. Robot packages from PyPI (``cmeel.prefix/share`` of every ``sys.path`` entry) come first.
    """
    share = [Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    above = list(path.absolute().parents)[:-1] if path is not None else []
    return tuple(dict.fromkeys(folder for folder in share + above if folder.is_dir()))


def resolve_asset(uri: str, *, base: Path | None, key: str, file: Path | str | None = None) -> Path:
    """Find a file that a scene names.

    Args:
        uri: Path relative to ``base``, absolute path, ``package://``, ``model://`` or ``file:`` URI, or the name of an
            asset shipped with warpmpc, with or without ``assets/`` before it, or with Newton.
        base: Folder of the scene file; the working directory for a scene without a file.
        key: Key of the scene that names the file, for messages.
        file: Scene file, for messages.

    Returns:
        Absolute path of an existing file.

    Raises:
        SceneError: If there is no such file.
    """
    if _URI.match(uri):
        return _resolve_uri(uri, key=key, file=file)
    candidates = [folder / uri for folder in (base or Path.cwd(), *_shipped())]
    if uri.startswith("assets/"):  # a copy of a shipped scene names what lies beside the original
        candidates.append(shipped_folder() / uri)
    if Path(uri).expanduser().is_absolute():
        candidates = [Path(uri).expanduser()]
    for candidate in candidates:
        if candidate.is_file():
            return candidate.absolute()
    raise _missing(uri, candidates, key=key, file=file)


def asset_kind(path: Path, *, key: str | None = None, file: Path | str | None = None) -> AssetKind:
    """Tell what a robot's asset is written in, from its ending and, for XML, its root element.

    Raises:
        SceneError: If it is none of URDF, MJCF and USD, or is a xacro file that needs expanding.
    """
    suffix = path.suffix.lower()
    if suffix in (".usd", ".usda", ".usdc", ".usdz"):
        return AssetKind.USD
    if suffix == ".xacro" or (suffix == ".urdf" and b"<xacro:" in _COMMENT.sub(b"", path.read_bytes())):
        raise SceneError(
            f"a xacro file must be expanded first: xacro {path.name} > {_free_name(path)}",
            key=key,
            file=file,
            found=str(path),
        )
    if suffix not in (".urdf", ".xml", ".mjcf"):
        raise SceneError(
            "no such kind of robot asset",
            key=key,
            file=file,
            found=path.name,
            allowed="URDF (.urdf, .xml), MJCF (.xml, .mjcf) and USD (.usd, .usda, .usdc, .usdz)",
        )
    try:
        _, root = next(ElementTree.iterparse(path, events=("start",)))
    except (ElementTree.ParseError, StopIteration) as error:
        raise SceneError(f"is not valid XML: {error}", key=key, file=file, found=str(path)) from error
    if root.tag not in _XML_ROOTS:
        raise SceneError(
            "is neither URDF nor MJCF",
            key=key,
            file=file,
            found=f"<{root.tag}>",
            allowed="a root element <robot> (URDF) or <mujoco> (MJCF)",
        )
    return AssetKind(_XML_ROOTS[root.tag])


def _free_name(path: Path) -> str:
    """A name beside a xacro file for what is expanded from it, where no file is yet."""
    stem = path.name.split(".")[0]
    names = itertools.chain([stem, f"{stem}_expanded"], (f"{stem}_expanded_{i}" for i in itertools.count(2)))
    return next(f"{name}.urdf" for name in names if not (path.parent / f"{name}.urdf").exists())


def find_mesh(uri: str, urdf: Path) -> Path | None:
    """Find a mesh or texture that a URDF file names.

    Args:
        uri: Path relative to the file, absolute path, ``package://``, ``model://`` or ``file:`` URI.
        urdf: The file.

    Returns:
        Absolute path of an existing file, or None if there is none; nothing is downloaded.
    """
    uri = _SLASHES.sub(r"\1://", uri)
    if not _URI.match(uri):
        found = urdf.parent / uri
        return found.absolute() if uri and found.is_file() else None
    try:
        return _resolve_uri(uri, key="", file=None, folders=package_dirs(urdf)).absolute()
    except SceneError:
        return None


def _shipped() -> list[Path]:
    """Folders of shipped assets; Newton's are found without importing it, which takes seconds."""
    newton = importlib.util.find_spec("newton")
    folders = [Path(place) / "examples" / "assets" for place in newton.submodule_search_locations] if newton else []
    return [shipped_folder() / "assets", *folders]


def _resolve_uri(uri: str, *, key: str, file: Path | str | None, folders: tuple[Path, ...] | None = None) -> Path:
    """Find the file of a URI, in ``folders`` besides those that environment variables name."""
    # slow to import and needed for URIs alone
    from resolve_robotics_uri_py import resolve_robotics_uri
    from resolve_robotics_uri_py.resolve_robotics_uri_py import get_default_search_paths

    scheme = uri.partition(":")[0]
    if scheme not in ("package", "model", "file"):
        raise SceneError(
            "this kind of address is not read",
            key=key,
            file=file,
            found=uri,
            allowed="a path, package://, model://, file:",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about search paths that do not exist, and packages found twice
        known = [*(package_dirs() if folders is None else folders), *_python_package(uri)]
        try:
            found = resolve_robotics_uri(uri, package_dirs=[str(folder) for folder in known])
        except (FileNotFoundError, ValueError):
            found = None
        places = [*get_default_search_paths(), *known]
    if found is not None and found.is_file():
        return found
    rest = uri.partition("://" if "://" in uri else ":")[2]
    candidates = [Path(rest)] if scheme == "file" else [folder / rest for folder in dict.fromkeys(places)]
    raise _missing(uri, candidates, key=key, file=file)


def _python_package(uri: str) -> list[Path]:
    """The folder that the Python package of a ``package://`` URI lies in, if it is installed; it is not imported."""
    name = re.match(r"package://([A-Za-z_]\w*)/", uri)
    spec = importlib.util.find_spec(name[1]) if name else None
    return [Path(place).parent for place in spec.submodule_search_locations or ()] if spec else []


def _missing(uri: str, candidates: list[Path], *, key: str, file: Path | str | None) -> SceneError:
    """The error for a file that is nowhere: the places searched, and what lies there under a similar name."""
    near = [name for candidate in candidates for name in _near(candidate)]
    hint = f". Similar files: {', '.join(dict.fromkeys(near))}" if near else ""
    if uri.startswith("package://"):
        name = uri.removeprefix("package://").split("/")[0]
        if not any(folder.name == name and folder.is_dir() for path in candidates for folder in path.parents):
            wanted = name.replace("_", "-")
            hint = f". There is no package {name} here; if it is one of PyPI: pip install --no-deps {wanted}"
    places = ", ".join(str(candidate.parent) for candidate in candidates) or "no folder: no robot package is installed"
    return SceneError(f"no such file (searched {places}){hint}", key=key, file=file, found=uri)


def _near(path: Path) -> list[str]:
    """Similar names in the deepest existing folder above a missing file."""
    folder = next((parent for parent in path.parents if parent.is_dir()), None)
    if folder is None or folder == folder.parent:
        return []
    wanted = path.relative_to(folder).parts[0]
    near = difflib.get_close_matches(wanted, [entry.name for entry in folder.iterdir()], n=3, cutoff=0.5)
    return [str(folder / name) for name in near]


_FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of an MJCF file's ``<compiler>`` that say where its files lie."""


def asset_files(path: Path) -> list[Path]:
    """The files that a URDF or MJCF asset is read from, as far as they exist, the asset first.

    Raises:
        SceneError: If it is no XML.
    """
    path = path.absolute()
    found = _of_mjcf(path) if asset_kind(path) is AssetKind.MJCF else [path, *_of_urdf(path)]
    return list(dict.fromkeys(found))


def _of_urdf(path: Path) -> Iterator[Path]:
    for name in re.findall(r'filename\s*=\s*["\']([^"\']+)["\']', path.read_text(errors="replace")):
        if file := find_mesh(name, path):
            yield file


def _of_mjcf(path: Path) -> list[Path]:
    """The XML files first, then what they name; MuJoCo looks for both from the folder of the first file, too."""
    texts, waiting, folders, names = [], [path], [path.parent], []
    while waiting:
        text = waiting.pop()
        if text in texts or not text.is_file():
            continue
        texts.append(text)
        try:
            root = ElementTree.parse(text).getroot()
        except ElementTree.ParseError:
            continue  # reading the asset reports it
        for element in root.iter():
            if element.tag == "include" or (element.tag == "model" and element.get("file")):
                waiting += [folder / element.get("file", "") for folder in (path.parent, text.parent)]
            elif element.tag == "compiler":
                given = [element.get(attribute) for attribute in _FOLDERS]
                folders += [base / folder for base in (path.parent, text.parent) for folder in given if folder]
            else:
                names += [value for key, value in element.items() if key.startswith("file")]
        folders.append(text.parent)
    found = [folder / name for name in names for folder in folders if (folder / name).is_file()]
    return texts + found
