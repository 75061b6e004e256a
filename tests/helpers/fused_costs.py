# SPDX-License-Identifier: Apache-2.0
"""What the engine `fused` says its samples cost, and what the Warp functions of the terms say about its own record."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import warp as wp

from warpmpc import Controller, Scene, State
from warpmpc.cost.stack import CostEvaluator
from warpmpc.engine.protocol import Proposal
from warpmpc.scene.model.trajectory import Trajectory


def held(knots: np.ndarray, device: str = "cpu") -> Proposal:
    """Knots ``[E, S, P, nu]`` as they are: nothing is sampled."""
    offset = wp.zeros(len(knots), dtype=float, device=device)
    return Proposal(wp.array(knots, dtype=float, device=device), offset, knots.shape[1])


def planned(scene: Scene, *, envs: int = 1, seed: int = 0, plans: int = 2, speed: float = 0.3, **kwargs) -> Controller:
    """A controller after some plans from moving starts, different ones in every environment."""
    mpc = Controller(scene, engine="fused", seed=seed, envs=envs, **kwargs)
    rng, layout = np.random.default_rng(seed), mpc.layout
    q, qd = (np.tile(a, (envs, 1)) for a in (layout.joint_q, layout.joint_qd))
    qd[:, layout.actuator_dof] += rng.normal(0.0, speed, (envs, len(layout.actuator_dof)))
    state = State(q, qd) if envs > 1 else State(q[0], qd[0])
    for _ in range(plans):
        mpc.step(state)
    return mpc


def recorded(mpc: Controller) -> Trajectory:
    """The engine's record of all worlds, on the device."""
    out = Trajectory.allocate(mpc.shape, mpc.layout, len(mpc.costs.pairs), "cpu")
    found = mpc.engine.record(range(mpc.shape.worlds))
    for field in fields(found):
        getattr(out, field.name).assign(getattr(found, field.name))
    return out


def expected_totals(mpc: Controller) -> np.ndarray:
    """Cost of each term over the horizon ``[term, W]``, by the kernels that judge the records of all engines."""
    out = recorded(mpc)
    evaluator = CostEvaluator(mpc.costs, out, out.control, mpc.engine.state, mpc.shape, mpc.plan_step.grid.t)
    evaluator.launch()
    evaluator.launch_arrays()
    stage = evaluator.cost.numpy().astype(np.float64)
    return (stage * mpc.plan_step.grid.discount[None, :, None]).sum(axis=1)


def assert_costs(mpc: Controller, expected: np.ndarray, rtol: float = 1e-5) -> None:
    """The engine's totals are the expected ones, and its costs their sums where there is one domain."""
    found = mpc.engine.total.numpy()
    for label, a, b in zip(mpc.costs.labels, found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * (1.0 + np.abs(b).max()), err_msg=label)
    if mpc.shape.domains == 1:
        np.testing.assert_allclose(mpc.engine.cost.numpy().ravel(), expected.sum(axis=0), rtol=2 * rtol)


def risk_of(cost: np.ndarray, risk: str, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Cost of samples from those of their domains ``[n, D]``, and each domain's share in it ``[n, D]``."""
    domains = cost.shape[1]
    tail = {"mean": float(domains), "worst": 1.0, "cvar": max(alpha * domains, 1.0)}[risk]
    rank = np.argsort(np.argsort(-cost, axis=1, kind="stable"), axis=1)
    share = np.clip(tail - rank, 0.0, 1.0) / tail
    return (share * cost).sum(axis=1), share
