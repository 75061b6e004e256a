# SPDX-License-Identifier: Apache-2.0
"""Single steps of the engine `fused` from states that MuJoCo C visits, and MuJoCo C's own from there."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from shared.plain_rollout import PlainRollout

from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.physics import rollout

if TYPE_CHECKING:
    from collections.abc import Mapping


def exact(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose solver goes on to the minimum: at its usual tolerance MuJoCo C stops where floats still differ."""
    out = copy.copy(model)
    out.opt.tolerance, out.opt.iterations = 0.0, 200
    out.opt.ls_tolerance, out.opt.ls_iterations = 1e-10, 100
    return out


@dataclass
class Visited:
    """States that MuJoCo C visits, as floats can hold them, and where its next step takes them; N of them."""

    q: np.ndarray  # [N, nq]
    v: np.ndarray  # [N, nv]
    act: np.ndarray  # [N, na]
    control: np.ndarray  # [N, nu]
    next_q: np.ndarray  # [N, nq]
    next_v: np.ndarray  # [N, nv]
    next_act: np.ndarray  # [N, na]
    contacts: np.ndarray  # [N] contacts with a row
    rows: np.ndarray  # [N] constraint rows
    world: np.ndarray  # [N] world that each is of
    depth: np.ndarray  # [N] how deep the deepest contact is [m]
    edge: np.ndarray  # [N] how much next_v changes at most when q moves by EDGE: much where a contact begins or ends


EDGE = 3e-7
"""How far states are moved to see how MuJoCo C itself replies to the rounding of floats [m, rad]."""
NUDGES = 4
"""How often."""


def visit(
    models: list[mujoco.MjModel],
    q: np.ndarray,
    v: np.ndarray,
    control: np.ndarray,
    *,
    every: int = 1,
) -> Visited:
    """Roll worlds out in MuJoCo C and take single exact steps from where they come by.

    Args:
        models: A model for every world, or one for all.
        q: Coordinates at the start ``[W, nq]``.
        v: Velocities at the start ``[W, nv]``.
        control: Controls of every physics step ``[T, W, nu]``.
        every: Steps between the states.
    """
    silence_mujoco()
    found: dict[str, list] = {name: [] for name in Visited.__dataclass_fields__}
    rng = np.random.default_rng(0)
    tight: dict[int, mujoco.MjModel] = {}
    for w in range(len(q)):
        model = models[w % len(models)]
        reference = tight.setdefault(id(model), exact(model))
        data, one = mujoco.MjData(model), mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q[w], v[w]
        for t in range(len(control)):
            for array in (data.qpos, data.qvel, data.act):
                array[:] = array.astype(np.float32)
            data.ctrl[:] = control[t, w]
            if t % every == 0:
                near = []
                for _ in range(NUDGES):
                    _step(reference, one, data, EDGE * rng.choice([-1.0, 1.0], model.nv))
                    near.append(one.qvel.copy())
                _step(reference, one, data)
                edge = np.abs(near - one.qvel).max()
                contacts = (one.contact.exclude == 0).sum()
                depth = -min(one.contact.dist.min(initial=0.0), 0.0)
                before, after = (data.qpos, data.qvel, data.act, data.ctrl), (one.qpos, one.qvel, one.act)
                row = (*before, *after, contacts, one.nefc, w, depth, edge)
                for name, value in zip(found, row, strict=True):
                    found[name].append(np.copy(value))
            mujoco.mj_step(model, data)
    return Visited(**{name: np.array(values) for name, values in found.items()})


def _step(model: mujoco.MjModel, one: mujoco.MjData, data: mujoco.MjData, nudge: np.ndarray | None = None) -> None:
    """One step from where ``data`` is, moved a little."""
    mujoco.mj_resetData(model, one)
    one.mocap_pos[:], one.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    one.qpos[:], one.qvel[:], one.act[:], one.ctrl[:] = data.qpos, data.qvel, data.act, data.ctrl
    if nudge is not None:
        mujoco.mj_integratePos(model, one.qpos, nudge, 1.0)
    mujoco.mj_step(model, one)


def turned(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest difference of coordinates, in the tangent space where they are quaternions ``[N]``."""
    out, row = np.empty(len(a)), np.empty(model.nv)
    for n in range(len(a)):
        mujoco.mj_differentiatePos(model, row, 1.0, a[n].astype(float), b[n].astype(float))
        out[n] = np.abs(row).max()
    return out


@dataclass
class Differences:
    """How far apart single steps end, of each state."""

    v: np.ndarray  # [N, nv]
    q: np.ndarray  # [N] the largest
    visited: Visited

    def beyond(self, limit: float) -> float:
        """Share of the states whose velocity differs by more than this anywhere."""
        return float((self.v.max(axis=1) > limit).mean())

    def __str__(self) -> str:
        most = self.v.max(axis=1)
        p50, p90, p99 = np.percentile(most, (50, 90, 99))
        touching = (self.visited.rows > 0).mean()
        out = f"{len(most)} states, {100 * touching:.0f} % with constraints; |dv| p50 {p50:.1e}, p90 {p90:.1e}, "
        out += f"p99 {p99:.1e}, largest {most.max():.1e}, beyond 1e-4: {100 * self.beyond(1e-4):.2f} %; "
        return out + f"|dq| largest {self.q.max():.1e}"


def step_differences(
    model: mujoco.MjModel,
    visited: Visited,
    *,
    arrays: Mapping[str, np.ndarray] | None = None,
    lanes: int | None = None,
    device: str = "cpu",
) -> Differences:
    """Take single steps with the engine from all visited states.

    Args:
        model: The model.
        visited: The states.
        arrays: Arrays of the model that differ between worlds ``[W, ...]``.
        lanes: Worlds in a number.
        device: Warp device.
    """
    arrays = {name: values[visited.world] for name, values in (arrays or {}).items()}
    engine = PlainRollout(model, len(visited.q), 1, arrays=arrays, lanes=lanes, device=device)
    q, v = engine(visited.q, visited.v, visited.control[None], visited.act)
    assert not engine.work.overflow.numpy().any()
    np.testing.assert_allclose(engine.work.record_act.numpy()[1], visited.next_act, atol=2e-6)
    return Differences(np.abs(v[0] - visited.next_v), turned(model, q[0], visited.next_q), visited)


def public_differences(model: mujoco.MjModel, visited: Visited) -> Differences:
    """Take single steps with the public rollouts from all visited states."""
    q, v = visited.q, visited.v
    states = np.hstack([np.zeros((len(q), 1)), q, v, visited.act])
    with rollout.Rollout(fall_back=False) as pool:
        ends, _ = pool.rollout(model, mujoco.MjData(model), states, visited.control[:, None], nstep=1)
    ends = ends[:, 0, 1:]
    own_q, own_v, own_act = np.split(ends, [model.nq, model.nq + model.nv], axis=1)
    np.testing.assert_allclose(own_act, visited.next_act, atol=2e-6)
    return Differences(np.abs(own_v - visited.next_v), turned(model, own_q, visited.next_q), visited)
