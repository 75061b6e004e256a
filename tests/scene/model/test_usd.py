# SPDX-License-Identifier: Apache-2.0
"""USD stages: units other than metres and kilograms are refused, an up axis other than z is turned."""

import mujoco
import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import Plant, SceneError, load_scene
from warpmpc.scene.model.compiled import compile_scene

STAGE = """#usda 1.0
( defaultPrim = "rob"
  {metadata} )
def PhysicsScene "scene" {{}}
def Xform "rob" ( prepend apiSchemas = ["PhysicsArticulationRootAPI"] ) {{
  def Xform "base" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"] ) {{
    float physics:mass = 1
  }}
  def Xform "arm" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"] ) {{
    float physics:mass = 2
    float3 physics:diagonalInertia = (0.2, 0.3, 0.4)
    double3 xformOp:translate = {at}
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Cube "c" ( prepend apiSchemas = ["PhysicsCollisionAPI"] ) {{
      double size = 0.2
    }}
  }}
  def PhysicsFixedJoint "fix" {{
    rel physics:body1 = </rob/base>
  }}
  def PhysicsPrismaticJoint "j" {{
    uniform token physics:axis = "{up}"
    rel physics:body0 = </rob/base>
    rel physics:body1 = </rob/arm>
    point3f physics:localPos0 = {at}
    float physics:lowerLimit = -0.2
    float physics:upperLimit = 0.3
  }}
}}
"""


def stage(tmp_path, metadata: str, *, up: str = "Z", at: tuple = (0.3, 0.0, 0.1), **robot):
    """A robot whose arm slides upwards."""
    (tmp_path / "r.usda").write_text(STAGE.format(metadata=metadata, up=up, at=at))
    drive = {"mode": "velocity", "damping": 50.0, "limit": 1.0}
    return make_scene(
        robot=[{"name": "r", "asset": str(tmp_path / "r.usda"), "drive": drive} | robot],
        ground=False,
        goal={"frame": "r/arm", "position": (0.0, 0.0)},
    )


def test_without_usd_core_a_shipped_scene_names_the_extra(monkeypatch):
    monkeypatch.setattr("warpmpc.scene.model.importers.find_spec", lambda name: None)
    with pytest.raises(SceneError, match=r'robot\.base\.asset: .*needs usd-core: pip install "warpmpc\[usd\]"'):
        Plant(load_scene("omni_push_box:usd"))


@pytest.mark.parametrize("metadata", ["metersPerUnit = 0.01", "kilogramsPerUnit = 0.001", "metersPerUnit = 2"])
def test_other_units_are_refused_by_name(tmp_path, metadata):
    key, _, value = metadata.split()
    with pytest.raises(SceneError, match=rf"r\.asset: .*its unit is {value} k?[mg] \({key}\)"):
        compile_scene(stage(tmp_path, metadata), cache=False)


@pytest.mark.parametrize("pose", [{}, {"position": (1.0, 2.0, 0.5)}])
@pytest.mark.parametrize(
    ("up", "at"),
    [("Z", (0.3, 0.0, 0.1)), ("Y", (0.3, 0.1, 0.0))],  # the same arm, y up has z to the viewer
)
def test_an_up_axis_of_y_is_turned_upright(tmp_path, up, at, pose):
    unit = f'metersPerUnit = 1\n  upAxis = "{up}"\n  kilogramsPerUnit = 1'
    compiled = compile_scene(stage(tmp_path, unit, up=up, at=at, **pose), cache=False)
    assert not compiled.repaired
    model = compiled.spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.xaxis[0], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(model.jnt_range[0], [-0.2, 0.3], atol=1e-6)
    arm = model.jnt_bodyid[0]
    np.testing.assert_allclose(
        data.xpos[arm], np.add(pose.get("position", (0.0, 0.0, 0.0)), [0.3, 0.0, 0.1]), atol=1e-6
    )
    turn = data.ximat[arm].reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[arm]) @ turn.T
    wanted = [0.2, 0.3, 0.4] if up == "Z" else [0.2, 0.4, 0.3]
    np.testing.assert_allclose(inertia, np.diag(wanted), atol=1e-6)
