# SPDX-License-Identifier: Apache-2.0
"""Sensors in cost terms of `fused`: they show what the engine `mujoco` shows, and its sums are those of its terms.

Slow ones by hand: pytest -m slow tests/engine/test_fused_sensors.py
"""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from fused_costs import assert_costs, expected_totals, planned
from native_robots import native_scene
from needs import needs
from sensed_models import BUSY
from warp_lanes import Lanes

import warpmpc
from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.mujoco_model import Options
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(2, 8, 1, 4)
LIMITED = ("motor", "position")
MORE = """<sensor>
  <framepos name="seen" objtype="site" objname="imu" reftype="body" refname="cart"/><gyro name="gyro" site="imu"/>
  <framequat name="turned" objtype="body" objname="hand"/><subtreecom name="whole" body="cart"/>
  <clock name="clock"/><user name="own" dim="2"/>
"""


@pytest.fixture
def busy(tmp_path):
    """A scene of a file with sensors of every kind; all of them have names."""
    text = BUSY.replace("INTEGRATOR", "implicitfast").replace("<sensor>", MORE)
    for kind in LIMITED:
        text = text.replace(f"<{kind} ", f'<{kind} ctrlrange="-1 1" ')
    (tmp_path / "busy.xml").write_text(text)
    return native_scene(tmp_path / "busy.xml")


def read_by(layout) -> tuple[str, ...]:
    """Sensors that `fused` reads."""
    return tuple(name for name in layout.sensor_name if name not in ("r/clock", "r/own"))


def start_of(layout, rng, device: str = "cpu") -> SimpleNamespace:
    def rows(values, dtype=float) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=dtype, device=device)

    return SimpleNamespace(
        joint_q=rows(np.tile(layout.joint_q, (2, 1))),
        joint_qd=rows(0.3 * rng.normal(size=(2, layout.nv))),
        act=rows(np.zeros((2, layout.na))),
        mocap=rows(np.zeros((2, 0, 7)), wp.transform),
        pose=rows(np.zeros((2, 0, 7)), wp.transform),
    )


def test_both_engines_show_the_same(busy, device):
    compiled = compile_scene(busy)
    layout, rng = compiled.layout, np.random.default_rng(0)
    common = {"substeps": [3] * SHAPE.horizon, "timestep": 0.002, "sensors": read_by(layout)}
    fused = FusedPhysics(busy, compiled, SHAPE, device=device, **common)
    reference = MujocoSimulator(compiled, SHAPE, threads=1, options=Options.of(busy.engine), **common)
    control = rng.uniform(-1.0, 1.0, size=(SHAPE.horizon, SHAPE.worlds, layout.nu)).astype(np.float32)
    for engine, where in ((fused, device), (reference, "cpu")):
        engine.clone(start_of(layout, np.random.default_rng(1), where))
        engine.rollout(wp.array(control, dtype=float, device=where))
    ours, theirs = (out.sensor.numpy().astype(float) for out in (fused.trajectory, reference.trajectory))
    for name, first, size in zip(layout.sensor_name, layout.sensor_start, layout.sensor_dim, strict=True):
        a, b = (x[..., first : first + size] for x in (ours, theirs))
        if name in common["sensors"]:
            np.testing.assert_allclose(a, b, atol=1e-3 * max(1.0, np.abs(b).max()), err_msg=name)
        else:
            assert not a.any(), name
    assert (np.ptp(theirs.reshape(-1, layout.ns), axis=0) > 0.0).sum() > 0.6 * layout.ns


def test_fused_sums_what_the_warp_functions_say_of_sensors(busy, caplog):
    layout = compile_scene(busy).layout
    some = ["r/gyro", "r/seen", "r/accelerometer_imu", "r/net"]
    cost = [{"term": "sensor_residual", "name": f"s{i}", "sensors": [name]} for i, name in enumerate(some)]
    cost += [{"term": "contact_force", "between": ["r", "ground"]}]
    assert {*some} <= {*layout.sensor_name}
    keys = busy.model_dump(exclude={"path", "variant"}) | {"cost": cost, "engine": {"threads": 1}, "ground": {}}
    keys["planner"] = {"samples": 21, "horizon": 4, "discount": 0.9}
    scene = warpmpc.Scene.model_validate(keys)
    with caplog.at_level(logging.INFO, logger="warpmpc"):
        mpc = planned(scene, envs=2)
    assert not mpc.engine.records
    assert "on the record" not in caplog.text
    expected = expected_totals(mpc)
    assert (np.ptp(expected[:4], axis=1) > 1e-3).all()
    assert_costs(mpc, expected, rtol=1e-4)


@pytest.mark.parametrize(("sensor", "kind"), [("own", "user"), ("clock", "clock")])
def test_a_sensor_that_fused_cannot_read_is_named(busy, sensor, kind):
    keys = busy.model_dump(exclude={"path", "variant"})
    scene = warpmpc.Scene.model_validate(keys | {"cost": [{"term": "sensor_residual", "sensors": [sensor]}]})
    with pytest.raises(warpmpc.SceneError, match=rf"engine\.name: the engine fused has no sensors .*{kind}.*mujoco"):
        warpmpc.Controller(scene, engine="fused")


@pytest.mark.slow
@needs("g++")
def test_lanes_of_a_warp_show_what_registers_do(busy, tmp_path_factory):
    compiled = compile_scene(busy)
    layout = compiled.layout
    common = {"substeps": [3] * SHAPE.horizon, "timestep": 0.002, "sensors": read_by(layout)}
    fused = FusedPhysics(busy, compiled, SHAPE, **common)
    fused.clone(start_of(layout, np.random.default_rng(1)))
    control = np.random.default_rng(0).uniform(-1.0, 1.0, size=(SHAPE.horizon, SHAPE.worlds, layout.nu))
    fused.rollout(wp.array(control, dtype=float, device="cpu"))
    shown = fused.trajectory.sensor
    expected = shown.numpy().copy()
    shown.zero_()
    fused.sharing = 32
    Lanes(fused.source(), tmp_path_factory.getbasetemp())(fused.work, SHAPE.worlds, 4 * 5 + 1)
    scale = np.maximum(1.0, np.abs(expected).max(axis=(0, 1)))
    np.testing.assert_allclose(shown.numpy() / scale, expected / scale, atol=1e-3)
