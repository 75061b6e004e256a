# SPDX-License-Identifier: Apache-2.0
"""Keyframes of an MJCF file, by names."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco


@dataclass(frozen=True)
class Key:
    """A keyframe by names, in MuJoCo's conventions and in the file's own frame."""

    name: str
    qpos: dict[str, tuple[float, ...]]
    """Joint → its coordinates."""
    qvel: dict[str, tuple[float, ...]]
    act: dict[str, tuple[float, ...]]
    """Actuator → its activations."""
    ctrl: dict[str, float]
    mocap: dict[str, tuple[float, ...]]
    """Mocap body → its pose (x, y, z, qx, qy, qz, qw)."""


def take_keys(spec: mujoco.MjSpec) -> tuple[Key, ...]:
    """Keyframes by names; they leave the file, since their rows fit its own joints and actuators alone."""
    if not spec.keys:
        return ()
    model = spec.compile()
    found = tuple(_key(model, k) for k in range(model.nkey))
    for key in list(spec.keys):
        spec.delete(key)
    return found


_WIDTHS = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}
"""Coordinates and velocities of MuJoCo's joint types."""


def _key(model: mujoco.MjModel, k: int) -> Key:
    def row(values, start: int, width: int) -> tuple[float, ...]:
        return tuple(float(x) for x in values[k, start : start + width])

    joints = [(model.joint(j).name, _WIDTHS[int(model.jnt_type[j])], j) for j in range(model.njnt)]
    actuators = [(model.actuator(a).name, a) for a in range(model.nu)]
    mocap = {}
    for body in range(model.nbody):
        m = model.body_mocapid[body]
        if m >= 0:
            w, x, y, z = row(model.key_mquat, 4 * m, 4)
            mocap[model.body(body).name] = (*row(model.key_mpos, 3 * m, 3), x, y, z, w)
    return Key(
        name=model.key(k).name,
        qpos={name: row(model.key_qpos, model.jnt_qposadr[j], width[0]) for name, width, j in joints},
        qvel={name: row(model.key_qvel, model.jnt_dofadr[j], width[1]) for name, width, j in joints},
        act={
            name: row(model.key_act, model.actuator_actadr[a], model.actuator_actnum[a])
            for name, a in actuators
            if model.actuator_actnum[a]
        },
        ctrl={name: float(model.key_ctrl[k, a]) for name, a in actuators},
        mocap=mocap,
    )
