# SPDX-License-Identifier: Apache-2.0
"""Noise that a robot cannot bear: samples turn what no control holds, before the next knot can turn it back.

Each control in turn is held at σ and -σ from what holds the start, for the time τ between two knots. With R_b(u) the
rotation of body b then, and ω_b,i = log(R_b(u)ᵀ R_b(u ± σ_i e_i)) the tangent vector between two of them, noise that is
independent in all controls turns b by ρ_b = √(Σ_i |ω_b,i|²). Where ρ_b exceeds one radian, thrusts and weights point
elsewhere than what was planned from them, and samples tell chance apart. It is the same number for every robot: angles
have no unit, and half of what held a body against gravity is left at cos ρ = 0.54. Where a scene leaves σ to the
defaults, knots are closer (unless it gives their number), and σ is lowered to what does not, control by control.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ..engine.mujoco import MujocoSimulator
from ..engine.protocol import TimeGrid
from ..engine.registry import PREFERRED, physics_steps, steps_as_mujoco
from ..physics.runtime.launch import capturing
from ..scene.model.at_start import Subject
from ..scene.model.mujoco_model import Options, driven_joint
from ..scene.model.trajectory import BatchSize
from ..scene.schema import ShareOfRange
from ..scene.schema_planner import DIRECT
from ..scene.task.observed import ObservedState
from ..scene.task.task import Task
from .covariance import control_sigma

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.schema import Scene

OVER = 1.0
"""Rotation from which a body is turned over [rad]."""
FACTORS = 0.5 ** (0.5 * np.arange(10))
"""Factors on σ that are tried, in one launch."""
KNOTS = 10
"""Knots where noise turns something over between those of the defaults, with steps for as many: a body is turned back
sooner, and σ is lowered less. A biped on points reached its goal in 2.0 s (4.2 with five)."""
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


def tumble(scene: Scene, compiled: CompiledScene, engine: str) -> Tumble | None:
    """What the noise of a scene's samples turns over first; None where it is nothing, or the steps are not MuJoCo's.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        engine: Name of the engine that plans, or ``auto``.

    Raises:
        SceneError: If the steps of a rollout are no multiples of the engine's.
    """
    engine = PREFERRED["cpu"][0] if engine == "auto" else engine
    if not steps_as_mujoco(engine, scene) or scene.planner.method in DIRECT:
        return None
    subject = Subject(scene, compiled)
    if not (turning := _free_turns(subject)):
        return None
    held = _Held(subject, engine, [*turning.values()])
    if not _turns_over(held.turned(FACTORS[:1])[0]).any():
        return None
    turned = held.turned(FACTORS)
    total = np.sqrt((turned[0] ** 2).sum(axis=0))  # of each rotation and time
    worst = int(total.max(axis=-1).argmax())
    alone = turned[0, :, worst].max(axis=-1)
    named = alone >= PART * alone.max()
    lower = np.where(named[:, None, None], turned, turned[:1])
    kept = np.array([not _turns_over(one).any() for one in lower])
    factor = np.where(named, FACTORS[np.argmax(kept) if kept.any() else -1], 1.0)
    time = held.length * (1 + int(np.argmax(total[worst] > OVER)))
    return Tumble([*turning][worst], time, held.length * held.steps, factor)


def bearable(scene: Scene, compiled: CompiledScene, engine: str) -> tuple[Scene, Tumble | None]:
    """A scene whose default noise turns nothing over, and what it turned over; the scene itself where it gives σ."""
    planner, noise = scene.planner, scene.planner.noise
    if "sigma" in noise.model_fields_set or (found := tumble(scene, compiled, engine)) is None:
        return scene, None
    wild = found
    if "knots" not in planner.model_fields_set and planner.horizon >= KNOTS > (planner.knot_count or KNOTS):
        planner = planner.model_copy(update={"knots": KNOTS})
        scene = scene.model_copy(update={"planner": planner})
        wild = tumble(scene, compiled, engine)
    factor = np.ones_like(found.factor) if wild is None else wild.factor
    sigma = ShareOfRange(range=tuple(float(f"{value:.3g}") for value in factor * noise.sigma.range))
    planner = planner.model_copy(update={"noise": noise.model_copy(update={"sigma": sigma})})
    return scene.model_copy(update={"planner": planner}), found


def _turns_over(turned: np.ndarray) -> np.ndarray:
    """Whether noise of all controls turns over what each alone turns by ``[nu, rotation, T]``."""
    return np.sqrt((turned**2).sum(axis=0)) > OVER


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


class _Held:
    """Rotations where each control in turn is held away from what holds the start, for the time between two knots.

    Args:
        subject: The scene at its start.
        engine: Name of the engine that plans.
        dofs: Velocity coordinates of each rotation.
    """

    def __init__(self, subject: Subject, engine: str, dofs: list[list[int]]):
        self._subject, self._dofs, planner, grid = subject, dofs, subject.scene.planner, TimeGrid.of(subject.scene)
        self.length = physics_steps(engine, subject.scene, subject.compiled, grid).length[0]
        """Length of a physics step [s]."""
        knots = planner.knot_count or planner.horizon
        self.steps = max(round(float(grid.t[-1]) / max(knots - 1, 1) / self.length), 1)

    def turned(self, factors: np.ndarray) -> np.ndarray:
        """Rotations ``[factor, nu, rotation, T]`` from where the start is held, with factors on σ [rad]."""
        scene, compiled, layout = self._subject.scene, self._subject.compiled, self._subject.compiled.layout
        sigma = np.diag(control_sigma(scene, layout))
        noise = (factors[:, None, None, None] * [sigma, -sigma]).reshape(-1, layout.nu)
        control = self._subject.held + np.concatenate([np.zeros((1, layout.nu)), noise])
        control = np.clip(control, layout.control_lower, layout.control_upper)
        with capturing:  # nothing may be allocated while a controller records its plan
            shape, options = BatchSize(1, len(control), 1, 1), Options.of(scene.engine)
            length = {"substeps": [self.steps], "timestep": self.length}
            simulator = MujocoSimulator(compiled, shape, **length, options=options, sensors=(), threads=1)
            simulator.clone(ObservedState.allocate(layout, Task(scene), "cpu"))
            simulator.rollout(wp.array(control[None], dtype=float, device="cpu"))
            simulator.close()
        model, q = simulator.model, simulator.state[..., 1 : 1 + simulator.model.nq]  # after the time
        apart = np.zeros((len(control), self.steps, model.nv))
        for world, step in np.ndindex(apart.shape[:2]):
            mujoco.mj_differentiatePos(model, apart[world, step], 1.0, q[0, step], q[world, step])
        turned = np.stack([np.linalg.norm(apart[1:, :, own], axis=-1) for own in self._dofs], axis=1)
        worse = turned.reshape(len(factors), 2, layout.nu, len(self._dofs), self.steps).max(axis=1)
        return np.nan_to_num(worse, nan=np.pi)
