# SPDX-License-Identifier: Apache-2.0
"""Noise that a robot cannot bear: samples turn what no control holds, before the next knot can turn it back.

Each control in turn is held at σ and -σ from what holds the start, for the time τ between two knots. With R_b(u) the
rotation of body b then, and ω_b,i = log(R_b(u)ᵀ R_b(u ± σ_i e_i)) the tangent vector between two of them, noise that is
independent in all controls turns b by ρ_b = √(Σ_i |ω_b,i|²). Where ρ_b exceeds one radian, thrusts and weights point
elsewhere than what was planned from them, and samples tell chance apart. It is the same number for every robot: angles
have no unit, and half of what held a body against gravity is left at cos ρ = 0.54.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ...engine.mujoco import MujocoSimulator
from ...engine.registry import physics_steps
from ...loop.run.result import Changes
from ...physics.runtime.launch import capturing
from ...planner.covariance import control_sigma
from ...scene.errors import some
from ...scene.model.mujoco_model import Options, driven_joint
from ...scene.model.trajectory import BatchSize
from ...scene.registry import ENGINES
from ...scene.task.observed import ObservedState
from ...scene.task.task import Task
from .subject import Finding, Subject

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...planner.controller.controller import Controller

OVER = 1.0
"""Rotation from which a body is turned over [rad]."""
FACTORS = 0.5 ** (0.5 * np.arange(10))
"""Factors on σ that are tried, in one launch."""
PART = 0.5
"""Share of the largest rotation by one control from which another one is named with it."""
LEVER = 1e-3
"""Distance of what a hinge carries from its axis, from which its angle counts [m]: wheels may turn."""


@dataclass(frozen=True)
class Tumble:
    """Noise that turns a body over."""

    body: str
    time: float
    """Time after which it is turned over [s]."""
    knots: float
    """Time between two knots [s]."""
    factor: np.ndarray
    """Factor on the σ of each control ``[nu]`` with which it is not, 1 for controls that hardly turn it."""


def tumble(controller: Controller) -> Tumble | None:
    """What the noise of a controller's samples turns over first; None where they turn nothing over."""
    if not ENGINES[controller.engine.name].physics:
        return None
    subject = Subject(controller.scene, controller.compiled)
    turning = _free_turns(subject)
    if not turning:
        return None
    length, turned = _turned(subject, controller, list(turning.values()))
    total = np.sqrt((turned[0] ** 2).sum(axis=0))  # of each rotation and time
    worst = int(total.max(axis=-1).argmax())
    if not total[worst].max() > OVER:
        return None
    alone = turned[0, :, worst].max(axis=-1)
    named = alone >= PART * alone.max()
    lower = np.where(named[:, None, None], turned, turned[:1])
    kept = np.sqrt((lower**2).sum(axis=1)).max(axis=(1, 2)) <= OVER
    factor = np.where(named, FACTORS[np.argmax(kept) if kept.any() else -1], 1.0)
    time = length * (1 + int(np.argmax(total[worst] > OVER)))
    return Tumble([*turning][worst], time, length * total.shape[-1], factor)


def _free_turns(subject: Subject) -> dict[str, list[int]]:
    """Velocity coordinates in which robots turn and nothing holds them, by the name of what turns."""
    model, world, found = subject.world.model, subject.world, {}
    driven, tied = {driven_joint(model, a) for a in range(model.nu)}, _tied(model)
    robots = {b for e in subject.compiled.layout.entities if e.kind == "robot" for b in world.bodies.get(e.name, ())}
    for joint in set(range(model.njnt)) - driven:
        body, kind, first = (int(x[joint]) for x in (model.jnt_bodyid, model.jnt_type, model.jnt_dofadr))
        if body not in robots - tied or kind == mujoco.mjtJoint.mjJNT_SLIDE:
            continue
        skip, count = {mujoco.mjtJoint.mjJNT_FREE: (3, 3), mujoco.mjtJoint.mjJNT_BALL: (0, 3)}.get(kind, (0, 1))
        moved = np.zeros((3, model.nv))
        mujoco.mj_jacSubtreeCom(model, subject.start, moved, body)
        base = model.body_weldid[model.body_parentid[body]] == 0
        if base or count > 1 or np.linalg.norm(moved[:, first]) > LEVER:
            found[model.body(body).name] = list(range(first + skip, first + skip + count))
    return found


def _tied(model: mujoco.MjModel) -> set[int]:
    """Bodies that a constraint carries: of a loop, or of a hand that is led."""
    found: set[int] = set()
    for e in np.flatnonzero(np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))):
        above = [set(), set()]
        for bodies, body in zip(above, (model.eq_obj1id[e], model.eq_obj2id[e]), strict=True):
            body = int(model.site_bodyid[body] if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE else body)
            while body > 0:
                bodies.add(body)
                body = int(model.body_parentid[body])
        found |= above[0] ^ above[1]
    return found


def _turned(subject: Subject, controller: Controller, dofs: list[list[int]]) -> tuple[float, np.ndarray]:
    """Length of a physics step [s], and rotations ``[factor, nu, rotation, T]`` from where the start is held [rad]."""
    scene, layout, grid = subject.scene, controller.layout, controller.plan_step.grid
    nu, length = layout.nu, physics_steps(controller.engine.name, scene, subject.compiled, grid).length[0]
    knots = controller.plan_step.strategy.knots.shape[2]
    steps = max(round(float(grid.t[-1]) / max(knots - 1, 1) / length), 1)
    sigma = np.diag(control_sigma(scene, layout))
    noise = np.concatenate([np.zeros((1, nu)), (FACTORS[:, None, None, None] * [sigma, -sigma]).reshape(-1, nu)])
    control = np.clip(subject.held + noise, layout.control_lower, layout.control_upper)
    with capturing:  # nothing may be allocated while a controller records its plan
        simulator = MujocoSimulator(
            subject.compiled,
            BatchSize(1, len(control), 1, 1),
            substeps=[steps],
            timestep=length,
            options=Options.of(scene.engine),
            sensors=(),
            threads=1,
        )
        simulator.clone(ObservedState.allocate(layout, Task(scene), "cpu"))
        simulator.rollout(wp.array(control[None], dtype=float, device="cpu"))
        simulator.close()
    model, q = simulator.model, simulator.state[..., 1 : 1 + simulator.model.nq]  # after the time
    apart = np.zeros((len(control), steps, model.nv))
    for world, step in np.ndindex(apart.shape[:2]):
        mujoco.mj_differentiatePos(model, apart[world, step], 1.0, q[0, step], q[world, step])
    turned = np.stack([np.linalg.norm(apart[1:, :, own], axis=-1) for own in dofs], axis=1)
    return length, np.nan_to_num(turned.reshape(len(FACTORS), 2, nu, len(dofs), steps).max(axis=1), nan=np.pi)


def tumble_findings(controller: Controller) -> Iterator[Finding]:
    """Noise that turns over what it should tell about."""
    found = tumble(controller)
    if found is None:
        return
    layout = controller.layout
    names = [name for name, factor in zip(layout.control_name, found.factor, strict=True) if factor < 1.0]
    ((key, value),) = Changes(controller).sigma(found.factor).items()
    yield Finding(
        "planner.noise.sigma",
        f"samples turn {found.body} over ({OVER:g} rad) within {found.time:.2g} s by {some(names)}, and knots are "
        f"{found.knots:.2g} s apart",
        f"try {key} = {value}, with which they do not",
    )
