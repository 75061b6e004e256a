# SPDX-License-Identifier: Apache-2.0
"""An arm's cost terms in float64."""

import numpy as np
from arm_rollouts import ARM, DT, ArmRollouts

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
SPEED = np.array([2.175] * 4 + [2.61] * 3)
"""Velocity limits of the arm's URDF [rad/s]."""


def chain_dofs(r: ArmRollouts) -> list[int]:
    """Degrees of freedom that move the tip: all but the fingers'."""
    return [i for i, name in enumerate(r.layout.dof_name) if "finger" not in name]


def pose(r: ArmRollouts, position=(1.0, 1.0, 1.0), rotation=(1.0, 1.0, 1.0)) -> np.ndarray:
    (p, turn), (goal, goal_turn) = r.pose("arm/tip"), r.pose("goal")
    local = np.einsum("twji,twj->twi", goal_turn, p - goal)
    rows = np.eye(3) - np.einsum("twji,twjk->twik", goal_turn, turn)
    return np.linalg.norm(position * local, axis=-1) + (rotation * np.linalg.norm(rows, axis=-1)).sum(-1)


def stop(r: ArmRollouts, limit) -> np.ndarray:
    left = np.triu(np.ones((r.t, r.t))) @ DT
    beyond = np.abs(r.qd[1:].astype(np.float64)) - left[:, None, None] * np.array(limit)
    return (np.maximum(beyond, 0.0) ** 2).sum(-1)


def measure(r: ArmRollouts, columns: list[int] | None = None) -> np.ndarray:
    """√det(J Jᵀ), or √det(Jᵀ J) where there are fewer than six columns."""
    columns = chain_dofs(r) if columns is None else columns
    return np.prod(np.linalg.svd(r.jacobian()[..., columns], compute_uv=False), axis=-1)


def derivatives(r: ArmRollouts, *, driven: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations and jerks [T, W, nv] of the joints."""
    step = DT[:, None, None]
    if driven:
        a = r.control.numpy().astype(np.float64)
        before = np.repeat(r.state.last_control.numpy(), r.shape.rollouts, axis=0)[None]
        first = (a[:1] - before) / DT[0]
    else:
        a = np.diff(r.qd.astype(np.float64), axis=0) / step
        first = np.zeros_like(a[:1])
    return a, np.concatenate([first, np.diff(a, axis=0) / (0.5 * (step[1:] + step[:-1]))])


def outside(value: np.ndarray, bound) -> np.ndarray:
    return (np.maximum(np.abs(value) - bound, 0.0) ** 2).sum(-1)


def bounds(r: ArmRollouts, velocity, acceleration=np.inf, jerk=np.inf, margin=0.05, driven=False) -> np.ndarray:
    lower, upper = r.layout.dof_lower.astype(np.float64), r.layout.dof_upper.astype(np.float64)
    reach = np.where(upper - lower < 1e6, 0.5 * (upper - lower), np.inf)
    middle = np.where(np.isfinite(reach), 0.5 * (lower + upper), 0.0)
    a, j = derivatives(r, driven=driven)
    left = 1.0 - margin
    total = outside(r.q[1:] - middle, left * reach) + outside(r.qd[1:].astype(np.float64), left * np.array(velocity))
    return total + outside(a, left * np.array(acceleration)) + outside(j, left * np.array(jerk))


def null_posture(r: ArmRollouts, columns: list[int], target: np.ndarray, damping: float = 0.01) -> np.ndarray:
    j = r.jacobian()[..., columns]
    d = r.q[1:][..., r.layout.dof_coord[columns]] - target.astype(np.float64)
    turned = j.swapaxes(-1, -2)
    back = turned @ np.linalg.inv(j @ turned + damping**2 * np.eye(6))
    return (((np.eye(len(columns)) - back @ j) @ d[..., None])[..., 0] ** 2).sum(-1)


def path_deviation(r: ArmRollouts, start: str | None = None) -> np.ndarray:
    at, to = r.pose("arm/tip")[0], r.pose("goal")[0]
    a = r.pose("arm/tip", first=True)[0] if start is None else r.pose(start)[0]
    share = np.clip(((at - a) * (to - a)).sum(-1) / ((to - a) ** 2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(at - a - share[..., None] * (to - a), axis=-1)


def speed(r: ArmRollouts, linear: float, angular: float) -> np.ndarray:
    twist = np.einsum("twij,twj->twi", r.jacobian(), r.qd[1:].astype(np.float64))
    return outside(np.linalg.norm(twist[..., :3], axis=-1)[..., None], linear) + outside(
        np.linalg.norm(twist[..., 3:], axis=-1)[..., None], angular
    )


def smoothness(r: ArmRollouts, acceleration: float, jerk: float, driven: bool = False) -> np.ndarray:
    a, j = derivatives(r, driven=driven)
    return acceleration * (a**2).sum(-1) + jerk * (j**2).sum(-1)


CASES = {
    "pose": ("arm", {"of": "arm/tip"}, pose),
    "weighted pose": (
        "mobile",
        {"term": "pose", "of": "arm/tip", "position": [100.0, 10.0, 0.0], "rotation": [15.0, 0.0, 3.0]},
        lambda r: pose(r, (100.0, 10.0, 0.0), (15.0, 0.0, 3.0)),
    ),
    "orientation alone": (
        "arm",
        {"term": "pose", "of": "arm/tip", "position": 0.0, "rotation": 2.0},
        lambda r: pose(r, (0.0, 0.0, 0.0), (2.0, 2.0, 2.0)),
    ),
    "stop": ("arm", {"acceleration": 5.0}, lambda r: stop(r, 5.0)),
    "stop of some": (
        "mobile",
        {"term": "stop", "joints": ["x", "yaw"], "acceleration": [1.0, 2.0]},
        lambda r: stop(r, np.array([1.0, np.inf, 2.0] + 9 * [np.inf])),
    ),
    "manipulability": ("arm", {"of": "arm/tip", "least": 0.1}, lambda r: np.maximum((0.1 - measure(r)) / 0.1, 0.0)),
    "manipulability of an arm on a base": (
        "mobile",
        {"term": "manipulability", "of": "arm/tip", "least": 2.0},
        lambda r: np.maximum((2.0 - measure(r)) / 2.0, 0.0),
    ),
    "manipulability of the arm alone": (
        "mobile",
        {"term": "manipulability", "of": "arm/tip", "joints": ARM_JOINTS, "least": 0.1, "form": "step"},
        lambda r: np.where(measure(r, list(range(3, 10))) < 0.1, 1.0 - measure(r, list(range(3, 10))), 0.0),
    ),
    "manipulability of three joints": (
        "arm",
        {"term": "manipulability", "of": "arm/tip", "joints": ["arm/panda_joint1", *ARM_JOINTS[1:3]], "least": 1.5},
        lambda r: np.maximum((1.5 - measure(r, [0, 1, 2])) / 1.5, 0.0),
    ),
    "joint_bounds": ("arm", {}, lambda r: bounds(r, SPEED)),
    "joint_bounds of all kinds": (
        "mobile",
        {"term": "joint_bounds", "margin": 0.1, "velocity": 1.0, "acceleration": 10.0, "jerk": 300.0},
        lambda r: bounds(r, 1.0, 10.0, 300.0, 0.1),
    ),
    "null_posture": ("arm", {"of": "arm/tip"}, lambda r: null_posture(r, list(range(7)), np.array(ARM["joint_q"]))),
    "null_posture on a base": (
        "mobile",
        {"term": "null_posture", "of": "arm/tip", "joints": [*ARM_JOINTS, "x"], "target": [0.1] * 8, "damping": 0.1},
        lambda r: null_posture(r, [*range(3, 10), 0], np.full(8, 0.1), 0.1),
    ),
    "path_deviation": ("arm", {"of": "arm/tip"}, path_deviation),
    "path_deviation between poses": (
        "mobile",
        {"term": "path_deviation", "of": "arm/tip", "start": "gate"},
        lambda r: path_deviation(r, "gate"),
    ),
    "speed": ("arm", {"of": "arm/tip", "linear": 0.3, "angular": 1.0}, lambda r: speed(r, 0.3, 1.0)),
    "speed of turning": ("mobile", {"term": "speed", "of": "arm/tip", "angular": 0.5}, lambda r: speed(r, np.inf, 0.5)),
    "smoothness": ("arm", {}, lambda r: smoothness(r, 1.0, 0.0)),
    "smoothness of jerks": (
        "mobile",
        {"term": "smoothness", "acceleration": 0.5, "jerk": 0.01},
        lambda r: smoothness(r, 0.5, 0.01),
    ),
}
