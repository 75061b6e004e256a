# SPDX-License-Identifier: Apache-2.0
"""MPC with hard constraints in another process: a robot and spheres on the first line, then a state a line.

Runs by a Python that has the package ``casadi``; it imports nothing else of this checkout. All lines are JSON. A
state is ``q``; the answer is the control ``u`` [m/s or rad/s] and the time ``ms``. Joint velocities u_0 to u_{T-1}
minimize the distances of the hand from its goal, with q_{k+1} = q_k + dt u_k within the joints' ranges and speeds, and
no sphere of the robot within 2 cm of one of the task. Pairs that overlap at the start may go no deeper.
"""

import json
import sys
import time

import casadi as ca
import numpy as np

EFFORT = 1e-3
"""Weight of the squares of controls."""
MARGIN = 0.02
"""Least distance of spheres [m]: velocities lag behind what is asked for, and steps have ends alone."""
OPTIONS = {
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 60, "max_cpu_time": 1.0, "tol": 1e-4, "mu_init": 1e-2},
}


def pose(quat: list[float]) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turned(axis: list[float], angle: ca.SX) -> ca.SX:
    """Rotation about an axis (Rodrigues)."""
    k = ca.skew(ca.DM(axis))
    return ca.SX.eye(3) + ca.sin(angle) * k + (1 - ca.cos(angle)) * ca.mtimes(k, k)


def frames(task: dict, q: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
    """Place and rotation of every body of the chain."""
    out = []
    for body in task["bodies"]:
        at, turn = out[body["parent"]] if body["parent"] >= 0 else (ca.SX.zeros(3), ca.SX.eye(3))
        at, turn = at + ca.mtimes(turn, ca.DM(body["position"])), ca.mtimes(turn, ca.DM(pose(body["quat"])))
        for joint in body["joints"]:
            value, axis = q[joint["q"]], joint["axis"]
            if joint["slides"]:
                at = at + ca.mtimes(turn, ca.DM(axis)) * value
                continue
            anchor, after = ca.DM(joint["anchor"]), ca.mtimes(turn, turned(axis, value))
            at, turn = at + ca.mtimes(turn, anchor) - ca.mtimes(after, anchor), after
        out.append((at, turn))
    return out


class Problem:
    """The problem of a task, solved from the last solution."""

    def __init__(self, task: dict):
        self.n, self.steps, dt = len(task["speed"]), task["steps"], task["dt"]
        q = ca.SX.sym("q", self.n)
        bodies = frames(task, q)
        hand, _ = bodies[task["hand"]]
        places = [
            (bodies[i][0] + ca.mtimes(bodies[i][1], ca.DM(centre)), radius) for i, centre, radius in task["points"]
        ]
        apart = [
            ca.sqrt(ca.sumsqr(p - ca.DM(centre)) + 1e-9) - radius - r - MARGIN
            for p, radius in places
            for centre, r in task["spheres"]
        ]
        used = task["axes"]
        miss = ca.sqrt(ca.sumsqr((hand - ca.DM(task["goal"]))[used]) + 1e-4)
        stage = ca.Function("stage", [q], [miss, ca.vertcat(*apart)])
        self.apart = ca.Function("apart", [q], [ca.vertcat(*apart)])
        start, u = ca.MX.sym("start", self.n), ca.MX.sym("u", self.n, self.steps)
        at, cost, limits = start, 0.0, []
        for k in range(self.steps):
            at = at + dt * u[:, k]
            away, clear = stage(at)
            cost += away + EFFORT * ca.sumsqr(u[:, k])
            limits += [at, clear]
        problem = {"x": ca.vec(u), "p": start, "f": cost, "g": ca.vertcat(*limits)}
        self._solve = ca.nlpsol("plan", "ipopt", problem, OPTIONS)
        self._speed = np.tile(task["speed"], self.steps)
        self._range = np.array(task["ranges"], dtype=float)
        self._last = np.zeros((self.steps, self.n))

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """The first control; where no solution is found, that of the last one once more, then rest."""
        lower, upper = np.minimum(self._range[:, 0], q), np.maximum(self._range[:, 1], q)
        least = np.minimum(0.0, np.array(self.apart(q)).ravel())
        low, high = np.concatenate([lower, least]), np.concatenate([upper, np.full(len(least), np.inf)])
        found = self._solve(
            x0=self._last.ravel(),
            p=q,
            lbx=-self._speed,
            ubx=self._speed,
            lbg=np.tile(low, self.steps),
            ubg=np.tile(high, self.steps),
        )
        plan, broken = np.array(found["x"]).reshape(self.steps, self.n), np.array(found["g"]).ravel()
        if (broken - np.tile(low, self.steps)).min() < -1e-3:
            plan = np.concatenate([self._last[1:], np.zeros((1, self.n))])  # it comes to rest
        self._last = plan
        return plan[0]


def main() -> None:
    """Answer until the input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # libraries chat
    problem = Problem(json.loads(sys.stdin.readline()))
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        state, begin = json.loads(line), time.perf_counter()
        u = problem(np.array(state["q"]))
        print(json.dumps({"u": u.tolist(), "ms": 1e3 * (time.perf_counter() - begin)}), file=answers, flush=True)


if __name__ == "__main__":
    main()
