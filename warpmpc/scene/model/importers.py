# SPDX-License-Identifier: Apache-2.0
"""Newton's importers of URDF and USD files: what they refuse is one error, what they warn of is kept.

A URDF file as the importer gets it: every mesh found, what no physics can be made of repaired, and that said.

What a URDF or USD file says of a robot that its import leaves out, one line for each kind.
"""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import newton
import warp as wp

from ..errors import Mistakes, SceneError, some
from .assets import AssetKind, find_mesh
from .layout import WORLD
from .urdf_physics import Impossible, repair_inertias, repair_joints

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from ..schema import Robot, Scene

_READ = {
    "robot": {"link", "joint", "material"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "collision": {"origin", "geometry", "material"},
    "geometry": {"box", "sphere", "cylinder", "capsule", "mesh"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic"},
    "dynamics": {"damping", "friction"},
    "limit": {"lower", "upper", "effort", "velocity"},
    "mimic": {"joint", "offset", "multiplier"},
}
"""Elements and attributes of a URDF that are read, by what they stand in; looks and groups of links say no physics."""
_SAYS_NOTHING = {"verbose", "texture", "disable_collisions", "group", "group_state", "contact_coefficients_default"}
_MEANING = {
    "transmission": "reductions and motors: joints have the effort and velocity of their <limit>",
    "gazebo": "Gazebo's friction, springs, sensors and plugins",
    "ros2_control": "interfaces of a controller",
    "mujoco": "options of MuJoCo: give them in [engine]",
    "sensor": "a sensor",
    "safety_controller": "soft limits",
    "calibration": "reference positions",
    "loop_joint": "a closed loop: an MJCF file may have it as <equality>",
    "contact": "friction of contacts: robot.NAME.friction sets it",
    "surface": "friction of contacts: robot.NAME.friction sets it",
}
"""Elements that are left out, and what they mean."""


def urdf_losses(root: Element) -> list[str]:
    """Lines on the elements and attributes of a URDF file that its import leaves out.

    Args:
        root: The ``<robot>``.
    """
    found: dict[str, list[str]] = {}
    for kind, owner, name in _unread(root, ""):
        found.setdefault(kind, []).append(name or owner)
    lines = []
    for kind, names in found.items():
        name = re.match(r"<([^ >]*)", kind)[1]
        meaning = "an unexpanded macro: run xacro first" if name.startswith("xacro:") else _MEANING.get(name, "")
        named = [name for name in names if name]
        of = f" of {some(sorted(set(named)))}" if named else f" ({len(names)})" if len(names) > 1 else ""
        lines.append(f"{kind}{of}" + (f": {meaning}" if meaning else ""))
    return lines


def _unread(element: Element, owner: str) -> Iterator[tuple[str, str, str]]:
    """Kind, owner and own name of all below an element that is not read."""
    tag = _plain(element.tag)
    read = _READ.get(tag, set())
    if tag in ("dynamics", "limit", "mimic"):
        yield from ((f'<{tag} {_plain(key)}="...">', owner, "") for key in sorted(set(element.keys()) - read))
    for child in element:
        name = _plain(child.tag)
        if name in read:
            inner = child.get("name", "") if name in ("link", "joint") else owner
            yield from _unread(child, inner) if name in _READ else ()
        elif name not in _SAYS_NOTHING:
            own = child.get("name") or child.get("reference") or ""
            inside = {_plain(part.tag) for part in child} if name == "gazebo" else ()
            yield f"<{name}>" + (f" with {', '.join(sorted(inside))}" if inside else ""), owner, own


def _plain(tag: object) -> str:
    """Name of an element or attribute, with ``xacro:`` or ``drake:`` for one of their namespaces."""
    text = tag if isinstance(tag, str) else "comment"  # a comment or processing instruction has a function
    space, _, name = text.rpartition("}")
    known = next((f"{word}:" for word in ("xacro", "drake") if word in space), "")
    return known + name


_LOST = {
    r"physxJoint:jointFriction": "friction of joints: PhysX has it as a share of their load",
    r"physxRigidBody:(linear|angular)Damping": "drag of bodies",
    r"physxLimit:.*|newton:limit(Stiffness|Damping)": "softness of joint limits: they are MuJoCo's",
    r"(physx|newton)\w*:(restitution|rest\w*Offset|contactOffset)|physics:restitution": "bounce of contacts",
    r"drive:.*:physics:(stiffness|damping|target\w+)": "gains and targets of its drives: the scene has others",
    r"mjc:(option|flag|compiler):.*": "options of MuJoCo: give them in [engine]",
}
"""Attributes that are left out, and what they mean."""


def usd_losses(path: Path) -> list[str]:
    """Lines on the attributes, sensors and actuators of a USD stage that its import leaves out."""
    from pxr import Usd, UsdPhysics  # an extra

    stage = Usd.Stage.Open(str(path))
    found: dict[str, dict[str, set[str]]] = {}
    lines = []
    for prim in stage.Traverse():
        kind, name = str(prim.GetTypeName()), prim.GetName()
        if re.search(r"Sensor|Lidar|Imu|RayCaster", kind):
            found.setdefault("sensors", {}).setdefault(kind, set()).add(name)
        elif re.fullmatch(r"Mjc(Actuator|Tendon|Keyframe)", kind):
            found.setdefault("only an MJCF file has these", {}).setdefault(kind, set()).add(name)
        for schema in prim.GetAppliedSchemas():
            if "Tendon" in schema:
                found.setdefault("tendons", {}).setdefault(schema.partition(":")[0], set()).add(name)
        for key in (attribute.GetName() for attribute in prim.GetAuthoredAttributes()):
            meaning = next((meaning for pattern, meaning in _LOST.items() if re.fullmatch(pattern, key)), None)
            if meaning:
                found.setdefault(meaning, {}).setdefault(key, set()).add(name)
        if prim.IsA(UsdPhysics.Scene):
            lines += _gravity(UsdPhysics.Scene(prim))
    lines += [
        f"{', '.join(sorted(kinds))} of {some(sorted(set().union(*kinds.values())))}: {meaning}"
        for meaning, kinds in found.items()
    ]
    return lines


def _gravity(scene: object) -> list[str]:
    size = float(scene.GetGravityMagnitudeAttr().Get())
    if not math.isfinite(size) or size < 0.0 or abs(size - 9.81) < 0.01:
        return []
    return [f"physics:gravityMagnitude of {size:.4g} m/s²: engine.gravity sets it"]


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
        self.losses = urdf_losses(self.root)
        """What is left out of it, likewise."""
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


_MUJOCO_LIMITS = 2
"""Newton's mode for joint limits as soft as MuJoCo's own, unless the asset says otherwise; for its solver ``mujoco``.
With the gains that Newton gives joints by default, of a URDF for example, light links such as fingers swing up at the
steps of rollouts; and MuJoCo's C engine does not get these gains."""


def new_builder() -> newton.ModelBuilder:
    """An empty builder with the settings and custom attributes of every warpmpc model."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.custom_attributes["mujoco:solreflimit_mode"].default = _MUJOCO_LIMITS
    builder.rigid_gap = 0.0  # every detected contact is an active one: no speculative pairs to pay for
    return builder


def transform(position: tuple[float, ...], rotation: tuple[float, ...]) -> wp.transform:
    """A pose of a position [m] and an orientation (x, y, z, w)."""
    return wp.transform(wp.vec3(*position), wp.quat(*rotation))


def given_frames(robot: Robot, links: Sequence[str], first: int, scene: Scene) -> dict[str, tuple[int, tuple]]:
    """Frames that the scene gives a robot: by name the body and the pose in it.

    Args:
        robot: The robot.
        links: Its links.
        first: Body of the first of them.
        scene: The scene, for errors.

    Raises:
        SceneError: If the robot's frames or spheres name links that its asset lacks.
    """
    named = {f"frames.{name}.link": frame.link for name, frame in robot.frames.items()}
    named |= {f"spheres.{link}": link.removeprefix(f"{robot.name}/") for link in robot.spheres}
    mistakes = Mistakes()
    for key, link in named.items():
        with mistakes.of_part():
            if link not in links:
                raise SceneError(
                    "no such link", key=f"robot.{robot.name}.{key}", file=scene.path, found=link, allowed=links
                )
    mistakes.raise_all()
    return {
        f"{robot.name}/{name}": (first + links.index(frame.link), (*frame.offset, *frame.rotation))
        for name, frame in robot.frames.items()
    }


def import_links(
    path: Path, kind: AssetKind, robot: Robot, *, file: Path | None = None
) -> tuple[newton.ModelBuilder, list[str], list[str]]:
    """Import a URDF or USD file.

    Args:
        path: The file.
        kind: Which of them it is.
        robot: The robot, which says where its root is and whether it moves freely.
        file: Scene file, for errors.

    Returns:
        A builder of the robot alone, what is not as its file says, and what was left out of it, one line each.

    Raises:
        SceneError: If the file cannot be read, what reads it is not installed, or no physics can be made of it.
    """
    key = f"robot.{robot.name}.asset"
    if kind is AssetKind.USD and find_spec("pxr") is None:
        wanted = 'a USD file needs usd-core: pip install "warpmpc[usd]"'
        raise SceneError(wanted, key=key, file=file, found=str(path))
    options = {"floating": bool(robot.floating), "enable_self_collisions": bool(robot.self_collision)}
    urdf = Urdf(path, floating=bool(robot.floating), key=key, file=file) if kind is AssetKind.URDF else None
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            part = _import_urdf(urdf, robot, options) if urdf else _import_usd(path, robot, options)
            losses = urdf.losses if urdf else usd_losses(path)
    except SceneError:
        raise
    except Exception as error:  # importers raise whatever their parser raises: one clear message for all of them
        said = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"this asset cannot be read: {said}", key=key, file=file, found=str(path)) from error
    said = [" ".join(str(warning.message).split()) for warning in caught if _is_about_assets(warning)]
    repaired = [f"{robot.name}: {line}" for line in dict.fromkeys([*(urdf.repaired if urdf else ()), *said])]
    return part, repaired, [f"{robot.name}: not taken over: {line}" for line in losses]


def _import_urdf(urdf: Urdf, robot: Robot, options: dict) -> newton.ModelBuilder:
    """The robot of a URDF file; a second try without visual meshes that cannot be read."""
    part = new_builder()
    try:
        place = transform(robot.position or (0.0, 0.0, 0.0), robot.rotation or (0.0, 0.0, 0.0, 1.0))
        part.add_urdf(urdf.text, xform=place, **options)
    except Exception:
        if not urdf.drop_unreadable():
            raise
        return _import_urdf(urdf, robot, options)
    return part


def _import_usd(path: Path, robot: Robot, options: dict) -> newton.ModelBuilder:
    """The robot of a USD file; imported again where the scene moves its root."""
    _require_units(path)
    part = _read_usd(path, **options)
    if (robot.position is None and robot.rotation is None) or not part.body_count:
        return part
    own = part.body_q[part.joint_child[part.joint_parent.index(WORLD)]]
    wanted = transform(robot.position or tuple(own.p), robot.rotation or tuple(own.q))
    return _read_usd(path, xform=wanted * wp.transform_inverse(own), **options)


def _read_usd(path: Path, **options: object) -> newton.ModelBuilder:
    """The robot of a USD file, with what PhysX and MuJoCo say of joints: armature, damping, friction, speed limits."""
    part, schemas = new_builder(), newton.usd
    resolvers = [schemas.SchemaResolverNewton(), schemas.SchemaResolverPhysx(), schemas.SchemaResolverMjc()]
    part.add_usd(str(path), schema_resolvers=resolvers, **options)
    modes = part.custom_attributes["mujoco:solreflimit_mode"].values
    for dof in [dof for dof, mode in modes.items() if mode == 0]:  # limits of which the stage says nothing
        del modes[dof]
    return part


def _require_units(path: Path) -> None:
    """Refuse stages in other units than metres and kilograms: the importer takes their numbers as they are."""
    from pxr import Usd, UsdGeom, UsdPhysics  # an extra

    stage = Usd.Stage.Open(str(path))
    for key, unit, known, value in (
        ("metersPerUnit", "m", UsdGeom.StageHasAuthoredMetersPerUnit, UsdGeom.GetStageMetersPerUnit),
        ("kilogramsPerUnit", "kg", UsdPhysics.StageHasAuthoredKilogramsPerUnit, UsdPhysics.GetStageKilogramsPerUnit),
    ):
        if known(stage) and not math.isclose(value(stage), 1.0, rel_tol=1e-6):
            raise ValueError(f"its unit is {value(stage):g} {unit} ({key}): convert the stage to metres and kilograms")


def _is_about_assets(warning: warnings.WarningMessage) -> bool:
    """Return whether an importer warns of the file that it reads; libraries also warn of deprecations."""
    return issubclass(warning.category, UserWarning) or warning.category.__module__.startswith("newton")
