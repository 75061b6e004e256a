# SPDX-License-Identifier: Apache-2.0
"""Run logs that are changed, and written as they were before."""

import json

import numpy as np


def changed(rows: np.recarray, **columns: np.ndarray) -> np.recarray:
    """A copy of a table of a run log with other columns, which may have other shapes."""
    arrays = {name: rows[name] for name in rows.dtype.names} | columns
    made = np.zeros(len(rows), [(name, array.dtype, array.shape[1:]) for name, array in arrays.items()])
    for name, array in arrays.items():
        made[name] = array
    return made.view(np.recarray)


def older(log) -> dict[str, np.ndarray]:
    """The arrays of a log of warpmpc before the run log."""
    states, names = log.states, log.names
    arrays = {name: states[name] for name in ("time", "joint_q", "joint_qd", "body_q", "contact_force", "goal_error")}
    arrays |= {"control": log.controls.control, "plan_ms": log.controls.plan_ms, "cost": log.plans.cost}
    arrays |= {"cost_terms": log.plans.terms, "beta": log.plans.beta, "eta": log.plans.eta}
    told = {"joint_q": "joint_q", "joint_qd": "joint_qd", "body": "bodies", "control": "controls", "term": "terms"}
    told |= {"pair": "pairs", "error": "errors"}
    arrays |= {f"{old}_names": np.array(names[new], dtype=str) for old, new in told.items()}
    return arrays | {"log_origin": np.array(json.dumps(log.origin)), "log_joint_q": log.plans.joint_q}
