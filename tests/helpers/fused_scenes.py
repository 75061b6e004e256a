# SPDX-License-Identifier: Apache-2.0
"""Shipped scenes stepped by the engines `fused` and `mujoco`, from the same states, in the same randomized worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from unittest.mock import patch

import numpy as np
import warp as wp

import warpmpc
from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.physics import model as physics_model
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.mujoco_model import Options
from warpmpc.scene.model.pairs import Pair, collision_pairs
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize, Trajectory
from warpmpc.scene.task.observed import ObservedState

EDGE = 3e-7
"""How far states are moved to see how MuJoCo C itself replies to the rounding of floats [m, rad]."""


@dataclass
class Steps:
    """Single steps of W worlds in both engines."""

    v: np.ndarray  # [W] largest difference of joint velocities
    q: np.ndarray  # [W] of joint coordinates
    pose: np.ndarray  # [W] of body poses, but for the sign of quaternions
    twist: np.ndarray  # [W] of body velocities
    force: np.ndarray  # [W] of the forces of watched pairs [N]
    strength: np.ndarray  # [W] largest force of a watched pair [N]
    edge: np.ndarray  # [W] how much MuJoCo C's own velocities jump when the state moves by EDGE: not in proportion
    speed: np.ndarray  # [W] largest joint velocity

    def __str__(self) -> str:
        steady = self.edge < 1e-4
        forces, jumps = 100 * (self.strength > 0).mean(), 100 * (~steady).mean()
        out = [f"{len(self.v)} steps, {forces:.0f} % with forces, MuJoCo jumps in {jumps:.2f} %"]
        for name in ("v", "q", "pose", "twist", "force"):
            a = getattr(self, name)[steady]
            out.append(f"{name} " + "/".join(f"{x:.1e}" for x in (*np.percentile(a, (50, 90, 99)), a.max())))
        return "; ".join(out) + f"; dv beyond 1e-4: {100 * (self.v[steady] > 1e-4).mean():.2f} %"


class Comparison:
    """Both engines over a scene, for single physics steps of ``states`` states in ``samples`` worlds each.

    Args:
        name: Scene and variant.
        states: Number of states E, visited by rollouts of the engine ``mujoco`` in closed loop.
        samples: Worlds S per state, each with its own draw.
        seconds: Length of the closed-loop run [s].
        horizon: Steps rolled out.
        substeps: Physics steps in each.
        overrides: Changes of the scene.
    """

    def __init__(
        self,
        name: str,
        *,
        states: int = 64,
        samples: int = 8,
        seconds: float = 4.0,
        horizon: int = 1,
        substeps: int = 1,
        overrides: Sequence[str] = (),
    ):
        self.scene = warpmpc.load_scene(name, overrides=["planner.samples=16", "engine.threads=1", *overrides])
        self.compiled = compile_scene(self.scene)
        self.layout, self.horizon = self.compiled.layout, horizon
        self.rng = np.random.default_rng(0)
        self.state, self.sampled, timestep = self._visit(states, seconds)
        self.shape = BatchSize(states, samples, 1, horizon)
        objects = self.layout.group("objects")
        self.pairs = collision_pairs(self.layout)
        self.pairs += tuple(Pair(r.name, o.name) for r in self.layout.group("robots") for o in objects)
        common = {
            "substeps": [substeps] * horizon,
            "timestep": timestep,
            "pairs": self.pairs,
            "properties": draw_properties(self.scene, self.layout, samples, seed=1),
        }
        with patch.object(physics_model, "LEAST_TOLERANCE", 1e-10):
            # on to the minimum: at 1e-6 of a robot's inertia either stops where a light box is not yet at rest
            whole = self.scene.engine.model_copy(update={"iterations": 100, "tolerance": 1e-10})
            scene = self.scene.model_copy(update={"engine": whole})
            self.fused = FusedPhysics(scene, self.compiled, self.shape, device="cpu", **common)
            assert self.fused.work.given  # which reads it
        self.mujoco = MujocoSimulator(
            self.compiled, self.shape, threads=1, options=Options.of(self.scene.engine), sensors=(), **common
        )
        for model in {id(m): m for m in self.mujoco.models}.values():  # and so does MuJoCo
            model.opt.tolerance, model.opt.iterations = 0.0, 200
            model.opt.ls_tolerance, model.opt.ls_iterations = 1e-10, 100

    def _visit(self, states: int, seconds: float) -> tuple[ObservedState, np.ndarray, float]:
        """States of rollouts in closed loop, controls ``[n, nu]`` that were sampled there, and the physics step [s]."""
        controller = warpmpc.Controller(self.scene, engine="mujoco", compiled=self.compiled)
        plant = warpmpc.Plant(self.scene, compiled=self.compiled, task=controller.task)
        found, sampled = [], []
        while not plant.done and plant.time < seconds:
            plant.apply(controller.step(plant.observe()))
            out = controller.engine.simulator.trajectory
            t, w = self.rng.integers(out.joint_q.shape[0], size=8), self.rng.integers(out.joint_q.shape[1], size=8)
            found += list(zip(out.joint_q.numpy()[t, w], out.joint_qd.numpy()[t, w], strict=True))
            sampled.append(controller.engine.recorded.control.numpy()[t % self.scene.planner.horizon, w])
        timestep = controller.engine.simulator.model.opt.timestep
        rows = self.rng.choice(len(found), size=states, replace=len(found) < states)
        given = {item.name: getattr(controller.plan_step.state, item.name) for item in fields(ObservedState)}
        rows_of = {name: np.repeat(a.numpy(), states, axis=0) for name, a in given.items()}
        tiled = {name: wp.array(rows_of[name], dtype=a.dtype, device="cpu") for name, a in given.items()}
        tiled["joint_q"].assign(np.array([found[i][0] for i in rows]))
        tiled["joint_qd"].assign(np.array([found[i][1] for i in rows]))
        controller.engine.close()
        return ObservedState(**tiled), np.concatenate(sampled), float(timestep)

    def _roll(self, engine: FusedPhysics | MujocoSimulator, control: np.ndarray) -> dict[str, np.ndarray]:
        engine.clone(self.state)
        engine.rollout(wp.array(control, dtype=float, device="cpu"))
        out = engine.trajectory
        assert not out.diverged.numpy().any()
        assert not out.overflow.numpy().any()
        names = ("joint_q", "joint_qd", "body_q", "body_qd", "contact_force")
        return {name: getattr(out, name).numpy()[-self.horizon :].astype(float).copy() for name in names}

    def ends(self, nudge: float = 1e-6) -> tuple[np.ndarray, np.ndarray]:
        """How far joint coordinates are apart after the whole horizon ``[W]``, and how far MuJoCo C takes a nudge.

        The nudge is a share of coordinates above one, such as wheels' angles, which single precision holds no better.
        """
        control = self._controls()
        ours, theirs = (self._roll(engine, control)["joint_q"][-1:] for engine in (self.fused, self.mujoco))
        self.mujoco.clone(self.state)
        size = np.maximum(1.0, np.abs(self.mujoco.initial[:, 1 : 1 + self.mujoco.model.nq]))
        near = self._nudged(control, nudge * size * self._directions()).joint_q.numpy()[-1:]
        return _most(ours - theirs), _most(near - theirs)

    def _controls(self) -> np.ndarray:
        pick = self.rng.integers(len(self.sampled), size=(self.horizon, self.shape.worlds))
        return self.sampled[pick].astype(np.float32)

    def _directions(self) -> np.ndarray:
        return self.rng.choice([-1.0, 1.0], (self.shape.worlds, self.mujoco.model.nq))

    def _nudged(self, control: np.ndarray, nudge: np.ndarray) -> Trajectory:
        """MuJoCo C's rollouts from where the state has moved a little, ``[W, nq]``."""
        self.mujoco.clone(self.state)
        self.mujoco.initial[:, 1 : 1 + nudge.shape[1]] += nudge
        self.mujoco.rollout(wp.array(control, dtype=float, device="cpu"))
        return self.mujoco.trajectory

    def steps(self, nudges: int = 3) -> Steps:
        """Single steps compared."""
        control = self._controls()
        ours, theirs = self._roll(self.fused, control), self._roll(self.mujoco, control)
        edge = np.zeros(self.shape.worlds)
        for _ in range(nudges):
            nudge = EDGE * self._directions()
            far, near = (
                self._nudged(control, x).joint_qd.numpy()[-self.horizon :].copy() for x in (nudge, 0.1 * nudge)
            )
            edge = np.maximum(edge, _most(far - theirs["joint_qd"] - 10.0 * (near - theirs["joint_qd"])))
        return Steps(
            v=_most(ours["joint_qd"] - theirs["joint_qd"]),
            q=_most(ours["joint_q"] - theirs["joint_q"]),
            pose=_most(_turned(ours["body_q"], theirs["body_q"]) - theirs["body_q"]),
            twist=_most(ours["body_qd"] - theirs["body_qd"]),
            force=_most(ours["contact_force"] - theirs["contact_force"]),
            strength=_most(theirs["contact_force"]),
            edge=edge,
            speed=_most(theirs["joint_qd"]),
        )


def _most(difference: np.ndarray) -> np.ndarray:
    """Largest entry of every world."""
    rows = np.abs(np.moveaxis(difference, 1, 0)).reshape(difference.shape[1], -1)
    return rows.max(axis=1, initial=0.0)


def _turned(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Poses with the signs of others' quaternions."""
    sign = np.where((ours[..., 3:] * theirs[..., 3:]).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
    return np.concatenate([ours[..., :3], sign * ours[..., 3:]], axis=-1)
