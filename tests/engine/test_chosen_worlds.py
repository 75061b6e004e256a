# SPDX-License-Identifier: Apache-2.0
"""What an engine tells about chosen worlds: everything that was recorded of them, on the host."""

from dataclasses import fields

import mujoco
import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, make_scene

from warpmpc import Controller, State

WORLDS = [5, 0, 5, 11]


def planned(device: str = "cpu") -> Controller:
    """A controller of two environments that has made a plan; a box touches its robot."""
    scene = make_scene(
        object=[{**BOX, "position": (0.3, 0.0, 0.1)}],
        obstacle=[WALL],
        planner={"samples": 6, "horizon": 4, "noise": {"sigma": (0.8,)}},
        cost=[{"term": "contact_force", "between": ["base", "box"]}, {"term": "distance", "between": ["box", "goal"]}],
    )
    engine = "mujoco" if device == "cpu" else "mujoco_warp"
    controller = Controller(scene, engine=engine, device=device, envs=2, compiled=compiled(scene))
    controller.step(start(controller))
    return controller


def start(controller: Controller, speed: float = 0.5) -> State:
    q, qd = (np.tile(a, (2, 1)) for a in (controller.layout.joint_q, controller.layout.joint_qd))
    qd[:, 0] = speed
    return State(q, qd)


def test_chosen_worlds_are_all_there_is_of_them_in_the_order_asked_for(device):
    controller = planned(device)
    found, whole = controller.engine.record(WORLDS), controller.engine.simulator.trajectory
    for field in fields(found):
        part, everything = getattr(found, field.name), getattr(whole, field.name).numpy()
        axis = 0 if field.name in ("diverged", "overflow") else 1
        assert isinstance(part, np.ndarray)
        np.testing.assert_array_equal(part, everything[(slice(None),) * axis + (WORLDS,)], err_msg=field.name)
    layout = controller.layout
    assert found.body_q.shape == (5, 4, layout.nb, 7)
    assert found.contact_force.shape == (4, 4, 1, 3)
    assert np.abs(found.contact_force).max() > 0.0
    assert controller.engine.record([]).joint_q.shape == (5, 0, layout.nq)


def test_what_was_recorded_stays_when_the_next_plan_is_made():
    controller = planned()
    found = controller.engine.record(WORLDS)
    before = {field.name: getattr(found, field.name).copy() for field in fields(found)}
    controller.step(start(controller, speed=-0.5))
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
    assert not np.array_equal(controller.engine.record(WORLDS).joint_q, found.joint_q)


def test_the_controls_of_a_world_lead_from_its_first_state_to_its_others():
    controller = planned()
    world = 3
    found, simulator = controller.engine.record([world]), controller.engine.simulator
    model = simulator.models[world]
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, simulator.initial[world], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    for t, substeps in enumerate(simulator.substeps):
        data.ctrl[:] = found.control[t, 0]
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(found.joint_q[t + 1, 0, :6], data.qpos[:6], atol=1e-6)
    assert found.control.any()
    assert found.joint_q[0, 0] == pytest.approx(controller.layout.joint_q)
