# SPDX-License-Identifier: Apache-2.0
"""Tests that MuJoCo ships for ``mujoco.batch``, with our ``Batch`` in place of its class and equality to 1e-3."""

import logging
import types
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import pytest

from warpmpc.physics import Batch

EXCEPTIONS: dict[str, str] = {}
"""Tests that do not pass, at most five, each with its reason."""
FALLS_BACK = {
    "test_caller_models": {"models of the caller (set_models)"},
    "test_count_outputs": {"output ncon"},
    "test_errors_name_every_simulation": {"worlds that differ in eq_type"},
    "test_lockstep": {"data that persist between calls"},
    "test_named": {"output actuator_force"},
    "test_python_callbacks_rejected": {"callbacks (mjcb_control)"},
    "test_rollout_checks_buffers": {"output solver_niter"},
    "test_rollout_records_fixed_size_fields": {"output energy"},
    "test_sleep_needs_persistent": {"data that persist between calls"},
    "test_step_stage": {"stages after a step", "data that persist between calls"},
}
"""Tests that ask for what MuJoCo's own steps are needed for, and what those are."""


def near(actual, desired, *args, **kwargs):
    """Equality up to single precision over a few steps."""
    np.testing.assert_allclose(actual, desired, rtol=1e-3, atol=1e-3)


def peer_tests(sensor: str) -> type:
    """The class of tests in the installed wheel.

    Args:
        sensor: Replaces the accelerometer of its model.
    """
    path = Path(mujoco.__file__).parent / "batch_test.py"
    module = types.ModuleType("batch_test")
    exec(compile(path.read_text(encoding="utf-8"), path, "exec"), module.__dict__)
    module.XML = module.XML.replace("accelerometer", sensor)
    module.batch = types.SimpleNamespace(**{**vars(mujoco.batch), "Batch": Batch})
    numpy = {name: getattr(np, name) for name in dir(np)}
    module.np = types.SimpleNamespace(**numpy | {"testing": types.SimpleNamespace(assert_array_equal=near)})
    for name, reason in EXCEPTIONS.items():
        setattr(module.BatchTest, name, pytest.mark.skip(reason)(getattr(module.BatchTest, name)))
    return module.BatchTest


class TestAccelerometer(peer_tests("accelerometer")):
    """The tests as they are."""


class TestVelocimeter(peer_tests("velocimeter")):
    """The tests in a form where nothing falls back but what must."""

    @pytest.fixture(autouse=True)
    def _causes(self, request, caplog):
        with caplog.at_level(logging.WARNING, "warpmpc"):
            yield
        causes = {line.args[-1] for line in caplog.get_records("call") if "MuJoCo's own" in line.msg}
        assert causes <= FALLS_BACK.get(request.node.name.rstrip("0123456789"), set())
