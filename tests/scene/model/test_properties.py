# SPDX-License-Identifier: Apache-2.0
"""Randomized models against MuJoCo's compiler, and what a draw depends on."""

from types import SimpleNamespace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import trimesh
from small_scenes import BOX, WALL, compiled, make_scene

from warpmpc import Controller, Plant, SceneError
from warpmpc.engine.newton import build_model
from warpmpc.scene.model.drawn_model import ARRAYS, DrawnModel, randomize_newton, randomized_arrays, randomized_models
from warpmpc.scene.model.mujoco_model import keep_damping, make_world
from warpmpc.scene.model.properties import Properties, draw_properties
from warpmpc.scene.model.trajectory import BatchSize

SHAPES = {
    "box": (0.3, 0.5, 0.2),
    "sphere": (0.15,),
    "cylinder": (0.2, 0.3),
    "capsule": (0.12, 0.4),
}
RANDOM = {
    "box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.2}, "size": {"normal": 0.01}},
    "base": {"mass": {"uniform": 0.1}},
}


def one(name: str, *, mass=1.0, friction=1.0, size=(0.0, 0.0, 0.0)) -> Properties:
    """One draw of one entity."""
    return Properties((name,), np.array([[mass]]), np.array([[friction]]), np.array([[size]]))


def floats(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """All arrays of numbers of a model."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {k: v.copy() for k, v in arrays.items() if isinstance(v, np.ndarray) and v.dtype.kind == "f"}


def settings(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """What make_world sets besides."""
    spec.option.timestep, spec.option.iterations, spec.option.tolerance = 0.01, 20, 1e-6
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    keep_damping(spec)
    return spec


@pytest.mark.parametrize("offset", [(0.04, -0.06, 0.02), (-0.02, 0.03, 0.05)])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_changed_object_is_what_the_compiler_makes_of_it(shape, offset):
    """Every number of the model: inertia, invweights, bounding boxes, ..."""
    item = {**BOX, "shape": shape, "size": SHAPES[shape], "friction": 0.4, "mass": 2.0}
    scene = make_scene(object=[item], obstacle=[WALL])
    world = make_world(compiled(scene), timestep=0.01)
    drawn = randomized_models(world, one("box", mass=1.3, friction=0.8, size=offset))[0]

    size = np.array(SHAPES[shape]) + np.array(offset)[: len(SHAPES[shape])]
    half = size / 2 if shape == "box" else size * [1.0, 0.5][: len(size)]
    xml = ElementTree.fromstring(compiled(scene).mjcf)
    body = xml.find(".//body[@name='box']")
    body.remove(body.find("inertial"))  # the compiler derives it from the geometry
    body.find("geom").attrib.update(size=" ".join(map(str, half)), mass="2.6", friction="0.32 0.005 0.0001")
    expected = floats(settings(mujoco.MjSpec.from_string(ElementTree.tostring(xml, encoding="unicode"))).compile())
    found = floats(drawn)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=2e-5, atol=2e-6, err_msg=name)
    nominal = floats(world.model)
    changed = {name for name in nominal if not np.array_equal(nominal[name], found[name])}
    assert {"body_mass", "body_inertia", "geom_size", "geom_friction", "geom_rbound", "geom_aabb"} <= changed


def test_an_obstacle_can_change_its_size_and_friction():
    scene = make_scene(obstacle=[WALL, {**WALL, "name": "other", "position": (-2.0, 0.0, 0.2)}])
    world = make_world(compiled(scene), timestep=0.01)
    drawn = randomized_models(world, one("other", friction=0.5, size=(0.1, 0.2, -0.1)))[0]
    spec = settings(mujoco.MjSpec.from_string(compiled(scene).mjcf))
    geom = next(g for g in spec.worldbody.geoms if g.name.startswith("other"))
    geom.size, geom.friction[0] = [0.15, 1.1, 0.15], 0.5
    for name, value in floats(spec.compile()).items():
        np.testing.assert_allclose(floats(drawn)[name], value, rtol=2e-5, atol=2e-6, err_msg=name)


def test_a_robots_mass_and_friction_change_on_all_its_links():
    scene = make_scene(obstacle=[WALL])
    world = make_world(compiled(scene), timestep=0.01)
    drawn = randomized_models(world, one("base", mass=1.5, friction=0.5))[0]
    ratio = floats(drawn)["body_mass"][1:] / np.maximum(floats(world.model)["body_mass"][1:], 1e-9)
    moving = world.model.body_mass[1:] > 0
    assert moving.sum() == 3
    np.testing.assert_allclose(ratio[moving], 1.5)
    own = list(world.geoms["base"])
    others = [g for g in range(world.model.ngeom) if g not in own]
    np.testing.assert_allclose(drawn.geom_friction[own, 0], 0.5 * world.model.geom_friction[own, 0])
    np.testing.assert_array_equal(drawn.geom_friction[others], world.model.geom_friction[others])


PULLED = """<mujoco><worldbody>
  <body name="left" pos="0 0 1"><joint name="left" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3" mass="1"/></body>
  <body name="right" pos="1 0 1"><joint name="right" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3" mass="2"/></body>
</worldbody>
<tendon><fixed name="rope"><joint joint="left" coef="1"/><joint joint="right" coef="2"/></fixed></tendon>
<actuator><muscle tendon="rope" lengthrange="-1 1"/></actuator></mujoco>"""


def test_a_tendon_between_two_trees_weighs_what_mujoco_says_where_one_is_drawn():
    nominal, expected = (mujoco.MjModel.from_xml_string(PULLED) for _ in range(2))
    expected.body_mass[1] *= 1.5
    expected.body_inertia[1] *= 1.5
    mujoco.mj_setConst(expected, mujoco.MjData(expected))
    world = SimpleNamespace(model=nominal, bodies={"left": (1,)}, geoms={"left": (0,)}, averaged=[], damped=())
    found = DrawnModel(world, one("left", mass=1.5)).arrays()
    for name in ARRAYS:
        np.testing.assert_allclose(found[name][0], getattr(expected, name), rtol=1e-12, err_msg=name)
    assert expected.tendon_invweight0 != pytest.approx(nominal.tendon_invweight0)


def test_a_shape_never_shrinks_to_nothing():
    scene = make_scene(object=[BOX])
    drawn = randomized_models(make_world(compiled(scene), timestep=0.01), one("box", size=(-1.0, -1.0, -1.0)))[0]
    np.testing.assert_allclose(drawn.geom("box_2").size, [0.015, 0.025, 0.01], rtol=1e-6)


def test_draws_do_not_depend_on_how_many_there_are():
    scene = make_scene(object=[BOX], randomize=RANDOM)
    layout = compiled(scene).layout
    few, many = (draw_properties(scene, layout, count, seed=5) for count in (3, 40))
    other = draw_properties(scene, layout, 40, seed=6)
    for name in ("mass", "friction", "size"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:3])
    assert few.draws == 3
    assert many.names == ("box", "base")
    assert np.all(np.abs(many.mass - 1.0) <= [0.3, 0.1])
    assert np.abs(many.mass - 1.0).max(axis=0) == pytest.approx([0.3, 0.1], rel=0.2)
    assert np.all(many.friction[:, 1] == 1.0)
    assert np.all(many.size[:, 1] == 0.0)
    assert 0.005 < many.size[:, 0].std() < 0.015
    # mass, friction and seeds vary independently
    assert abs(np.corrcoef(many.mass[:, 0], many.friction[:, 0])[0, 1]) < 0.5
    assert not np.any(many.mass == other.mass)


def test_unknown_entities_are_named():
    scene = make_scene(object=[BOX], randomize={"bx": {"mass": {"uniform": 0.1}}})
    with pytest.raises(SceneError, match=r"randomize.*Did you mean 'box'"):
        draw_properties(scene, compiled(scene).layout, 2, seed=0)


def test_sizes_of_a_mesh_are_refused(tmp_path):
    trimesh.creation.box((0.2, 0.2, 0.2)).export(tmp_path / "rock.stl")
    rock = {"name": "rock", "shape": "mesh", "mesh": str(tmp_path / "rock.stl"), "position": (2.0, 0.0, 0.1)}
    scene = make_scene(obstacle=[rock], randomize={"rock": {"size": {"normal": 0.01}}})
    with pytest.raises(SceneError, match=r"randomize\.rock\.size: sizes of mesh cannot be drawn: leave it out"):
        draw_properties(scene, compiled(scene).layout, 4, seed=0)


def test_the_plant_is_another_world_than_the_planners():
    scene = make_scene(object=[BOX], randomize=RANDOM, planner={"samples": 4, "horizon": 2})
    controller = Controller(scene, seed=0, engine="mujoco", compiled=compiled(scene))
    masses = [model.body("box").mass[0] for model in controller.engine.simulator.models]
    assert len(set(masses)) == 4
    plants = [Plant(scene, seed=seed, compiled=compiled(scene)).properties.mass[0, 0] for seed in (0, 0, 1)]
    assert plants[0] == plants[1] != plants[2]
    assert not set(np.round(masses, 5)) & set(np.round(plants, 5))
    nominal = make_scene(object=[BOX], randomize=RANDOM, plant={"randomize": False})
    assert Plant(nominal, compiled=compiled(nominal))._engine.model.body("box").mass[0] == pytest.approx(1.0)


def test_a_planner_that_randomizes_nothing_meets_a_randomized_plant():
    planner = {"samples": 4, "horizon": 2, "randomize": False}
    scene = make_scene(object=[BOX], randomize=RANDOM, planner=planner)
    controller = Controller(scene, engine="mujoco", compiled=compiled(scene))
    masses = [model.body("box").mass[0] for model in controller.engine.simulator.models]
    assert masses == pytest.approx([1.0] * len(masses))
    assert Plant(scene, compiled=compiled(scene)).properties.mass[0, 0] != pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("kind", ["box", "sphere", "capsule", "cylinder"])
def test_newtons_model_is_drawn_like_mujocos(kind):
    """One draw, two models: the same mass, inertia, friction and size in every world."""
    size = {"box": (0.3, 0.5, 0.2), "sphere": (0.15,), "capsule": (0.12, 0.4), "cylinder": (0.2, 0.3)}[kind]
    thing = {"name": "thing", "shape": kind, "size": size, "mass": 2.0, "position": (2.0, 0.0, 0.5)}
    rules = {"thing": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.02}}}
    scene = make_scene(object=[thing], randomize=rules)
    layout, shape = compiled(scene).layout, BatchSize(1, 3, 1, 1)
    properties = draw_properties(scene, layout, 3, seed=5)
    world = make_world(compiled(scene), timestep=0.01)
    expected = randomized_arrays(world, properties)
    model = build_model(scene, 3, "cpu")
    assert randomize_newton(model, layout, shape, properties, world)
    body, geom = world.bodies["thing"][0], world.geoms["thing"][0]
    own, mine = layout.entity("thing").bodies[0], layout.entity("thing").shapes[0]
    mass = model.body_mass.numpy().reshape(3, -1)[:, own]
    np.testing.assert_allclose(mass, expected["body_mass"][:, body], rtol=1e-6)
    assert np.ptp(mass) > 0.01
    inertia = model.body_inertia.numpy().reshape(3, -1, 3, 3)[:, own]
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvalsh(inertia), axis=1), np.sort(expected["body_inertia"][:, body], axis=1), rtol=1e-4
    )
    inverse = model.body_inv_inertia.numpy().reshape(3, -1, 3, 3)[:, own]
    np.testing.assert_allclose(inverse @ inertia, np.tile(np.eye(3), (3, 1, 1)), atol=1e-5)
    friction = model.shape_material_mu.numpy().reshape(3, -1)[:, mine]
    np.testing.assert_allclose(friction, expected["geom_friction"][:, geom, 0], rtol=1e-6)
    count = {"box": 3, "sphere": 1}.get(kind, 2)
    sizes = model.shape_scale.numpy().reshape(3, -1, 3)[:, mine, :count]
    np.testing.assert_allclose(sizes, expected["geom_size"][:, geom, :count], rtol=1e-6)


def test_what_is_off_by_all_of_its_range_is_so_up_and_down():
    scene = make_scene(object=[BOX], randomize={"box": {"mass": {"uniform": 0.3, "ends": True}}})
    drawn = draw_properties(scene, compiled(scene).layout, 64, seed=5)
    np.testing.assert_allclose(np.unique(drawn.mass.round(6)), [0.7, 1.3])
    assert 0.3 < np.mean(drawn.mass > 1.0) < 0.7
    np.testing.assert_array_equal(drawn.friction, 1.0)
    full = make_scene(object=[BOX], randomize={"box": {"mass": {"uniform": 0.3}}})
    inner = draw_properties(full, compiled(full).layout, 64, seed=5)
    np.testing.assert_array_equal(drawn.mass > 1.0, inner.mass > 1.0)
