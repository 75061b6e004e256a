# SPDX-License-Identifier: Apache-2.0
"""What a warp of a GPU does, lane by lane on the CPU: the same as registers do, whichever lane comes first.

Slow ones by hand: pytest -m slow tests/physics/test_warp_lanes.py
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import warp as wp
from bricks import STACK
from cones import ELLIPSE, PYRAMID, rubbing
from fused_models import CONTACTS, DYNAMICS, compile_model, controls, starts
from needs import needs
from sensed_models import BUSY, drawn
from shared.plain_rollout import PlainRollout
from small_scenes import BOX, WALL, compiled, layout_of, make_scene, observed
from warp_lanes import LaneRollout, Lanes

from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.physics.sensing import within_step
from warpmpc.physics.source import RolloutSource
from warpmpc.physics.source_parts import AddedCode
from warpmpc.physics.state_map import StateMap
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize

pytestmark = needs("g++")
WORLDS, STEPS = 4, 12


@pytest.mark.parametrize(
    ("text", "integrator"),
    [(DYNAMICS, "implicitfast"), (DYNAMICS, "RK4"), (CONTACTS, "Euler")],
)
def test_lanes_agree_with_registers(text, integrator, tmp_path_factory):
    check(compile_model(text, integrator), tmp_path_factory)


def test_lanes_agree_with_registers_on_few_iterations(tmp_path_factory):
    model = compile_model(CONTACTS, "Euler")
    model.opt.iterations, model.opt.ls_iterations = 2, 4
    check(model, tmp_path_factory)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [rubbing(PYRAMID, 1.0, (4, 6, 3)), rubbing(ELLIPSE, 10.0, (3, 4, 6)), mujoco.MjModel.from_xml_string(STACK)],
    ids=["all kinds of friction", "elliptic cones", "several contacts of flat shapes"],
)
def test_lanes_agree_with_registers_on_contacts_of_all_kinds(model, tmp_path_factory):
    check(model, tmp_path_factory)


def check(model, tmp_path_factory) -> None:
    """Lanes give what registers give, and the same bits in each order."""
    q, v = starts(model, WORLDS, seed=3)
    control = controls(model, STEPS, WORLDS, seed=3)
    expected = [x.copy() for x in PlainRollout(model, WORLDS, STEPS, lanes=4)(q, v, control)]
    lanes = LaneRollout(model, WORLDS, STEPS, folder=tmp_path_factory.getbasetemp())
    found = []
    for order in (0, 2, 4 * 5 + 1):  # a missing synchronization shows as a result that depends on who comes first
        lanes.order = order
        found.append([x.copy() for x in lanes(q, v, control)])
    for other in found[1:]:
        for x, y in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(x, y)
    for x, y in zip(found[0], expected, strict=True):
        np.testing.assert_allclose(x, y, atol=2e-3)


class SensingRollout(LaneRollout):
    """Rollouts that read sensors within their steps, into the record of forces."""

    def _parts(self, lanes, *, shared):
        plain = StateMap(plain=True, matrix=np.eye(self.mj.nu), offset=np.zeros(self.mj.nu), sensors=self.mj.nsensor)
        to = "float* const to = (float*)k.force.data + (size_t)(at * k.force.shape[1] + row) * SENSED;"
        step = f"{{ {to} for (int n = 0; n < SENSED; ++n) PUT(to, SENSED, n, w.sensed[n]) }}"
        code = AddedCode(start="", before="", step=step, end="", first=0)
        return RolloutSource(self.physics, plain, lanes, shared, code).parts()


def test_lanes_sense_what_registers_sense(tmp_path_factory):
    model = mujoco.MjModel.from_xml_string(BUSY.replace("INTEGRATOR", "Euler"))
    start, control = drawn(model, 0, WORLDS, 2)
    width = sum(int(model.sensor_dim[n]) for n in within_step(model))
    lanes = SensingRollout(model, WORLDS, 2, folder=tmp_path_factory.getbasetemp())
    lanes.work.force = wp.zeros((2, WORLDS, -(-width // 3)), dtype=wp.vec3)
    q, v = start[:, 1 : 1 + model.nq], start[:, 1 + model.nq :]
    found, launch = [], lanes.launch
    for order in (None, 0, 2):
        lanes.order = order or 0
        lanes.launch = (lambda: PlainRollout.launch(lanes)) if order is None else launch
        lanes(q, v, control.swapaxes(0, 1))
        found.append(lanes.work.force.numpy().ravel()[: 2 * WORLDS * width].reshape(-1, width).copy())
    np.testing.assert_array_equal(found[1], found[2])
    scale = np.maximum(1.0, abs(found[0]).max(axis=0))
    assert np.count_nonzero(found[0]) > 0.4 * found[0].size
    np.testing.assert_allclose(found[1] / scale, found[0] / scale, atol=1e-3)


RECORD = ("joint_q", "joint_qd", "body_q", "body_qd", "contact_force", "control", "diverged", "overflow")


def test_lanes_read_and_record_a_scene_as_registers_do(tmp_path_factory):
    """The start from what was observed, parameters of worlds, watched forces, the record."""
    moved = {"name": "post", "shape": "box", "size": (0.1, 0.1, 0.4), "position": (1.2, 0.8, 0.2), "movable": True}
    scene = make_scene(
        object=[{**BOX, "position": (0.36, 0.0, 0.1)}],
        obstacle=[WALL, moved],
        randomize={"box": {"mass": {"uniform": 0.3}, "size": {"normal": 0.01}}},
    )
    layout, steps = layout_of(scene), 5
    simulator = FusedPhysics(
        scene,
        compiled(scene),
        BatchSize(2, 3, 1, steps),
        substeps=[3] * steps,
        timestep=scene.timing.control_dt / 3,
        pairs=(Pair("base", "wall"), Pair("base", "box"), Pair("box", "post")),
        properties=draw_properties(scene, layout, 3, seed=3),
    )
    q, qd = (np.tile(a, (2, 1)).astype(float) for a in (layout.joint_q, layout.joint_qd))
    q[1, :2] += 0.01
    qd[:, 3:] = np.random.default_rng(0).normal(0.0, 0.3, qd[:, 3:].shape)
    control = np.random.default_rng(1).uniform([0.2, -0.5, -1.0], [1.0, 0.5, 1.0], (steps, 6, 3)).astype(np.float32)
    poses = np.zeros((2, 2, 7), dtype=np.float32)  # the goal, and the post, which the box touches in the first
    poses[:, :, 6], poses[:, 1, :3] = 1.0, [[0.45, 0.28, 0.2], [1.2, 0.8, 0.2]]
    simulator.clone(replace(observed(q, qd), pose=wp.array(poses, dtype=wp.transform, device="cpu")))
    simulator.rollout(wp.array(control, dtype=float, device="cpu"))
    out = simulator.trajectory

    def taken() -> dict[str, np.ndarray]:
        return {name: getattr(out, name).numpy().copy() for name in RECORD}

    expected = taken()
    force = np.abs(expected["contact_force"]).max(axis=(0, 3))
    assert force[:, 1].min() > 0.1
    assert force[:3, 2].min() > 0.1
    assert not force[3:, 2].any()
    np.testing.assert_array_equal(expected["control"], control)
    np.testing.assert_allclose(expected["joint_q"][0, ::3], q, atol=1e-7)
    simulator.sharing = 32
    lanes, found = Lanes(simulator.source(), tmp_path_factory.getbasetemp()), []
    for order in (0, 2, 4 * 5 + 1):
        for name in RECORD:
            getattr(out, name).zero_()
        lanes(simulator.work, 6, order)
        found.append(taken())
    for name in RECORD:
        for other in found[1:]:
            np.testing.assert_array_equal(other[name], found[0][name], err_msg=name)
        off = np.abs(found[0][name] - expected[name]) / (1.0 + np.abs(expected[name]).max())
        most = off if off.ndim == 1 else off.reshape(len(off), 6, -1).max(axis=(0, 2))
        # a contact that is just made may part some of the worlds from their likes
        assert np.median(most) < 1e-3, (name, most)
        assert (most < 2e-3).sum() >= 4, (name, most)
        assert off[0].max() < 1e-6 or name not in RECORD[:4]  # what was observed
