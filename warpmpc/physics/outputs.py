# SPDX-License-Identifier: Apache-2.0
"""Source of what rollouts hand out: MuJoCo's state after every control, sensors, poses of bodies, contact forces.

Source of fields of ``MjData`` that rollouts hand out: poses of bodies, geoms, sites and cameras, sensor readings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from .frames import Frame, Frames
from .runtime.bake import Lines, text
from .sensors import SensorSource, unread_sensors
from .source_parts import AddedCode
from .state_map import StateMap, Watch

if TYPE_CHECKING:
    from .model import PhysicsModel
    from .runtime.bake import Operand

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


def field_bodies(sensors: SensorSource, names: Sequence[str]) -> set[int]:
    """Bodies that must be kept for these fields."""
    out = set(range(sensors.mj.nbody)) if set(names) & set(_POSES) else set()
    return out | (sensors.bodies if "sensordata" in names else set())


def field_width(model: mujoco.MjModel, name: str) -> int:
    """Count of numbers of a field."""
    if name == "sensordata":
        return model.nsensordata
    _, count, what = _POSES[name]
    return getattr(model, count) * {_positions: 3, _quaternions: 4, _matrices: 9}[what]


def field_values(sensors: SensorSource, names: Sequence[str], frames: Frames) -> list[Operand | None]:
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


@wp.struct
class Outputs:
    """Places that rollouts write to, and accelerations that their solver begins with."""

    address: wp.array[wp.uint64]  # [2] of states [W, T, 1+nq+nv+na] and of fields [W, T, F], doubles
    stay: int  # whether worlds that diverged before stay where they are: those that go on in place
    before: int  # whether fields are those before each control, as in MuJoCo's step, rather than after it
    warmstart: wp.array2d[float]  # [W, nv] accelerations that the solver begins with, then those it ends with; or empty
    poses: wp.array3d[float]  # [W, bodies, 7] positions and quaternions (w, x, y, z) at the end
    force: wp.array3d[float]  # [W, pairs, 3] mean forces of watched pairs over the last control [N]


def write_outputs(
    model: PhysicsModel,
    *,
    fields: Sequence[str] = ("sensordata",),
    bodies: Sequence[int] = (),
    pairs: Sequence[tuple[int, int]] = (),
    mocap: bool = False,
) -> tuple[StateMap, AddedCode]:
    """Write the statements that hand results out; the function they are part of takes ``o: Outputs`` first.

    Args:
        model: The model.
        fields: Fields of ``MjData`` that are handed out, one after the other.
        bodies: Bodies whose poses are handed out.
        pairs: Pairs of bodies whose contact forces are.
        mocap: Whether behind the controls of a step stand the positions of all mocap bodies, then their quaternions.

    Returns:
        What the rollout keeps, and the statements.
    """
    m, sensors = model.mj, SensorSource(model)
    kept = sorted((field_bodies(sensors, fields) | set(bodies)) - {0})
    rows = {body: row for row, body in enumerate(kept)}
    readings, within = _read(sensors, fields, rows)
    code = AddedCode(
        start=_START.replace("TIMESTEP", repr(float(m.opt.timestep))),
        before=f"{_MOCAP.replace('CTRLS', str(m.nu)) if mocap else ''}\nif (live && o.before) {{\n{readings}\n}}",
        step=f"{_STATE}\nif (!o.before) {{\n{readings}\n}}{within}",
        end="\n".join((_END, *_poses(m, bodies, rows))),
        first=0,
    )
    watched = _watched(model, pairs)
    matrix = np.eye(m.nu, m.nu + (7 * m.nmocap if mocap else 0))
    seen = {"bodies": kept, "watched": watched, "pairs": len(pairs)}
    count = m.nsensor if "sensordata" in fields else 0
    plain = StateMap(plain=True, matrix=matrix, offset=np.zeros(m.nu), sensors=count, **seen)
    return plain, code


def _read(sensors: SensorSource, fields: Sequence[str], rows: dict[int, int]) -> tuple[str, str]:
    """Statements that write numbers of fields before a step or after it, and those for what is read within a step."""
    lines = Lines("o")
    values = field_values(sensors, fields, Frames(sensors.mj, lines, rows))
    count = len(values)
    if not count:
        return "", ""
    to = f"double* const to = (double*)(size_t)o.address.data[1] + ((size_t)row * steps + at) * {count};"
    puts = [
        f"for (int l = 0; l < count; ++l) to[(size_t)l * steps * {count} + {n}] = now(l);"
        if value is None
        else f"PUT(to, steps * {count}, {n}, (T)({text(value)}))"
        for n, value in enumerate(values)
    ]
    within = [put for put in puts if "w.sensed[" in put]
    others = [put for put in puts if "w.sensed[" not in put]
    staying = _STAYING.replace("TO;", to).replace("COUNT", str(count))
    read = staying.replace("SOON", "o.before").replace("READ;", "\n".join((*lines.statements, *others)))
    late = staying.replace("SOON", "0").replace("READ;", "\n".join(within)) if within else ""
    return read, late and f"{{\nif (!o.before) {{ FORWARD_WORLD(w); }}\n{late}\n}}"


def _poses(m: object, bodies: Sequence[int], rows: dict[int, int]) -> Iterable[str]:
    """Statements that write poses of bodies."""
    if not bodies:
        return
    yield f"{{ float* const to = (float*)o.poses.data + (size_t)row * {7 * len(bodies)};"
    lines = Lines("b")
    frames = Frames(m, lines, rows)
    values = []
    for body in bodies:
        frame = Frame(int(body), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        values += [*frames.position(frame), *frames.quaternion(frame)]
    yield from lines.statements
    yield from (f"PUT(to, {len(values)}, {n}, (T)({text(value)}))" for n, value in enumerate(values))
    yield "}"


def _watched(model: PhysicsModel, pairs: Sequence[tuple[int, int]]) -> list[Watch]:
    """Pairs of geoms that belong to pairs of bodies; forces are those on the first body."""
    of, out = model.mj.geom_bodyid, []
    for n, pair in enumerate(model.pairs):
        touching = tuple(int(of[g]) for g in pair.geoms)
        for index, (first, second) in enumerate(pairs):
            if {first, second} == set(touching):
                out.append(Watch(n, index, 1.0 if touching[1] == first else -1.0))
    return out


_START = """
double begun[lanes];  // where worlds go on in place their start is written over
const I yes = YES;
for (int l = 0; l < lanes; ++l) {
    begun[l] = ((const double*)k.initial.data)[(size_t)world[l] * k.initial.shape[1]];
    if (((int*)&doomed)[l] || !(fabs(begun[l]) < 1e10)) begun[l] = 0.0;
    if (o.stay && k.diverged.data[row + (l < count ? l : count - 1)]) {
        ((int*)&gone)[l] = ((int*)&yes)[l];
        held[l] = 0;
    }
}
const auto now = [&](int l) { return begun[l] + TIMESTEP * (passed < held[l] ? passed : held[l]); };
if (o.warmstart.shape[0]) {
    for (int l = 0; l < lanes; ++l)
        EACH(i, NV) LANE(w.x[i], l) = ((const float*)o.warmstart.data)[(size_t)world[l] * NV + i];
    SYNC
}
"""
_MOCAP = """
if (live) {
    const int knot = k.tap.data[(size_t)at * k.tap.shape[2]];
    EACH(i, 7 * NMOCAP) {
        const int from = CTRLS + (i % 7 < 3 ? i / 7 * 3 + i % 7 : 3 * NMOCAP + i / 7 * 4 + i % 7 - 3);
        w.mocap[i] = VGATHER(theta + knot * controls + from, lane_at);
    }
    SYNC
    PLACE_WORLD(w);
    MOVE_WORLD(w);  // what hangs on them
    SYNC
}
"""
_STATE = """
{
    const int width = 1 + NQ + NV + ACTS;
    double* const to = (double*)(size_t)o.address.data[0] + ((size_t)row * steps + at) * width;
    for (int l = 0; l < count; ++l) to[(size_t)l * steps * width] = now(l);
    EACH(i, NQ) PUT(to, steps * width, 1 + i, w.q[i])
    EACH(i, NV) PUT(to, steps * width, 1 + NQ + i, w.v[i])
#if ACTS
    EACH(i, ACTS) PUT(to, steps * width, 1 + NQ + NV + i, w.act[i])
#endif
}
"""
_STAYING = """
TO;
double before[lanes][COUNT];  // fields of worlds that stay: what was written last
const int stays = VANY(gone);
if (stays) {
    for (int l = 0; l < count; ++l)
        EACH(i, COUNT) before[l][i] = at || o.stay ? to[((size_t)l * steps - (at ? 1 : 0)) * COUNT + i] : 0.0;
    SYNC
}
READ;
if (stays) {
    SYNC
    for (int l = 0; l < count; ++l)
        if (((int*)&gone)[l] && held[l] < passed + SOON)
            EACH(i, COUNT) to[(size_t)l * steps * COUNT + i] = before[l][i];
}
"""
_END = """
if (o.warmstart.shape[0]) {
    float* const to = (float*)o.warmstart.data + (size_t)row * NV;
    EACH(i, NV) PUT(to, NV, i, w.x[i])
}
#if WATCHED
{
    float* const to = (float*)o.force.data + (size_t)row * 3 * WATCHED;
    if (k.substeps.data[0]) EACH(i, 3 * WATCHED) PUT(to, 3 * WATCHED, i, w.pushed[i])
}
#endif
"""
