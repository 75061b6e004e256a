# SPDX-License-Identifier: Apache-2.0
"""A compiled scene: its MuJoCo model and the layout of its state.

One MuJoCo model of a scene: what Newton derives from URDF, USD and shapes, and MJCF files as they are written.

Contacts within an MJCF file follow its own rule (contype, conaffinity, exclude, pair). Whatever else stands in the
scene touches every geom of it that collides at all, by bits that no file uses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..errors import SceneError
from ..schema import DriveMode
from .mjcf import MjcfRobot, gravity_of, is_floor, read_mjcf

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from .layout import Layout


@dataclass(frozen=True)
class CompiledScene:
    """One world of a scene as the MuJoCo engine needs it."""

    layout: Layout
    mjcf: str
    """The MuJoCo model that ``SolverMuJoCo`` compiles from the Newton model without MJCF robots, as XML with meshes
    inline; empty where there is nothing else."""
    body_name: tuple[str, ...]
    """MuJoCo name of each Newton body."""
    geom_name: tuple[str, ...]
    """MuJoCo name of each shape, empty for shapes that do not collide."""
    joint_name: tuple[str, ...]
    """MuJoCo name of each joint dof."""
    actuator_name: tuple[str, ...] = ()
    """Actuator of an MJCF file behind each control, empty for controls of drives."""
    mjcf_robots: tuple[MjcfRobot, ...] = ()
    """The MJCF robots, whose files go into the MuJoCo model as they are."""
    notes: tuple[str, ...] = ()
    """Parts of MJCF files that were taken over, and those that were not."""
    timestep: float | None = None
    """Physics step that the first MJCF file asks for [s]."""
    repaired: tuple[str, ...] = ()
    """Repairs of the assets, which are warned of every time."""
    measured: dict[str, int] = field(init=False, default_factory=dict, compare=False, repr=False)
    """Numbers of physics steps that were found for it by rolling it out."""

    def spec(self) -> mujoco.MjSpec:
        """The MuJoCo model of the scene, to be compiled."""
        shapes = zip(self.layout.shapes, self.geom_name, strict=True)
        spec = compose(self.mjcf, self.mjcf_robots, {name for shape, name in shapes if name and shape.collides})
        set_gravity(spec, self.layout.gravity)
        return spec

    def substeps(self, wanted: int | None, control_dt: float, default: int) -> int:
        """Physics steps per control.

        Args:
            wanted: What the scene says.
            control_dt: Length of a control [s].
            default: What holds where neither the scene nor an MJCF file says anything.
        """
        if wanted is not None:
            return wanted
        return default if self.timestep is None else max(1, round(control_dt / self.timestep))


_SIZES = ("njmax", "nconmax", "nstack", *(name for name in dir(mujoco.MjSpec) if name.startswith("nuser_")))
"""Sizes that MuJoCo finds by itself when they are left to it."""
_BITS = range(31)
"""Collision bits: MuJoCo's are signed integers of 32 bits."""


def compose(mjcf: str, mjcf_robots: Sequence[MjcfRobot], solid: Collection[str]) -> mujoco.MjSpec:
    """The MuJoCo model of a scene, to be compiled.

    Args:
        mjcf: The model that Newton derives from everything but MJCF robots; empty when there is nothing else.
        mjcf_robots: The MJCF robots.
        solid: Its geoms that collide; Newton leaves out the bits of those that meet nothing in its own model.

    Raises:
        SceneError: If a file cannot be read, or the files use too many collision bits.
    """
    spec = mujoco.MjSpec.from_string(mjcf) if mjcf else mujoco.MjSpec()
    if not mjcf_robots:
        return spec
    children = [read_mjcf(mjcf_robot).spec for mjcf_robot in mjcf_robots]
    _share_bits(spec, solid, children, mjcf_robots)
    take_options(spec, children[0])
    if needs_implicit(children[0], mjcf_robots):
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for child, mjcf_robot in zip(children, mjcf_robots, strict=True):
        _keep_floors(child, mjcf_robot.place)
        *position, x, y, z, w = mjcf_robot.place
        frame = spec.worldbody.add_frame(pos=position, quat=[w, x, y, z])
        _copy(spec.option, child.option)  # MuJoCo warns of settings that differ; the notes tell of those that matter
        _copy(spec.visual, child.visual)
        for name in _SIZES:
            setattr(child, name, getattr(spec, name))
        spec.attach(child, prefix=f"{mjcf_robot.robot.name}/", frame=frame)
    return spec


def needs_implicit(first: mujoco.MjSpec, mjcf_robots: Sequence[MjcfRobot]) -> bool:
    """Return whether stiff servos of drives replace what a file's explicit integrator was chosen for."""
    stiff = any(drive.mode is not DriveMode.EFFORT for mjcf_robot in mjcf_robots for drive in mjcf_robot.robot.drive)
    return stiff and first.option.integrator == mujoco.mjtIntegrator.mjINT_EULER


def _keep_floors(child: mujoco.MjSpec, place: Sequence[float]) -> None:
    """Take back from a file's floors what the robot's place in the scene will move them by."""
    floors = [geom for geom in child.worldbody.geoms if is_floor(geom.type) and geom.frame is None]
    if not floors:
        return
    *origin, x, y, z, w = place
    back, position = np.zeros(4), np.zeros(3)
    mujoco.mju_negPose(position, back, np.array(origin), np.array([w, x, y, z]))
    frame = child.worldbody.add_frame(pos=position, quat=back)
    for geom in floors:
        geom.set_frame(frame)


def take_options(spec: mujoco.MjSpec, source: mujoco.MjSpec) -> None:
    """Simulate with the options, statistics and memory of an MJCF file, and find ranges of lengths as it says."""
    _copy(source.option, spec.option)
    _copy(source.stat, spec.stat)
    _copy(source.compiler.LRopt, spec.compiler.LRopt)
    _copy(source.visual, spec.visual)
    spec.memory = source.memory


def set_gravity(spec: mujoco.MjSpec, gravity: Sequence[float]) -> None:
    """Give a model a gravity (x, y, z) [m/s²]; options that have it already stay as they are."""
    if gravity_of(spec.option) != tuple(gravity):
        spec.option.gravity = gravity
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)


def options_that_differ(first: mujoco.MjSpec, second: mujoco.MjSpec) -> list[str]:
    """Names of the physics options in which two files differ."""
    pairs = ((first.option, second.option), (first.compiler.LRopt, second.compiler.LRopt))
    return [
        name if record is first.option else f"lengthrange {name}"
        for record, other in pairs
        for name in _attributes(record)
        if not np.array_equal(getattr(record, name), getattr(other, name))
    ]


def _attributes(record: object) -> list[str]:
    return [name for name in dir(record) if not name.startswith("_")]


def _copy(source: object, target: object) -> None:
    for name in _attributes(source):
        value = getattr(source, name)
        if type(value).__module__.startswith("mujoco"):  # settings in their own groups
            _copy(value, getattr(target, name))
        else:
            setattr(target, name, value)


def _share_bits(
    spec: mujoco.MjSpec, solid: Collection[str], children: Sequence[mujoco.MjSpec], mjcf_robots: Sequence[MjcfRobot]
) -> None:
    """Set collision bits so that the scene's geoms meet the files' and every file keeps its own rule.

    The scene's own bits move to where no file has one. Its solids and its planes get a bit each, which the files'
    geoms answer to; a robot without self-collision shows its own bit to the others instead of its file's.
    """
    authored = _bits(geom.contype | geom.conaffinity for child in children for geom in child.geoms)
    free = [bit for bit in _BITS if not authored >> bit & 1]
    used = _bits(geom.contype for geom in spec.geoms)
    moved = [bit for bit in _BITS if used >> bit & 1]
    quiet = [i for i, mjcf_robot in enumerate(mjcf_robots) if mjcf_robot.robot.self_collision is False]
    if len(free) < len(moved) + 2 + len(quiet):
        raise SceneError(
            "the MJCF files use so many collision bits (contype, conaffinity) that none are left for the scene",
            key="robot.asset",
            found=f"{bin(authored & 0xFFFFFFFF).count('1')} of 32",
        )
    place = dict(zip(moved, free, strict=False))
    body, plane, *own = (1 << bit for bit in free[len(moved) :])
    shown = dict(zip(quiet, own, strict=False))
    for geom in spec.geoms:
        if geom.name in solid:
            is_plane = geom.type == mujoco.mjtGeom.mjGEOM_PLANE
            geom.contype = _moved(geom.contype, place) | (plane if is_plane else body)
            geom.conaffinity = _moved(geom.conaffinity, place)
    for i, (child, mjcf_robot) in enumerate(zip(children, mjcf_robots, strict=True)):
        answers = body | (plane if mjcf_robot.robot.ground_contact else 0)
        others = sum(bit for j, bit in shown.items() if j != i)
        static = {geom.name for geom in child.worldbody.geoms}
        for geom in child.geoms:
            if not geom.contype | geom.conaffinity:
                continue
            if geom.name in static:  # a floor or wall of the file: it is no link
                geom.conaffinity |= body | sum(shown.values())
            elif i in shown:
                theirs = _bits(g.contype for j, other in enumerate(children) if j != i for g in other.geoms)
                geom.contype, geom.conaffinity = shown[i], answers | others | theirs
            else:
                geom.conaffinity |= answers | others


def _bits(masks: Iterable[int]) -> int:
    """Bits that any of the masks has."""
    return reduce(or_, masks, 0)


def _moved(bits: int, place: dict[int, int]) -> int:
    return sum(1 << new for old, new in place.items() if bits >> old & 1)


_COMPARED = {
    "body": ("mass", "inertia", "ipos", "iquat", "gravcomp"),
    "joint": ("type", "range", "limited", "axis", "pos", "stiffness", "solref", "solimp", "margin", "actfrcrange"),
    "geom": ("type", "size", "pos", "quat", "friction", "margin", "gap", "solref", "solimp", "condim", "priority"),
    "site": ("pos", "quat"),
    "tendon": ("range", "stiffness", "damping", "frictionloss", "lengthspring"),
    "actuator": ("gear", "gainprm", "biasprm", "dynprm", "ctrlrange", "forcerange", "trntype", "dyntype"),
    "sensor": ("type", "dim", "cutoff", "noise"),
}
"""What must be the same in an MJCF file's own model and in the scene's."""


def differences(own: mujoco.MjModel, whole: mujoco.MjModel, robot: str) -> list[str]:
    """Differences of an MJCF file's model when it stands in the scene, one line each; nothing if all is well."""
    found = []
    for kind, names in _COMPARED.items():
        prefix = "jnt" if kind == "joint" else kind
        ids = np.arange(len(getattr(own, f"{prefix}_{names[0]}")))
        if kind in ("geom", "site"):
            ids = ids[getattr(own, f"{kind}_bodyid") > 0]  # the others stand where the robot's place puts them
        elif kind == "body":
            ids = ids[1:]
        there = [getattr(whole, kind)(f"{robot}/{getattr(own, kind)(i).name}").id for i in ids]
        for name in names:
            array = f"{prefix}_{name}"
            if not np.allclose(getattr(own, array)[ids], getattr(whole, array)[there], rtol=1e-9, atol=1e-12):
                found.append(f"{robot}: {array} is not what the file says when it is compiled alone")
    return found
