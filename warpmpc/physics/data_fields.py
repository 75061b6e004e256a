# SPDX-License-Identifier: Apache-2.0
"""Source of fields of ``MjData`` that rollouts hand out: poses of bodies, geoms, sites and cameras, sensor readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import mujoco

from .frames import Frame, Frames
from .sensors import Sensors, unread_sensors

if TYPE_CHECKING:
    from ..bake.lines import Operand

_OBJ = mujoco.mjtObj


def _positions(frames: Frames, frame: Frame) -> Sequence[Operand]:
    return frames.position(frame)


def _quaternions(frames: Frames, frame: Frame) -> Sequence[Operand]:
    return frames.quaternion(frame)


def _matrices(frames: Frames, frame: Frame) -> Sequence[Operand]:
    """Row by row."""
    columns = frames.columns(frame)
    return [columns[j][i] for i in range(3) for j in range(3)]


_POSES: dict[str, tuple[int, str, Callable[[Frames, Frame], Sequence[Operand]]]] = {
    "xpos": (int(_OBJ.mjOBJ_XBODY), "nbody", _positions),
    "xquat": (int(_OBJ.mjOBJ_XBODY), "nbody", _quaternions),
    "xmat": (int(_OBJ.mjOBJ_XBODY), "nbody", _matrices),
    "xipos": (int(_OBJ.mjOBJ_BODY), "nbody", _positions),
    "ximat": (int(_OBJ.mjOBJ_BODY), "nbody", _matrices),
    "geom_xpos": (int(_OBJ.mjOBJ_GEOM), "ngeom", _positions),
    "geom_xmat": (int(_OBJ.mjOBJ_GEOM), "ngeom", _matrices),
    "site_xpos": (int(_OBJ.mjOBJ_SITE), "nsite", _positions),
    "site_xmat": (int(_OBJ.mjOBJ_SITE), "nsite", _matrices),
    "cam_xpos": (int(_OBJ.mjOBJ_CAMERA), "ncam", _positions),
    "cam_xmat": (int(_OBJ.mjOBJ_CAMERA), "ncam", _matrices),
}
"""Fields of poses: type of object, the model's number of them, and what is written of each."""


def unwritten_field(model: mujoco.MjModel, name: str) -> str | None:
    """Return why rollouts cannot hand a field of ``MjData`` out, in a few words; None if they can."""
    if name == "sensordata":
        off = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        unread = [] if off else unread_sensors(model)
        return f"sensors of the kinds {', '.join(unread)}" if unread else None
    moving = (model.cam_mode != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)).any()
    return None if name in _POSES and not (name.startswith("cam_") and moving) else f"output {name}"


def field_bodies(sensors: Sensors, names: Sequence[str]) -> set[int]:
    """Bodies that must be kept for these fields."""
    out = set(range(sensors.mj.nbody)) if set(names) & set(_POSES) else set()
    return out | (sensors.bodies if "sensordata" in names else set())


def field_width(model: mujoco.MjModel, name: str) -> int:
    """Count of numbers of a field."""
    if name == "sensordata":
        return model.nsensordata
    _, count, what = _POSES[name]
    return getattr(model, count) * {_positions: 3, _quaternions: 4, _matrices: 9}[what]


def field_values(sensors: Sensors, names: Sequence[str], frames: Frames) -> list[Operand | None]:
    """All numbers of these fields, one field after the other; None for the time."""
    out: list[Operand | None] = []
    for name in names:
        if name == "sensordata":
            out += sensors.write(frames)
            continue
        kind, count, what = _POSES[name]
        for number in range(getattr(sensors.mj, count)):
            out += what(frames, Frame.of(sensors.mj, kind, number))
    return out
