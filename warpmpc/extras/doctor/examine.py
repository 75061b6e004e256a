# SPDX-License-Identifier: Apache-2.0
"""The examination: every finding about a scene.

Findings from a fraction of a second of physics: controls without effect, slow servos, falls, gravity.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...loop.run.result import Changes
from ...planner.tumbles import OVER, tumble
from ...scene.errors import some
from ...scene.model.at_start import STEP, Subject
from .contacts import contact_findings
from .control import driven, plan_findings, reach_findings
from .finding import Finding
from .joints import joint_findings, travel_findings
from .places import place_findings, probes, still_findings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...loop.plant.monitor import Monitor
    from ...planner.controller.controller import Controller

FALL = 0.35
"""Time for which what is in free fall at the start falls on [s]: 0.6 m; models of ants are let fall 0.4 m."""
FREE = 0.9
"""Share of gravity's acceleration from which a fall counts as free: legs that yield slow it down."""
ANSWER = 0.25
"""Time in which a velocity servo has to answer [s]."""
FOLLOWS = 0.05
"""Share of the speed it is sent that a servo reaches by then; arms of 5 kg·m² with a gain of 10 reach 0.4."""


def effect_findings(subject: Subject) -> Iterator[Finding]:
    """Controls that change nothing, servos that hardly follow, what falls freely, gravity that points up."""
    gravity = subject.compiled.layout.gravity[2]
    if gravity > 0.0:
        yield Finding(
            "robot.asset" if subject.scene.engine.gravity is None else "engine.gravity",
            f"gravity is {gravity:.3g} m/s² upwards: everything rises",
            'write <option gravity="0 0 -9.81"/>, or set engine.gravity = [0.0, 0.0, -9.81]',
        )
    scene = subject.scene
    if not any(subject.compiled.layout.gravity) and scene.engine.gravity is None and scene.object:
        yield Finding(
            "engine.gravity",
            f"there is no gravity, as the file of {scene.robot[0].name} says: {scene.object[0].name} does not fall",
            "set engine.gravity = [0.0, 0.0, -9.81], or [0.0, 0.0, 0.0] if it is meant",
        )
    yield from _controls(subject)
    if gravity < 0.0:
        yield from _falls(subject, -gravity)


def _controls(subject: Subject) -> Iterator[Finding]:
    """Each control at one bound and at the other, without contacts."""
    layout, world = subject.compiled.layout, subject.world
    model = copy.copy(world.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    lower, upper = (np.where(np.isfinite(x), x, b) for x, b in ((layout.control_lower, -1), (layout.control_upper, 1)))
    idle, slow = [], []
    for i, name in enumerate(layout.control_name):
        used = np.flatnonzero(world.actuator_matrix[:, i])
        if len(used) and np.all(model.actuator_trntype[used] == mujoco.mjtTrn.mjTRN_BODY):
            continue  # adhesion acts on contacts alone
        rows = np.flatnonzero(layout.actuator_matrix[:, i])
        servo = (
            len(rows) == 1 and layout.actuator_mode[rows[0]] == "velocity" and layout.actuator_matrix[rows[0], i] == 1
        )
        data = []
        for bound in (lower, upper):
            each = mujoco.MjData(model)
            each.qpos, each.qvel, each.act = subject.start.qpos, subject.start.qvel, subject.start.act
            control = subject.held.copy()
            control[i] = bound[i]
            each.ctrl = world.actuator_matrix @ control + world.actuator_offset
            data.append(each)
        differs, reached = False, 0.0
        for _ in range(round(ANSWER / STEP) if servo else 10):
            for each in data:
                mujoco.mj_step(model, each)
            speeds = data[1].qvel - data[0].qvel
            differs |= bool(np.any(speeds))
            if servo:
                reached = max(reached, float(speeds[subject.dof(int(layout.actuator_dof[rows[0]]))]))
            elif differs:
                break
        if not differs:
            idle.append(name)
        elif servo and reached < FOLLOWS * (upper[i] - lower[i]):
            slow.append((name, reached / (upper[i] - lower[i])))
    if idle:
        yield Finding(
            f"{subject.asset_key(idle[0])}.drive",
            f"control {some(idle)} changes nothing: the robot moves alike at its lower and upper bound",
            "check gear, gains and force limits of its actuator, and that its bounds differ",
        )
    if slow:
        yield Finding(
            f"{subject.asset_key(slow[0][0])}.drive",
            f"joint {some([name for name, _ in slow])} reaches {slow[0][1]:.1%} of the speed it is sent within "
            f"{ANSWER:g} s",
            "raise damping, the servo's gain, or effort_limit; check masses (kilograms)",
        )


def _falls(subject: Subject, gravity: float) -> Iterator[Finding]:
    """Robots and objects that fall freely although the start's controls are held."""
    model, world = subject.world.model, subject.world
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.act = subject.start.qpos, subject.start.qvel, subject.start.act
    data.mocap_pos, data.mocap_quat = subject.start.mocap_pos, subject.start.mocap_quat
    data.ctrl = world.actuator_matrix @ subject.held + world.actuator_offset
    height, speed = subject.start.subtree_com[:, 2].copy(), _rises(model, data)
    mujoco.mj_step(model, data, round(FALL / STEP))
    if data.time < FALL - 0.5 * STEP:  # it diverged, and MuJoCo went back to time 0
        return
    mujoco.mj_forward(model, data)
    fallen = height + speed * FALL - data.subtree_com[:, 2]
    trees = driven(model)
    for entity in subject.compiled.layout.entities:
        for body in world.bodies.get(entity.name, ()) if entity.kind in ("robot", "object") else ():
            joint = int(model.body_jntadr[body])
            if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE or model.body_gravcomp[body]:
                continue
            if fallen[body] < FREE * 0.5 * gravity * FALL**2:
                continue
            if entity.kind == "robot" and int(model.body_treeid[body]) in trees:
                yield Finding(
                    f"robot.{entity.name}",
                    f"{entity.name} falls freely from the start, {fallen[body]:.2f} m in the first {FALL:g} s",
                    "start it on the ground (position, keyframe), or give a drone limits within which it hovers",
                )
            elif entity.kind == "object" and _nothing_beneath(subject, body):
                yield Finding(
                    f"object.{entity.name}",
                    f"{entity.name} falls, and nothing is beneath it",
                    "start it on what carries it (position), or give the scene a ground",
                )


def _nothing_beneath(subject: Subject, body: int) -> bool:
    """True where a ray straight down from the centre of mass of a body meets no other body."""
    hit, down = np.zeros(1, dtype=np.int32), np.array([0.0, 0.0, -1.0])
    return mujoco.mj_ray(subject.world.model, subject.start, subject.start.xipos[body], down, None, 1, body, hit) < 0.0


def _rises(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Vertical speed of each subtree's centre of mass ``[nbody]``."""
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data.subtree_linvel[:, 2].copy()


def examine(controller: Controller, monitor: Monitor) -> list[Finding]:
    """Likely mistakes of a scene, none for one that looks as it should.

    Args:
        controller: It has made a plan from the scene's start.
        monitor: It has seen the start.
    """
    subject = Subject(controller.scene, controller.compiled)
    of_plan = [*plan_findings(subject, controller), *still_findings(subject, probes(controller))]
    return [*examine_model(subject), *tumble_findings(controller), *_at_once(monitor), *of_plan]


def examine_model(subject: Subject) -> list[Finding]:
    """The findings that need no plan."""
    kinds = (joint_findings, contact_findings, effect_findings, place_findings, reach_findings, travel_findings)
    return [finding for kind in kinds for finding in kind(subject)]


def tumble_findings(controller: Controller) -> Iterator[Finding]:
    """Noise that turns over what it should tell about, and whether it was lowered."""
    scene, layout = controller.scene, controller.layout
    found = controller.lowered or tumble(scene, controller.compiled, controller.engine.name)
    if found is None:
        return
    names = [name for name, factor in zip(layout.control_name, found.factor, strict=True) if factor < 1.0]
    sets = Changes(controller).sigma(1.0 if controller.lowered else found.factor)
    told = " and ".join(f"{key} = {value}" for key, value in sets.items())
    yield Finding(
        "planner.noise.sigma",
        f"samples{' with the default' if controller.lowered else ''} turn {found.body} over ({OVER:g} rad) within "
        f"{found.time:.2g} s by {some(names)}, and knots are {found.knots:.2g} s apart",
        f"plans take {told}" if controller.lowered else f"try {told}, with which they do not",
    )


def _at_once(monitor: Monitor) -> Iterator[Finding]:
    """Runs that end as they begin."""
    if monitor.failure is not None:
        yield Finding(
            f"failure.{monitor.failure}",
            "it holds at the start: every run fails at once",
            "change its conditions (above, below, distance), or let it count from a later time (after)",
        )
