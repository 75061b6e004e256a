# SPDX-License-Identifier: Apache-2.0
"""A cloned policy: the example learns it from a data set, the planner tries what it proposes, the table is counted."""

import runpy
import sys

import numpy as np
import pytest
from needs import need
from studies import imitation
from studies.imitation import Flight, rows

import warpmpc
from warpmpc.export.data_sets import Hdf5DataSet
from warpmpc.export.demonstration import Demonstration
from warpmpc.run.records import Records

LAW = np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.2], [0.0, -0.1, 0.2], [0.1, 0.1, 0.2]])
"""Thrusts of a linear law of the way to the goal."""


SIZES = {"joint_q": 7, "joint_qd": 6, "goal": 7}


def law(observed):
    return 1.5 + (observed["goal"][:, :3] - observed["joint_q"][:, :3]) @ LAW.T


@pytest.fixture
def policy(tmp_path, monkeypatch):
    """Policy of a data set of the law, by the example with a tenth of its steps."""
    for package in ("h5py", "onnx", "onnxruntime"):
        need(package)
    rng, data = np.random.default_rng(0), Hdf5DataSet(tmp_path / "demos.hdf5")
    for seed in range(200):
        observed = {name: np.tile(rng.normal(size=n), (5, 1)) for name, n in SIZES.items()}
        data.add(
            Demonstration(
                observations=observed,
                actions=law(observed)[:-1],
                time=0.02 * np.arange(5),
                limits=np.zeros((2, 4)),
                names={},
                origin={"scene": "quadrotor", "seed": seed},
            )
        )
    data.close()
    program = tmp_path / "imitate.py"
    text = imitation.PROGRAM.read_text(encoding="utf-8")
    assert " 4000\n" in text
    program.write_text(text.replace(" 4000\n", " 400\n"), encoding="utf-8")
    out = tmp_path / "policy.onnx"
    monkeypatch.setattr(sys, "argv", ["imitate.py", "quadrotor", str(tmp_path / "demos.hdf5"), str(out)])
    runpy.run_path(str(program))
    return out


def test_the_example_learns_a_law_from_a_data_set_and_the_planner_tries_it(policy, capsys):
    import onnxruntime

    found = onnxruntime.InferenceSession(str(policy))
    rng, errors, spread = np.random.default_rng(1), [], []
    for _ in range(100):
        observed = {name: rng.normal(size=(1, n)) for name, n in SIZES.items()}
        (controls,) = found.run(None, {"x": np.hstack(list(observed.values())).astype(np.float32)})
        assert controls.shape == (1, warpmpc.load_scene("quadrotor").planner.horizon, 4)
        errors.append(controls[0] - law(observed))
        spread.append(law(observed) - 1.5)
    assert np.mean(np.square(errors)) < 0.2 * np.mean(np.square(spread))

    scene = Flight(samples=8, seed=0, policy=str(policy)).scene
    mpc = warpmpc.Controller(scene, device="cpu")
    state = warpmpc.State.start(mpc.layout)
    mpc.step(state)
    proposed = found.run(None, {"x": np.hstack([state.joint_q, state.joint_qd, mpc.task["goal"]])[None]})[0][0]
    limited = np.clip(proposed, *mpc.limits)
    assert min(np.abs(mpc.rollout(i).control - limited).max() for i in range(8)) < 0.1  # by a spline of ten knots


def test_a_row_counts_what_is_done(tmp_path):
    records, policy = Records(tmp_path / "imitation.jsonl"), tmp_path / "policy.onnx"
    policy.write_bytes(b"")
    flights = [Flight(samples=n, seed=seed, policy=p) for n in (8, 0) for seed in range(3) for p in (None, str(policy))]
    flights = [flight for flight in flights if flight.samples or flight.policy]
    for flight in flights[:4]:
        proposed = flight.policy is not None
        reached = 2.0 + flight.seed if proposed else None
        record = {"cost": 1.0 + flight.seed if proposed else None, "reached": reached, "plan_ms": 0.5}
        records.add(flight.key("fly"), record)
    assert rows(flights, records) == [
        ["8", "0 of 2", "-", "-", "2 of 2", "2.50", "1.50 ± 6.35", "0.5"],
        ["the policy alone", "-", "-", "-", "-", "-", "-", "-"],
    ]
