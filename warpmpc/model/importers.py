# SPDX-License-Identifier: Apache-2.0
"""Newton's importers of URDF and USD files: what they refuse is one error, what they warn of is kept."""

from __future__ import annotations

import math
import warnings
from importlib.util import find_spec
from typing import TYPE_CHECKING

import newton
import warp as wp

from ..scene.errors import SceneError
from .assets import AssetKind
from .layout import WORLD
from .urdf import Urdf

if TYPE_CHECKING:
    from pathlib import Path

    from ..scene.schema import Robot

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


def import_links(
    path: Path, kind: AssetKind, robot: Robot, *, file: Path | None = None
) -> tuple[newton.ModelBuilder, list[str]]:
    """Import a URDF or USD file.

    Args:
        path: The file.
        kind: Which of them it is.
        robot: The robot, which says where its root is and whether it moves freely.
        file: Scene file, for errors.

    Returns:
        A builder of the robot alone, and what is not as its file says, one line each.

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
    except SceneError:
        raise
    except Exception as error:  # importers raise whatever their parser raises: one clear message for all of them
        said = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"this asset cannot be read: {said}", key=key, file=file, found=str(path)) from error
    said = [" ".join(str(warning.message).split()) for warning in caught if _is_about_assets(warning)]
    return part, [f"{robot.name}: {line}" for line in dict.fromkeys([*(urdf.repaired if urdf else ()), *said])]


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
    part = new_builder()
    part.add_usd(str(path), **options)
    if (robot.position is None and robot.rotation is None) or not part.body_count:
        return part
    own = part.body_q[part.joint_child[part.joint_parent.index(WORLD)]]
    wanted = transform(robot.position or tuple(own.p), robot.rotation or tuple(own.q))
    part = new_builder()
    part.add_usd(str(path), xform=wanted * wp.transform_inverse(own), **options)
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
    """Return whether an importer warns of the file that it reads; libraries warn of their own future, too."""
    return issubclass(warning.category, UserWarning) or warning.category.__module__.startswith("newton")
