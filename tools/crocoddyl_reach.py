#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""iLQG beside Crocoddyl's box-DDP on an arm that reaches without contact: same problem, same optimum?

    pip install crocoddyl
    python tools/crocoddyl_reach.py

The Panda is driven by joint torques, gravity acts, both integrate by semi-implicit Euler steps of 20 ms. The cost is
a quadratic one of where the hand is, of joint velocities and of torques. Both start from the torques that hold the arm,
and stop when a step changes the cost by less than 1e-7 of it. Crocoddyl (Mastalli et al. 2020) takes Pinocchio's
analytical derivatives and a single thread.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warpmpc import Controller, Scene, State

ASSET = Path(__file__).parents[1] / "scenes/assets/panda.urdf"
START = [0.0, -0.6, 0.0, -2.0, 0.0, 1.6, 0.8]  # [rad]
TARGET = (0.45, 0.35, 0.55)  # [m]
LIMIT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # [N·m]
PLACE, SPEED, EFFORT = 100.0, 0.05, 0.01
"""Weights of ½‖x - target‖², Σ q̇² and Σ (τ / limit)²."""
DT, STEPS = 0.02, 64
ENOUGH = 1e-7


@dataclass(frozen=True)
class Solved:
    """What a solver came to."""

    cost: float
    iterations: int
    ms: float
    """Wall time of an iteration [ms]."""
    control: np.ndarray
    """``[T, nu]``."""


def scene(engine: str) -> Scene:
    """The reach."""
    return Scene.model_validate(
        {
            "timing": {"control_dt": DT},
            "ground": None,
            "robot": [
                {
                    "name": "arm",
                    "asset": str(ASSET),
                    "joint_q": START,
                    "self_collision": False,
                    "frames": {"hand": {"link": "panda_link7"}},
                    "drive": {"mode": "effort", "limit": LIMIT.tolist()},
                }
            ],
            "engine": {"name": engine, "substeps": 1, "integrator": "euler"},
            "goal": {"frame": "arm/hand", "position": TARGET},
            "cost": [
                {"term": "position_residual", "of": "arm/hand", "target": list(TARGET), "weight": PLACE},
                {"term": "joint_velocity", "weight": SPEED},
                {"term": "control_effort", "weight": EFFORT},
            ],
            "planner": {"method": "ilqg", "horizon": STEPS, "discount": 1.0, "randomize": False, "samples": 8},
            "success": {"distance": 0.01},
        }
    )


def ours(engine: str, hold: np.ndarray, most: int) -> Solved:
    """Plan from the same state until nothing changes."""
    controller = Controller(scene(engine), device="cpu", engine=engine)
    state = replace(State.start(controller.layout), time=0.0)
    controller.step(state)  # compiles
    controller.reset()
    controller.planner.strategy.reset(np.tile(hold, (STEPS, 1)))
    costs, times = [np.inf], []
    for _ in range(most):
        start = time.perf_counter()
        controller.step(state)
        times.append(1e3 * (time.perf_counter() - start))
        costs.append(controller.info.cost)
        if abs(costs[-2] - costs[-1]) < ENOUGH * costs[-1]:
            break
    return Solved(costs[-1], len(times), float(np.median(times)), controller.planner.strategy.mean.numpy()[0])


def pinocchio_model() -> object:
    """The arm as Pinocchio has it, without shapes: its reader knows no capsules."""
    import pinocchio

    robot = ElementTree.parse(ASSET).getroot()
    for link in robot.iter("link"):
        for shape in [*link.findall("collision"), *link.findall("visual")]:
            link.remove(shape)
    return pinocchio.buildModelFromXML(ElementTree.tostring(robot, encoding="unicode"))


def holding() -> np.ndarray:
    """Torques that hold the arm where it starts ``[7]``."""
    import pinocchio

    model = pinocchio_model()
    return pinocchio.rnea(model, model.createData(), np.array(START), np.zeros(7), np.zeros(7))


def theirs(hold: np.ndarray, most: int) -> Solved:
    """The same problem in Crocoddyl; its node t has what control t and the state after control t - 1 cost."""
    import crocoddyl

    model = pinocchio_model()
    state = crocoddyl.StateMultibody(model)
    actuation = crocoddyl.ActuationModelFull(state)
    hand = model.getFrameId("panda_link7")

    def node(*, place: bool, effort: bool) -> crocoddyl.IntegratedActionModelEuler:
        costs, share = crocoddyl.CostModelSum(state), 1.0 / DT if effort else 1.0  # running costs are integrated

        def add(name: str, residual: object, weights: np.ndarray, weight: float) -> None:
            activation = crocoddyl.ActivationModelWeightedQuad(weights)
            costs.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), share * weight)

        if place:
            add("place", crocoddyl.ResidualModelFrameTranslation(state, hand, np.array(TARGET)), np.ones(3), PLACE)
            add("speed", crocoddyl.ResidualModelState(state, np.zeros(14)), np.repeat([0.0, 2.0], 7), SPEED)
        if effort:
            add("effort", crocoddyl.ResidualModelControl(state), 2.0 / LIMIT**2, EFFORT)
        action = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        out = crocoddyl.IntegratedActionModelEuler(action, DT if effort else 0.0)
        out.u_lb, out.u_ub = -LIMIT, LIMIT
        return out

    start = np.concatenate([START, np.zeros(7)])
    running = [node(place=False, effort=True), *[node(place=True, effort=True)] * (STEPS - 1)]
    problem = crocoddyl.ShootingProblem(start, running, node(place=True, effort=False))
    problem.nthreads = 1
    solver, log = crocoddyl.SolverBoxDDP(problem), crocoddyl.CallbackLogger()
    solver.setCallbacks([log])
    solver.th_stop = 1e-300  # told apart below, as for ours
    control = [hold] * STEPS
    began = time.perf_counter()
    solver.solve(problem.rollout(control), control, most, True)
    took = 1e3 * (time.perf_counter() - began)
    costs = np.array(log.costs)
    small = np.flatnonzero(np.abs(np.diff(costs)) < ENOUGH * costs[1:])
    count = int(small[0]) + 1 if len(small) else len(costs)
    return Solved(float(costs[count - 1]), count, took / len(costs), np.array(solver.us))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=100, help="iterations at most")
    args = parser.parse_args()
    hold = holding()
    found = {"crocoddyl": theirs(hold, args.most)}
    for engine in ("mujoco", "fused"):
        found[engine] = ours(engine, hold, args.most)
    best = found["crocoddyl"].cost
    print("| solver | cost | beside Crocoddyl's | iterations | ms an iteration |\n|---|---|---|---|---|")
    for name, solved in found.items():
        print(
            f"| {name} | {solved.cost:.6f} | {solved.cost / best - 1.0:+.1e} | {solved.iterations} | {solved.ms:.1f} |"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
