# SPDX-License-Identifier: Apache-2.0
"""Share of contacts in the time of a physics step, by pairs of bodies: each pair is timed alone."""

from __future__ import annotations

import copy
import time
from itertools import combinations
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..model.state_rows import StateRows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..controller.rollout import Rollout
    from .subject import Subject

MESHES = 4
"""Colliding meshes of a robot from which a cheaper shape is spoken of."""
STEPS, ROUNDS, POSES = 10, 5, 4
"""Passes that are timed in a row, rounds of which the least counts, and states in which they are."""
TOP, NAMED = 3, 0.05
"""Pairs that are named, and the share from which they are."""
PAIRS = 60
"""Pairs that are timed: those of which most shapes are near each other."""


def contact_time(subject: Subject, rollouts: Sequence[Rollout]) -> str:
    """Say what share of a physics step contacts take in MuJoCo, and which pairs of bodies take most of it.

    Args:
        subject: The scene.
        rollouts: Rollouts of samples, whose ends are looked at besides the start.
    """
    model, groups = copy.copy(subject.world.model), _groups(subject)
    states = _states(subject, rollouts)
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    meshes = solid & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    whole = _pass_time(model, states)
    bits = model.geom_contype.copy(), model.geom_conaffinity.copy()
    for array in (model.geom_contype, model.geom_conaffinity, model.body_contype, model.body_conaffinity):
        array[:] = 0
    none, alone = _pass_time(model, states), {}
    for pair in _near(model, states, groups, bits):
        first, second = (np.flatnonzero(solid & (groups == name)) for name in pair)
        model.geom_contype[first] = model.body_contype[model.geom_bodyid[first]] = 1
        model.geom_conaffinity[second] = model.body_conaffinity[model.geom_bodyid[second]] = 1
        alone[pair] = _pass_time(model, states)
        for array in (model.geom_contype, model.geom_conaffinity, model.body_contype, model.body_conaffinity):
            array[:] = 0
    none = min(none, _pass_time(model, states), *alone.values())  # the machine may have been busy the first time
    alone = {pair: spent - none for pair, spent in alone.items()}
    share, total = max(1.0 - none / whole, 0.0), sum(alone.values())
    part = {pair: spent / max(whole, total / max(share, 1e-9)) for pair, spent in alone.items()}
    text = (
        f"{share:.0%} of a physics step of {1e6 * whole:.0f} µs in MuJoCo; {int(solid.sum())} shapes collide, "
        f"{int(meshes.sum())} of them meshes"
    )
    most = [pair for pair in sorted(part, key=part.get, reverse=True) if part[pair] > NAMED][:TOP]
    if most:
        text += "; most for " + ", ".join(f"{a} and {b} {part[a, b]:.0%}" for a, b in most) + " (each timed alone)"
    for robot in subject.scene.robot:
        own = meshes & np.isin(model.geom_bodyid, [b for b in subject.world.bodies.get(robot.name, ()) if b])
        theirs = sum(spent for pair, spent in part.items() if set(pair) & set(groups[own]))
        if own.sum() >= MESHES and theirs > NAMED:
            text += (
                f"; links with the {int(own.sum())} meshes of {robot.name} take {theirs:.0%}: boxes, capsules or "
                "spheres as collision shapes in its file cost less, or self_collision = false"
            )
    return text


def _groups(subject: Subject) -> np.ndarray:
    """Name of what each geom counts to: a robot's link, else the object, obstacle or ground; ``[ngeom]`` of text."""
    model, world = subject.world.model, subject.world
    of_model, of_layout = subject.compiled.body_name, subject.compiled.layout.body_name
    links = {model.body(a).id: b for a, b in zip(of_model, of_layout, strict=True)}
    names = np.array(["ground"] * model.ngeom, dtype=object)
    for entity in subject.compiled.layout.entities:
        own = list(world.geoms.get(entity.name, ()))
        names[own] = entity.name
        if entity.kind == "robot":
            names[own] = [links.get(int(model.geom_bodyid[g]), entity.name) for g in own]
    return names


def _states(subject: Subject, rollouts: Sequence[Rollout]) -> list[mujoco.MjData]:
    """The start, and ends of rollouts."""
    model, layout = subject.world.model, subject.compiled.layout
    found = [subject.start]
    act = layout.act[None] if len(layout.act) else None
    for rollout in rollouts[: POSES - 1]:
        data = mujoco.MjData(model)
        row = StateRows(layout, subject.world)(rollout.joint_q[-1:], rollout.joint_qd[-1:], act)[0]
        data.qpos, data.qvel, data.act = np.split(row, [model.nq, model.nq + model.nv])
        found.append(data)
    return found


def _pass_time(model: mujoco.MjModel, states: Sequence[mujoco.MjData]) -> float:
    """CPU time of a forward pass, the mean over states, each the least of some rounds [s]."""
    least = []
    for state in states:
        data, times = mujoco.MjData(model), []
        data.qpos, data.qvel, data.act = state.qpos, state.qvel, state.act
        data.mocap_pos, data.mocap_quat = state.mocap_pos, state.mocap_quat
        for _ in range(ROUNDS):
            began = time.process_time()
            for _ in range(STEPS):
                mujoco.mj_forward(model, data)
            times.append((time.process_time() - began) / STEPS)
        least.append(min(times))
    return float(np.mean(least))


def _near(
    model: mujoco.MjModel, states: Sequence[mujoco.MjData], groups: np.ndarray, bits: tuple[np.ndarray, np.ndarray]
) -> list[tuple[str, str]]:
    """Pairs of groups whose shapes may collide and whose bounding spheres meet in a state."""
    may = (bits[0][:, None] & bits[1][None]) | (bits[0][None] & bits[1][:, None])
    meet = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    for data in states:
        look = mujoco.MjData(model)
        look.qpos, look.mocap_pos, look.mocap_quat = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(model, look)
        apart = np.linalg.norm(look.geom_xpos[:, None] - look.geom_xpos[None], axis=-1)
        reach = model.geom_rbound[:, None] + model.geom_rbound[None] + model.geom_margin[:, None]
        for plane in np.flatnonzero(model.geom_rbound == 0.0):  # planes have no bounding sphere
            height = (look.geom_xpos - look.geom_xpos[plane]) @ look.geom_xmat[plane].reshape(3, 3)[:, 2]
            apart[plane] = apart[:, plane] = height
        meet |= apart <= reach
    meet &= (may != 0) & (model.geom_bodyid[:, None] != model.geom_bodyid[None])
    counts = {
        (a, b): int(meet[np.ix_(groups == a, groups == b)].sum()) for a, b in combinations(sorted(set(groups)), 2)
    }
    return sorted((pair for pair in counts if counts[pair]), key=lambda pair: -counts[pair])[:PAIRS]
