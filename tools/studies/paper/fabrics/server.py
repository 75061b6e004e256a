# SPDX-License-Identifier: Apache-2.0
"""A fabric in a separate process: a robot and spheres on the first line, then a state a line, each answered.

Runs by a Python that has the package ``fabrics``, which needs NumPy below 2; it imports nothing else of this checkout.
All lines are JSON. A state is ``q`` and ``qd``; the answer is the control ``u`` [m/s or rad/s] and the time ``ms``.
"""

import json
import logging
import sys
import time

import casadi as ca
import numpy as np
from fabrics.planner.parameterized_planner import ParameterizedFabricPlanner
from forwardkinematics.urdfFks.generic_urdf_fk import GenericURDFFk
from mpscenes.goals.goal_composition import GoalComposition


class Plane:
    """Forward kinematics of a point in the plane: its place is its joints."""

    def casadi(self, q, link, **_):
        """Place of a link ``[2]``."""
        return ca.SX(np.zeros(2)) if link == "world" else q[:2]


def build(task: dict) -> tuple[ParameterizedFabricPlanner, dict]:
    """The planner, with the package's own geometries and gains, and the values of its parameters."""
    size, urdf, root, hand = task["dimension"], task["urdf"], task["root"], task["hand"]
    kinematics = GenericURDFFk(urdf, root_link=root, end_links=[hand]) if urdf else Plane()
    planner = ParameterizedFabricPlanner(len(task["speed"]), kinematics)
    q, values = planner.variables.position_variable(), {}
    for i, (links, radius) in enumerate(task["points"]):
        at = sum(share * kinematics.casadi(q, link, position_only=True) for link, share in links.items())
        values[f"radius_body_point_{i}"] = np.array([radius])
        for j in range(len(task["spheres"])):
            planner.add_spherical_obstacle_geometry(f"sphere_{j}", f"point_{i}", at[:size])
    for j, (centre, radius) in enumerate(task["spheres"]):
        values |= {f"x_sphere_{j}": np.array(centre[:size]), f"radius_sphere_{j}": np.array([radius])}
    for i, limits in enumerate(task["limits"]):
        planner.add_limit_geometry(i, limits)
    goal = {"weight": 1.0, "is_primary_goal": True, "indices": list(range(size)), "parent_link": root}
    goal |= {"child_link": hand, "desired_position": task["goal"][:size], "epsilon": 0.05, "type": "staticSubGoal"}
    planner.set_components(goal=GoalComposition(name="goal", content_dict={"goal": goal}), number_obstacles=0)
    planner.concretize()
    return planner, values | {"x_goal_0": np.array(task["goal"][:size]), "weight_goal_0": np.array([1.0])}


def main() -> None:
    """Answer until the input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # libraries chat
    logging.disable(logging.WARNING)
    task = json.loads(sys.stdin.readline())
    planner, values = build(task)
    fastest, dt, steps = np.array(task["speed"]), task["dt"], task["steps"]
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        state, begin = json.loads(line), time.perf_counter()
        start = q = np.array(state["q"])
        qd = np.array(state["qd"])
        for _ in range(steps):
            qdd = planner.compute_action(q=q, qdot=qd, **values)
            qd = np.clip(qd + dt / steps * qdd, -fastest, fastest)
            q = q + dt / steps * qd
        answer = {"u": ((q - start) / dt).tolist(), "ms": 1e3 * (time.perf_counter() - begin)}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
