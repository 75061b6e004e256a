# SPDX-License-Identifier: Apache-2.0
"""Friction of what touches: the average of both surfaces, or an object's own, in every world and on every engine."""

import numpy as np
import pytest
from needs import CUDA, needs
from small_scenes import BOX, compiled, layout_of, make_scene

from warpmpc import Controller, State
from warpmpc.scene.model.mujoco_model import Options, make_world
from warpmpc.scene.model.properties import draw_properties

TABLE = {"name": "table", "shape": "box", "size": (20.0, 20.0, 0.1), "position": (0.0, 0.0, -0.05), "friction": 0.25}
BLOCK = {**BOX, "size": (0.5, 0.5, 0.1), "position": (0.0, 4.0, 0.05), "friction": 0.2}
DRAWN = {"box": {"friction": {"uniform": 0.3}}, "table": {"friction": {"uniform": 0.9}}}
SPEED, WORLDS = 4.0, 12

GPU = (pytest.mark.gpu, needs(CUDA))
ENGINES = pytest.mark.parametrize(
    ("engine", "device"),
    [
        ("auto", "cpu"),
        ("mujoco", "cpu"),
        pytest.param("fused", "cuda:0", marks=GPU),
        pytest.param("mujoco_warp", "cuda:0", marks=GPU),
    ],
)


def friction(scene, engine: str, device: str) -> np.ndarray:
    """Friction over normal force of the block that slides over the table in every world ``[W]``."""
    controller = Controller(scene, engine=engine, device=device, seed=1, compiled=compiled(scene))
    layout = controller.layout
    qd = layout.joint_qd.copy()
    qd[layout.joint_qd_start[layout.entity("box").joints[0]]] = SPEED
    controller.plan(State(time=0.0, joint_q=layout.joint_q, joint_qd=qd))
    force = controller.engine.record(range(WORLDS)).contact_force[:, :, 0].astype(float).sum(axis=0)
    return np.hypot(force[:, 0], force[:, 1]) / force[:, 2]


def sliding(drawn: dict, **engine):
    planner = {"samples": WORLDS, "horizon": 8}
    force = {"term": "contact_force", "between": ["box", "table"]}
    return make_scene(
        cost=[force],
        object=[BLOCK],
        obstacle=[TABLE],
        ground=False,
        randomize=drawn,
        planner=planner,
        engine={"substeps": 8, **engine},
    )


@ENGINES
@pytest.mark.parametrize("names", [("table",), ("box",)])
def test_either_draw_changes_how_things_slide(engine, device, names):
    """The average of both coefficients, as drawn, is what the block feels in the rollouts."""
    scene = sliding({name: DRAWN[name] for name in names}, friction_combine="average")
    found, drawn = friction(scene, engine, device), draw_properties(scene, layout_of(scene), WORLDS, seed=2)
    own, table = (
        nominal * drawn.friction[:, drawn.names.index(name)] if name in names else nominal * np.ones(WORLDS)
        for name, nominal in (("box", 0.2), ("table", 0.25))
    )
    expected = 0.5 * (own + table)
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert np.ptp(expected) > 0.03


@ENGINES
def test_by_priority_an_objects_own_friction_holds(engine, device):
    scene = sliding(DRAWN, friction_combine="priority")
    drawn = draw_properties(scene, layout_of(scene), WORLDS, seed=2)
    np.testing.assert_allclose(friction(scene, engine, device), 0.2 * drawn.friction[:, 0], rtol=0.01)


def test_left_out_it_is_the_rule_by_which_every_draw_counts():
    other = {**BLOCK, "name": "other", "position": (3.0, 2.0, 0.05)}
    assert sliding({}).engine.friction_combine is None
    assert sliding({"box": DRAWN["box"]}).engine.friction_combine is None
    assert sliding({"table": {"size": {"normal": 0.01}}}).engine.friction_combine is None
    assert sliding(DRAWN).engine.friction_combine == "average"
    assert sliding({"table": DRAWN["table"]}).engine.friction_combine == "average"
    assert sliding(DRAWN, friction_combine="priority").engine.friction_combine == "priority"
    two = make_scene(object=[BLOCK, other], randomize={"box": DRAWN["box"]})
    assert two.engine.friction_combine == "average"


def test_but_for_friction_contacts_stay_as_they_were():
    scene = sliding(DRAWN)
    plain, averaged = (
        make_world(compiled(scene), timestep=0.01, options=options).model
        for options in (Options(), Options.of(scene.engine))
    )
    assert plain.npair == 0
    table, box = averaged.geom("table_3").id, averaged.geom("box_2").id
    pair = next(p for p in range(averaged.npair) if {averaged.pair_geom1[p], averaged.pair_geom2[p]} == {table, box})
    np.testing.assert_allclose(averaged.pair_friction[pair], [0.225, 0.225, 0.005, 0.0001, 0.0001])
    np.testing.assert_array_equal(averaged.pair_solref[pair], plain.geom_solref[box])
    np.testing.assert_array_equal(averaged.pair_solimp[pair], plain.geom_solimp[box])
    assert averaged.pair_margin[pair] == plain.geom_margin[box]
    assert averaged.pair_dim[pair] == plain.geom_condim[box]
