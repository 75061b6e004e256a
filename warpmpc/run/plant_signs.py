# SPDX-License-Identifier: Apache-2.0
"""Signs of failure in how a plant moves: falls, a standstill, joints at their stops, links that touch each other."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..model.layout import rotate
from ..scene.errors import some

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ..controller.controller import Controller
    from ..model.state import Info
    from ..plant.plant import Plant

OFTEN = 1.0 / 3.0
"""Share of the controls from which something is the rule rather than an exception."""
EDGE = 0.01
"""Share of its range within which a control or joint counts as being at the limit."""
TILT, LOWER, LOW = np.radians(60.0), 0.8, 0.5
"""A base has fallen that is tilted by more than this and below this share of its height at the start, or lower than
this share however it lies."""
LYING = 0.5
"""Time from which a base that has fallen counts as staying so [s]."""
STILL, STANDING = 0.02, 1.0
"""Coordinates that move less than this [m or rad] over the last third of a run stand still, if that is long [s]."""
ALONE, COUNTS = 0.9, 0.05
"""Share of the cost from which a term is nearly all of it, and below which it is not worth its name."""
LOOKS = 10
"""Controls between two looks at contacts within robots."""
FREE = 4
"""Newton's type of a free joint."""
GRIPPER = -1
"""Finger of all links of grippers: being at an end of their range is what they are for."""


class PlantSigns:
    """Counts, over an episode, how a plant moves.

    Args:
        controller: The controller, for the terms of its plans.
        plant: The plant.
    """

    def __init__(self, controller: Controller, plant: Plant):
        self._controller, self._plant, layout = controller, plant, plant.layout
        limited = np.flatnonzero((layout.dof_coord >= 0) & (layout.dof_upper - layout.dof_lower < 1e3))
        self._axes, self._moves = _driven(plant, limited)
        self._at_stop = np.zeros(len(self._axes))
        self._servos = _servos(plant, self._axes)
        self._bases = {
            entity.name: int(layout.joint_q_start[joint])
            for entity in layout.entities
            for joint in entity.joints
            if entity.kind == "robot"
            and layout.joint_type[joint] == FREE
            and layout.joint_child[joint] == entity.bodies[0]
        }
        self._start = plant.state.joint_q
        self._fallen: dict[str, float] = {}  # since when a robot's base lies
        self._q: list[np.ndarray] = []
        self._terms: list[np.ndarray] = []
        self._links = {
            body: (entity.name, plant.model.body(body).name)
            for entity in layout.entities
            for body in plant.world.bodies.get(entity.name, ())
            if entity.kind == "robot" and body
        }
        self._touching: Counter[tuple[str, str]] = Counter()
        self._fingers = fingers(plant.model, self._links)
        self._holding: Counter[int] = Counter()  # looks at which each finger touches what is not of its robot
        self._looks = 0

    def note(self, info: Info, control: np.ndarray) -> None:
        """Keep what the state of the plant and its next control ``[nu]`` show."""
        q = self._plant.state.joint_q
        self._note_stops(q, control)
        for name, first in self._bases.items():
            if self._lies(q, first):
                self._fallen.setdefault(name, self._plant.time)
            else:
                self._fallen.pop(name, None)
        if len(self._q) % LOOKS == 0:
            self._look()
        self._q.append(q)
        self._terms.append(np.array(list(info.terms.values())))

    def _note_stops(self, q: np.ndarray, control: np.ndarray) -> None:
        """Count joints at an end of their range; a position servo that is sent there does as it is told."""
        layout = self._plant.layout
        at, (lower, upper) = (
            q[layout.dof_coord[self._axes]],
            (layout.dof_lower[self._axes], layout.dof_upper[self._axes]),
        )
        edge = EDGE * (upper - lower)
        sent_low, sent_high = np.zeros(len(at), dtype=bool), np.zeros(len(at), dtype=bool)
        world = self._plant.world
        command = world.actuator_matrix @ control + world.actuator_offset
        for axis, actuator, gain, bias in self._servos:
            target = gain * command[actuator] + bias
            sent_low[axis] |= target <= lower[axis] + edge[axis]
            sent_high[axis] |= target >= upper[axis] - edge[axis]
        self._at_stop += ((at <= lower + edge) & ~sent_low) | ((at >= upper - edge) & ~sent_high)

    def _heights(self, q: np.ndarray, first: int) -> tuple[float, float]:
        """Heights of a base now and at the start, above the ground where there is one [m]."""
        ground = self._plant.scene.ground
        below = ground.height if ground is not None else 0.0
        return float(q[first + 2]) - below, float(self._start[first + 2]) - below

    def _tilt(self, q: np.ndarray, first: int) -> float:
        """Angle between what points up of a base and what did at the start [rad]."""
        turned = np.array([-1.0, -1.0, -1.0, 1.0]) * self._start[first + 3 : first + 7]
        up = rotate(q[first + 3 : first + 7], rotate(turned, np.array([0.0, 0.0, 1.0])))
        return float(np.arccos(np.clip(up[2], -1.0, 1.0)))

    def _lies(self, q: np.ndarray, first: int) -> bool:
        now, start = self._heights(q, first)
        grounded = self._plant.scene.ground is not None and start > 0.0
        down = now < LOWER * start if grounded else now < start
        return (down and self._tilt(q, first) > TILT) or (grounded and now < LOW * start)

    def _look(self) -> None:
        """Count pairs of links of one robot that touch."""
        model, data = self._plant.model, mujoco.MjData(self._plant.model)
        self._plant.show(data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        found, holding = set(), set()
        for first, second in model.geom_bodyid[data.contact.geom[: data.ncon]].tolist():
            (one, a), (other, b) = (self._links.get(body, (None, "")) for body in (first, second))
            trees = set(model.body_treeid[[first, second]].tolist()) - {-1}
            if one is not None and one == other and a != b and len(trees) == 1:  # a free body of the file is grasped
                found.add((min(a, b), max(a, b)))
            elif one != other and min(model.body_treeid[[first, second]]) >= 0:
                holding |= {self._fingers.get(int(model.body_weldid[body])) for body in (first, second)}
        self._looks += 1
        self._touching.update(found)
        self._holding.update(holding)

    def fallen(self) -> dict[str, float]:
        """Robots whose base has fallen and stayed so, and since when [s]."""
        over = self._plant.monitor.failure is not None or self._plant.diverged
        return {name: when for name, when in self._fallen.items() if over or self._plant.time - when >= LYING}

    def signs(self, *, unmet: bool) -> Iterator[str]:
        """Sentences, the most telling first.

        Args:
            unmet: Whether something that is wanted is not there.
        """
        fallen = self.fallen()
        q = self._plant.state.joint_q
        for name, when in fallen.items():
            first = self._bases[name]
            now, start = self._heights(q, first)
            yield (
                f"{name} fell at {when:.2f} s: it is tilted by {np.degrees(self._tilt(q, first)):.0f}° and its base is "
                f"at {now:.2g} m, from {start:.2g} m at the start: a term that keeps it up (height, orientation with "
                "tilt), a start that it can hold, a longer look-ahead, or more samples"
            )
        if fallen or not self._q:
            return
        if unmet:
            yield from self._standstill()
        yield from self._stops()
        yield from self._contacts()

    def still(self) -> bool:
        """Return whether nothing moved over the last third of the run, if that is long."""
        last = self._q[-(len(self._q) // 3) :]
        return len(last) * self._plant.scene.timing.control_dt >= STANDING and np.ptp(last, axis=0).max() <= STILL

    def _standstill(self) -> Iterator[str]:
        last, dt = self._q[-(len(self._q) // 3) :], self._plant.scene.timing.control_dt
        if not self.still():
            return
        costs = np.abs(np.nanmean(self._terms[-len(last) :], axis=0))
        if not np.isfinite(costs).all() or not costs.sum() > 0.0:
            return
        share = dict(zip(self._controller.costs.labels, costs / costs.sum(), strict=True))
        ranked = [name for name in sorted(share, key=lambda name: -share[name]) if share[name] > COUNTS]
        listed = ", ".join(f"{name} {share[name]:.0%}" for name in ranked)
        if share[ranked[0]] > ALONE:
            why = (
                f"{listed} of the cost is left and no sample finds less: raise planner.noise.sigma, look further ahead "
                "(planner.lookahead), or add a term that leads to the goal"
            )
        else:
            why = f"costs balance there ({listed}): raise the weight of what leads to the goal, or lower the others"
        yield f"all stands still for the last {len(last) * dt:.1f} s: {why}"

    def _stops(self) -> Iterator[str]:
        share = self._at_stop / len(self._q)
        names = [self._plant.layout.dof_name[axis] for axis in self._axes]
        share[[n for n, body in enumerate(self._moves) if self._grips(body)]] = 0.0
        stuck = [name for name, part in zip(names, share, strict=True) if part > OFTEN]
        if stuck:
            yield (
                f"joint {some(stuck)} is at an end of its range {share.max():.0%} of the time: another start, a term "
                "joint_limit, or a goal within reach"
            )

    def _grips(self, body: int) -> bool:
        """Return whether a body is a link of a gripper, or of a finger that mostly touches something."""
        finger = self._fingers.get(body)
        return finger is not None and (finger == GRIPPER or self._holding[finger] > OFTEN * self._looks)

    def _contacts(self) -> Iterator[str]:
        often = [(pair, count) for pair, count in self._touching.most_common() if count > OFTEN * self._looks]
        if often:
            (first, second), count = often[0]
            more = f" (and {len(often) - 1} more pairs)" if len(often) > 1 else ""
            yield (
                f"links {first} and {second} touch each other {count / self._looks:.0%} of the time{more}: a term "
                "self_collision, another start, or self_collision = false where their shapes are too wide"
            )


def fingers(model: mujoco.MjModel, links: Collection[int]) -> dict[int, int]:
    """First link of the finger that each link of robots belongs to; ``GRIPPER`` for two links at the end of an arm.

    A finger is one of several chains that begin on one link: legs and arms are fingers, too, in this sense.
    """
    moving = [body for body in links if model.body_weldid[body] == body and model.body_jntnum[body]]
    parent = {body: int(model.body_weldid[model.body_parentid[body]]) for body in moving}
    on = Counter(parent.values())
    found = {}
    for body in moving:
        first = body
        while on[parent[first]] == 1 and parent[first] in parent:
            first = parent[first]
        if on[parent[first]] > 1:
            found[body] = first
    for link in set(parent.values()) & set(moving):
        ends = [body for body in moving if parent[body] == link]
        on_arm = model.jnt_type[model.body_jntadr[link]] != mujoco.mjtJoint.mjJNT_FREE
        if on_arm and len(ends) > 1 and not any(on[body] for body in ends):
            found |= dict.fromkeys(ends, GRIPPER)
    return found


def _driven(plant: Plant, axes: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Those of some velocity coordinates that an actuator acts on, and the link that each moves."""
    layout, world, model = plant.layout, plant.world, plant.model
    data, moment = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    plant.show(data)
    mujoco.mj_fwdPosition(model, data)
    if model.nu:
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
    kept, links = [], []
    for axis in axes:
        joint = int(np.flatnonzero(layout.joint_qd_start <= axis)[-1])
        dof = int(world.joint_qd[joint] + axis - layout.joint_qd_start[joint])
        if world.joint_qd[joint] >= 0 and moment[:, dof].any():
            kept.append(axis)
            links.append(int(model.jnt_bodyid[model.dof_jntid[dof]]))
    return np.array(kept, dtype=int), links


def _servos(plant: Plant, axes: np.ndarray) -> list[tuple[int, int, float, float]]:
    """Position servos of joints: index in ``axes``, actuator, and gain and bias from command to position."""
    layout, world, model = plant.layout, plant.world, plant.model
    axis_of = {}  # first qpos of a joint → index in axes
    for n, dof in enumerate(axes):
        joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
        if world.joint_q[joint] >= 0:
            axis_of[int(world.joint_q[joint] + layout.dof_coord[dof] - layout.joint_q_start[joint])] = n
    found = []
    for a in range(model.nu):
        stiffness, gear = -model.actuator_biasprm[a, 1], model.actuator_gear[a, 0]
        on_joint = model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        if on_joint and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE and stiffness > 0.0 and gear:
            axis = axis_of.get(int(model.jnt_qposadr[model.actuator_trnid[a, 0]]))
            if axis is not None:
                scale = 1.0 / (stiffness * gear)
                gain, bias = model.actuator_gainprm[a, 0] * scale, model.actuator_biasprm[a, 0] * scale
                found.append((axis, a, float(gain), float(bias)))
    return found
