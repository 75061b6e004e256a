# SPDX-License-Identifier: Apache-2.0
"""Objects whose velocities decay by themselves: in the plant, on every engine, with drawn masses and sizes."""

import numpy as np
import pytest
from needs import CUDA, needs
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, SceneError, State

LINEAR, ANGULAR, SECONDS = 3.0, 5.0, 0.32
SHAPES = {"box": (0.3, 0.5, 0.2), "sphere": (0.15,), "cylinder": (0.2, 0.3), "capsule": (0.12, 0.4)}
RANDOM = {"thing": {"mass": {"uniform": 0.5}, "size": {"normal": 0.02}, "redraw": True}}
GPU = (pytest.mark.gpu, needs(CUDA))
ENGINES = [
    ("fused", "cpu"),
    ("mujoco", "cpu"),
    pytest.param("fused", "cuda:0", marks=GPU),
    pytest.param("mujoco_warp", "cuda:0", marks=GPU),
]


def falling(shape="box", **sections):
    """A thing in free fall, far from the base."""
    thing = {"name": "thing", "shape": shape, "size": SHAPES[shape], "mass": 2.0, "position": (5.0, 0.0, 50.0)}
    damping = {"linear_damping": LINEAR, "angular_damping": ANGULAR}
    planner = {"samples": 6, "horizon": round(SECONDS / 0.04)}
    return make_scene(object=[thing | damping], engine={"substeps": 20}, planner=planner, **sections)


def left(joint_qd, layout, spin: int) -> np.ndarray:
    """What is left of the velocity along x and of the angular velocity about an axis, both 1 at the start."""
    first = layout.joint_qd_start[layout.entity("thing").joints[0]]
    return np.stack([joint_qd[..., first], joint_qd[..., first + 3 + spin]], axis=-1)


def start(layout, spin: int) -> State:
    qd = layout.joint_qd.copy()
    first = layout.joint_qd_start[layout.entity("thing").joints[0]]
    qd[[first, first + 3 + spin]] = 1.0
    return State(layout.joint_q, qd)


EXPECTED = np.exp(-SECONDS * np.array([LINEAR, ANGULAR]))


@pytest.mark.parametrize(("engine", "device"), ENGINES)
@pytest.mark.parametrize("rules", [{}, RANDOM], ids=["nominal", "redrawn"])
def test_velocities_decay_at_their_rates_in_every_world(rules, engine, device):
    scene = falling(randomize=rules)
    controller = Controller(scene, engine=engine, device=device, compiled=compiled(scene))
    for spin in range(3):
        controller.plan(start(controller.layout, spin))
        ends = controller.engine.record(range(6)).joint_qd[-1]
        np.testing.assert_allclose(left(ends, controller.layout, spin), np.tile(EXPECTED, (6, 1)), rtol=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_plants_object_decays_at_the_same_rates_for_every_draw(shape):
    kick = {"time": 0.0, "target": "thing", "velocity": (1.0, 0.0, 0.0)}
    scene = falling(shape, randomize=RANDOM, plant={"substeps": 20, "kicks": [kick]})
    plant = Plant(scene, seed=3, compiled=compiled(scene))
    assert abs(plant.model.body("thing").mass[0] - 2.0) > 0.01
    for _ in range(round(SECONDS / 0.04)):
        plant.apply(np.zeros(plant.compiled.layout.nu))
    found = left(plant.observe().joint_qd, plant.compiled.layout, 2)[0]
    assert found == pytest.approx(EXPECTED[0], rel=0.01)
    turning = plant.model.body("thing").dofadr[0] + 3 + np.arange(3)
    np.testing.assert_allclose(plant.model.dof_damping[turning], ANGULAR * plant.model.dof_M0[turning], rtol=1e-6)


def test_an_object_without_damping_keeps_its_velocity():
    scene = falling()
    free = scene.object[0].model_copy(update={"linear_damping": 0.0, "angular_damping": 0.0})
    scene = scene.model_copy(update={"object": (free,)})
    controller = Controller(scene, engine="fused", device="cpu", compiled=compiled(scene))
    controller.plan(start(controller.layout, 2))
    np.testing.assert_allclose(left(controller.engine.record([0]).joint_qd[-1], controller.layout, 2), 1.0, rtol=1e-5)


def test_where_it_cannot_be_had_the_key_is_named():
    scene = falling()
    with pytest.raises(SceneError, match=r"object\.thing: the engine newton does not damp objects.*take mujoco_warp"):
        Controller(scene, engine="newton", device="cpu", compiled=compiled(scene))
    rock = {"name": "rock", "shape": "mesh", "mesh": "rock.stl", "mass": 1.0, "angular_damping": 0.5}
    with pytest.raises(ValueError, match=r"a mesh has no damping.*take another shape"):
        make_scene(object=[rock])
