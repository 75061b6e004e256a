# SPDX-License-Identifier: Apache-2.0
"""A URDF file as the importer gets it: every mesh found, what no physics can be made of repaired, and that said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from ..scene.errors import SceneError
from .assets import find_mesh
from .urdf_physics import Impossible, repair_inertias, repair_joints

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@dataclass(frozen=True)
class MeshUse:
    """A mesh that a link of a URDF file names."""

    link: str
    uri: str
    """What the file says."""
    path: Path | None
    """Where it was found, if it was."""
    element: ElementTree.Element
    """The ``<visual>`` or ``<collision>`` it stands in."""

    @property
    def collides(self) -> bool:
        """Return whether physics needs it."""
        return self.element.tag == "collision"


class Urdf:
    """A URDF file, read for the importer.

    Args:
        path: The file.
        floating: Whether its root moves freely.
        key: Key of the scene that names it, for errors.
        file: Scene file, for errors.

    Raises:
        SceneError: If it has no links, a collision mesh cannot be found, or no physics can be made of a link or joint.
    """

    def __init__(self, path: Path, *, floating: bool, key: str, file: Path | None = None):
        self.path, self._key, self._file = path, key, file
        try:
            self.root = ElementTree.parse(path).getroot()
        except ElementTree.ParseError as error:
            raise self.error(f"is not valid XML: {error}") from error
        if self.root.find("link") is None:
            raise self.error("this asset has no links")
        self.repaired: list[str] = []
        """What is not as the file says, one line each."""
        for capsule in self.root.iter("capsule"):  # Newton 1.8 reads ``height``, and 1 m where there is none
            if (length := capsule.get("length")) is not None:
                capsule.set("height", length)
        self.meshes = list(self._find_meshes())
        try:
            self.repaired += [*repair_inertias(self.root, floating=floating), *repair_joints(self.root)]
        except Impossible as error:
            raise self.error(str(error)) from error

    @property
    def text(self) -> str:
        """The file as it is imported."""
        return ElementTree.tostring(self.root, encoding="unicode")

    def error(self, message: str, found: object = None) -> SceneError:
        """The error about this file."""
        return SceneError(f"{self.path}: {message}", key=self._key, file=self._file, found=found)

    def drop_unreadable(self) -> bool:
        """Take visual meshes that cannot be read out of the file; returns whether there were any.

        Raises:
            SceneError: If it is a collision mesh that cannot be read.
        """
        dropped = False
        for mesh in list(self.meshes):
            if _readable(mesh.path):
                continue
            what = f"link '{mesh.link}': the {mesh.element.tag} mesh {mesh.path} cannot be read"
            if mesh.collides:
                raise self.error(f"{what}; correct the file or take the <collision> out of the URDF", mesh.uri)
            for link in self.root.iter("link"):
                if mesh.element in list(link):
                    link.remove(mesh.element)
            self.meshes.remove(mesh)
            self.repaired.append(f"{what}; it is not drawn")
            dropped = True
        return dropped

    def _find_meshes(self) -> Iterator[MeshUse]:
        for link in self.root.iter("link"):
            for element in [*link.findall("visual"), *link.findall("collision")]:
                for mesh in element.iter("mesh"):
                    uri = mesh.get("filename", "")
                    found = find_mesh(uri, self.path)
                    use = MeshUse(link.get("name", ""), uri, found, element)
                    if found is None:
                        self._miss(link, use)
                    else:
                        mesh.set("filename", str(found))
                        yield use
        for texture in self.root.iter("texture"):
            if found := find_mesh(texture.get("filename", ""), self.path):
                texture.set("filename", str(found))

    def _miss(self, link: ElementTree.Element, mesh: MeshUse) -> None:
        what = f"link '{mesh.link}': there is no {mesh.element.tag} mesh {mesh.uri}"
        if mesh.collides:
            raise self.error(
                f"{what}; put it there, name the folder of its package in ROS_PACKAGE_PATH, or take the <collision> "
                "out of the URDF"
            )
        if mesh.element in list(link):  # or it went with another mesh of the same <visual>
            link.remove(mesh.element)
        self.repaired.append(f"{what}; it is not drawn")


def _readable(path: Path) -> bool:
    import trimesh

    try:
        return len(trimesh.load(path, force="mesh").faces) > 0
    except Exception:  # trimesh raises what its format readers raise
        return False
