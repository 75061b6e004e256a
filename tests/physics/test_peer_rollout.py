# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's own tests of rollouts, from the wheel: with ``rollout`` of ``warpmpc.physics``, and equality to 1e-3."""

import importlib.util
import logging
import unittest
from pathlib import Path

import mujoco
import numpy as np
import pytest

from warpmpc.physics import rollout

FILE = Path(mujoco.__file__).with_name("rollout_test.py")
FALLS_BACK = {
    "test_multi_model0": "worlds that differ in body_pos",
    "test_multi_model1": "worlds that differ in body_pos",
    "test_multi_model2": "worlds that differ in body_pos",
    "test_py_rollout_generalized_control": "controls other than ctrl",
    "test_intercept_mj_errors": "solvers that MuJoCo does not have",
}
"""Tests that ask for more than this physics has, and the line that says so; no test fails."""
if not FILE.exists():
    pytest.skip(f"there is no {FILE.name} in this wheel", allow_module_level=True)
pytest.importorskip("absl.testing")


def load(*, own):
    """The module; where nothing is to fall back, its accelerometers are velocimeters."""
    spec = importlib.util.spec_from_file_location(f"peer_rollout_{own}", FILE)
    module = importlib.util.module_from_spec(spec)
    text = FILE.read_text()
    exec(compile(text.replace("<accelerometer", "<velocimeter") if own else text, str(FILE), "exec"), module.__dict__)
    module.rollout = rollout
    return module


MODULES = {"own": load(own=True), "as it is": load(own=False)}
NAMES = sorted(unittest.TestLoader().getTestCaseNames(MODULES["own"].MuJoCoRolloutTest))


def close(actual, desired):
    """Equality to 1e-3, of arrays that MuJoCo's tests ask equal bits of."""
    np.testing.assert_allclose(actual, desired, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("form", MODULES)
def test_tests_of_mujoco(form, name, monkeypatch, caplog):
    monkeypatch.setattr(np.testing, "assert_array_equal", close)
    result = unittest.TestResult()
    with caplog.at_level(logging.INFO, "warpmpc"):
        MODULES[form].MuJoCoRolloutTest(name).run(result)
    assert not (found := [text for _, text in (*result.errors, *result.failures)]), found[0]
    if form == "own":
        lines = [r.getMessage() for r in caplog.records if "MuJoCo's own" in r.getMessage()]
        known = next((line for test, line in FALLS_BACK.items() if name.startswith(test)), None)
        assert all(known and known in line for line in lines), lines
