# SPDX-License-Identifier: Apache-2.0
"""What the planner has wrong: factors on the properties of the plant's things alone."""

import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, make_scene

from warpmpc import Controller, Plant, SceneError

RANDOM = {"box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.2}, "size": {"normal": 0.01}}}


def wrong_scene(factor, *, drawn=False):
    randomize = RANDOM if drawn else {}
    return make_scene(object=[BOX], obstacle=[WALL], randomize=randomize, plant={"randomize": drawn, "factor": factor})


def plant_of(scene, seed=0):
    return Plant(scene, seed=seed, compiled=compiled(scene))


def test_factors_hold_in_the_plant_and_not_in_the_rollouts():
    scene = wrong_scene({"box": {"mass": 1.3, "friction": 0.7, "size": 1.1}})
    box = plant_of(scene).model.body("box")
    geom = plant_of(scene).model.geom(int(box.geomadr[0]))
    assert box.mass[0] == pytest.approx(1.3 * BOX["mass"])
    assert geom.friction[0] == pytest.approx(0.7)
    np.testing.assert_allclose(geom.size, 1.1 * np.array(BOX["size"]) / 2, rtol=1e-6)
    nominal = make_scene(object=[BOX], obstacle=[WALL])
    inertia = plant_of(nominal).model.body("box").inertia
    np.testing.assert_allclose(np.sort(box.inertia), np.sort(inertia) * 1.3 * 1.1**2, rtol=1e-5)
    planned = Controller(scene, seed=0, engine="mujoco", compiled=compiled(scene)).engine.simulator.models[0]
    assert planned.body("box").mass[0] == pytest.approx(BOX["mass"])
    others = [g for g in range(planned.ngeom) if g != geom.id]
    np.testing.assert_array_equal(plant_of(scene).model.geom_friction[others], planned.geom_friction[others])


def test_factors_multiply_what_is_drawn():
    factor = {"box": {"mass": 1.3, "friction": 0.7, "size": 1.1}, "base": {"mass": 2.0}}
    drawn = plant_of(wrong_scene({}, drawn=True), seed=3).properties
    both = plant_of(wrong_scene(factor, drawn=True), seed=3).properties
    assert both.names == ("box", "base")
    assert both.mass[0] == pytest.approx([1.3 * drawn.mass[0, 0], 2.0])
    assert both.friction[0] == pytest.approx([0.7 * drawn.friction[0, 0], 1.0])
    np.testing.assert_allclose(BOX["size"] + both.size[0, 0], 1.1 * (BOX["size"] + drawn.size[0, 0]))


def test_a_plant_without_factors_is_as_it_was():
    assert plant_of(wrong_scene({})).properties is None
    same = plant_of(wrong_scene({"box": {}})).model
    plain = plant_of(wrong_scene({})).model
    for name in ("body_mass", "body_inertia", "geom_friction", "geom_size"):
        np.testing.assert_array_equal(getattr(same, name), getattr(plain, name))


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        ({"bx": {"mass": 1.3}}, r"plant\.factor.*Did you mean 'box'"),
        ({"base": {"size": 1.1}}, r"plant\.factor\.base\.size.*no size to scale"),
    ],
)
def test_what_cannot_be_scaled_is_named(factor, message):
    with pytest.raises(SceneError, match=message):
        plant_of(wrong_scene(factor))
