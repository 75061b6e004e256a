# SPDX-License-Identifier: Apache-2.0
"""From scenes to physics: shapes, robots of every format, drives, contact filters, and mistakes in them."""

import math

import mujoco
import numpy as np
import pytest
import trimesh
from small_scenes import BOX, DISC, WALL, compiled, layout_of, make_engine, make_scene, roll

from warpmpc.scene.model.compiled import _cache_key
from warpmpc.scene.model.mujoco_model import make_world
from warpmpc.scene.model.pairs import Pair

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
PENDULUM = """
<mujoco><worldbody>
  <body name="post" pos="0 0 1"><joint name="swivel" axis="0 0 1"/><geom type="cylinder" size=".05 .2" mass="2"/>
    <body name="rod" pos="0 0 0.3"><joint name="hinge" axis="0 1 0" range="-90 90" damping="0"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size=".02" mass="1"/></body></body>
</worldbody><actuator><motor joint="hinge" gear="50"/><position joint="swivel" kp="100"/></actuator></mujoco>
"""
CART = """
<robot name="cart"><link name="chassis">
  <inertial><mass value="5"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><box size="0.4 0.3 0.1"/></geometry></collision></link>
  <link name="left"><inertial><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="right"><inertial><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="ball"><inertial><mass value="0.1"/><inertia ixx=".001" iyy=".001" izz=".001" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <joint name="left_wheel" type="continuous"><parent link="chassis"/><child link="left"/>
    <origin xyz="0 0.2 0"/><axis xyz="0 1 0"/></joint>
  <joint name="right_wheel" type="continuous"><parent link="chassis"/><child link="right"/>
    <origin xyz="0 -0.2 0"/><axis xyz="0 1 0"/></joint>
  <joint name="caster" type="fixed"><parent link="chassis"/><child link="ball"/><origin xyz="-0.2 0 0"/></joint>
</robot>
"""


def robot(asset, drive=None, *, name="arm", **keys) -> dict:
    return {"name": name, "asset": str(asset), "drive": drive or {"damping": 1.0, "limit": 1.0}, **keys}


def of_robot(asset, drive=None, **keys):
    """A scene of one robot and nothing else."""
    ground = keys.pop("ground", None)
    goal = {"frame": "arm/x", "position": (0.0, 0.0)}
    return make_scene(robot=[robot(asset, drive, **keys)], ground=ground, goal=goal)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Robots in files of all formats, and a mesh."""
    folder = tmp_path_factory.mktemp("assets")
    (folder / "pendulum.xml").write_text(PENDULUM)
    (folder / "cart.urdf").write_text(CART)
    mesh = trimesh.creation.box(extents=(200.0, 400.0, 300.0))
    mesh.apply_translation((50.0, 0.0, 0.0))  # its frame is not its centre
    mesh.export(folder / "brick.stl")
    write_usd(folder / "arm.usda")
    return folder


def write_usd(path) -> None:
    """An articulation of two links and one hinge about x, 0.5 m up."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/arm").GetPrim()
    UsdPhysics.ArticulationRootAPI.Apply(root)
    stage.SetDefaultPrim(root)
    for name, z in (("base", 0.0), ("link", 0.5)):
        body = UsdGeom.Xform.Define(stage, f"/arm/{name}")
        body.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, z))
        UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
        UsdPhysics.MassAPI.Apply(body.GetPrim()).CreateMassAttr(1.5)
        cube = UsdGeom.Cube.Define(stage, f"/arm/{name}/cube")
        cube.CreateSizeAttr(0.2)
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    fixed = UsdPhysics.FixedJoint.Define(stage, "/arm/root")
    fixed.CreateBody1Rel().SetTargets(["/arm/base"])
    hinge = UsdPhysics.RevoluteJoint.Define(stage, "/arm/hinge")
    hinge.CreateBody0Rel().SetTargets(["/arm/base"])
    hinge.CreateBody1Rel().SetTargets(["/arm/link"])
    hinge.CreateAxisAttr("X")
    hinge.CreateLocalPos0Attr(Gf.Vec3f(0.0, 0.0, 0.5))
    hinge.CreateLowerLimitAttr(-90.0)
    hinge.CreateUpperLimitAttr(60.0)
    stage.Save()


def model_of(scene) -> mujoco.MjModel:
    return make_world(compiled(scene), timestep=0.01).model


def simulate(scene, control, *, steps: int = 25, q=None, qd=None, **options):
    """Roll one control out; returns joint coordinates and velocities ``[steps + 1, n]``."""
    layout = compiled(scene).layout
    engine = make_engine(scene, horizon=steps, substeps=8, **options)
    u = np.tile(np.asarray(control, dtype=np.float32), (steps, 1, 1))
    out = roll(engine, u, layout.joint_q if q is None else q, layout.joint_qd if qd is None else qd)
    assert not out.diverged.numpy().any()
    return out.joint_q.numpy()[:, 0], out.joint_qd.numpy()[:, 0], out


# shapes

SIZES = {"box": (0.3, 0.5, 0.2), "sphere": (0.15,), "cylinder": (0.2, 0.3), "capsule": (0.12, 0.4)}
HALF = {"box": (0.15, 0.25, 0.1), "sphere": (0.15,), "cylinder": (0.2, 0.15), "capsule": (0.12, 0.2)}
TURN = np.array([0.1, 0.5, -0.2, 0.8]) / np.linalg.norm([0.1, 0.5, -0.2, 0.8])


@pytest.mark.parametrize("kind", SIZES)
def test_objects_and_obstacles_have_their_shape_place_mass_and_friction(kind):
    place = {"shape": kind, "size": SIZES[kind], "rotation": tuple(TURN), "friction": 0.37}
    scene = make_scene(
        object=[{"name": "thing", "mass": 2.5, "position": (1.0, 2.0, 3.0), **place}],
        obstacle=[{"name": "rock", "position": (-1.0, 2.0, 0.5), **place}],
    )
    model, layout = model_of(scene), compiled(scene).layout
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, position in (("thing", (1.0, 2.0, 3.0)), ("rock", (-1.0, 2.0, 0.5))):
        entity = layout.entity(name)
        geom = model.geom(compiled(scene).geom_name[entity.shapes[0]])
        np.testing.assert_allclose(geom.size[: len(HALF[kind])], HALF[kind], rtol=1e-5)
        assert geom.friction[0] == pytest.approx(0.37)
        np.testing.assert_allclose(data.geom_xpos[geom.id], position, atol=1e-5)
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, TURN[[3, 0, 1, 2]])
        np.testing.assert_allclose(data.geom_xmat[geom.id], matrix, atol=1e-5)
        np.testing.assert_allclose(layout.shapes[entity.shapes[0]].scale[: len(HALF[kind])], HALF[kind], rtol=1e-5)
    body = model.body(compiled(scene).body_name[layout.entity("thing").bodies[0]])
    assert body.mass[0] == pytest.approx(2.5, rel=1e-4)
    assert compiled(scene).layout.entity("rock").bodies == ()
    np.testing.assert_allclose(layout.joint_q[3:], [1.0, 2.0, 3.0, *TURN], atol=1e-6)


def test_an_object_may_be_harder_to_turn_than_a_solid_one():
    thing = {"name": "thing", "shape": "box", "size": SIZES["box"], "mass": 2.5, "rotation": tuple(TURN)}
    scene = make_scene(object=[thing | {"inertia": (3.0, 1.0, 2.0)}])
    body = model_of(scene).body(compiled(scene).body_name[compiled(scene).layout.entity("thing").bodies[0]])
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    rotation = rotation.reshape(3, 3)
    np.testing.assert_allclose(rotation @ np.diag(body.inertia) @ rotation.T, np.diag([3.0, 1.0, 2.0]), atol=1e-5)
    assert body.mass[0] == pytest.approx(2.5, rel=1e-4)


def test_a_mesh_collides_as_its_hull_with_its_mass_about_its_own_centre(files):
    item = {"name": "brick", "shape": "mesh", "mesh": str(files / "brick.stl"), "scale": 0.001, "mass": 3.0}
    scene = make_scene(object=[{**item, "position": (0.0, 3.0, 0.15)}])
    model, layout = model_of(scene), compiled(scene).layout
    body = model.body(compiled(scene).body_name[layout.entity("brick").bodies[0]])
    assert body.mass[0] == pytest.approx(3.0, rel=1e-4)
    np.testing.assert_allclose(body.ipos, [0.05, 0.0, 0.0], atol=1e-4)
    expected = 3.0 / 12.0 * np.array([0.4**2 + 0.3**2, 0.2**2 + 0.3**2, 0.2**2 + 0.4**2])
    np.testing.assert_allclose(np.sort(body.inertia), np.sort(expected), rtol=1e-3)
    points, triangles = layout.meshes[layout.shapes[layout.entity("brick").shapes[0]].mesh]
    np.testing.assert_allclose(points.min(0), [-0.05, -0.2, -0.15], atol=1e-6)
    assert triangles.max() < len(points)
    # it lies on the floor and stays there
    q, _, out = simulate(scene, np.zeros(3), pairs=(Pair("brick", "ground"),))
    np.testing.assert_allclose(q[-1, 3:6], [0.0, 3.0, 0.15], atol=2e-3)
    np.testing.assert_allclose(out.contact_force.numpy()[-1, 0, 0], [0.0, 0.0, 3.0 * 9.81], atol=0.5)


def test_a_plane_and_the_ground_hold_things_up():
    slope = {"name": "slope", "shape": "plane", "position": (0.0, 0.0, 0.5), "friction": 1.0}
    scene = make_scene(object=[{**BOX, "position": (3.0, 0.0, 0.62)}], obstacle=[slope])
    q, _, _ = simulate(scene, np.zeros(3))
    assert q[-1, 5] == pytest.approx(0.6, abs=2e-3)
    scene = make_scene(object=[{**BOX, "position": (3.0, 0.0, -0.28)}], ground={"height": -0.4})
    q, _, _ = simulate(scene, np.zeros(3))
    assert q[-1, 5] == pytest.approx(-0.3, abs=2e-3)
    scene = make_scene(object=[{**BOX, "position": (3.0, 0.0, 1.0)}], ground=None)
    q, _, _ = simulate(scene, np.zeros(3))
    assert q[-1, 5] == pytest.approx(1.0 - 0.5 * 9.81, abs=0.05)


def test_an_objects_friction_holds_against_every_partner():
    """A shove on a floor of friction 1: the object of friction 0.1 slides v²/2μg, further than the other."""
    travelled = []
    for friction in (0.1, 0.5):
        scene = make_scene(object=[{**BOX, "position": (3.0, 0.0, 0.1), "friction": friction}])
        layout = compiled(scene).layout
        qd = layout.joint_qd.copy()
        qd[3] = 1.0
        q, _, _ = simulate(scene, np.zeros(3), steps=40, qd=qd)
        travelled.append(q[-1, 3] - 3.0)
    np.testing.assert_allclose(travelled, [1.0 / (2 * 0.1 * 9.81), 1.0 / (2 * 0.5 * 9.81)], rtol=0.1)


# robots of every format


def test_an_mjcf_robot_keeps_the_joints_of_its_root(files):
    scene = of_robot(files / "pendulum.xml", position=(1.0, 2.0, 0.5))
    layout = compiled(scene).layout
    assert layout.control_name == ("arm/swivel", "arm/hinge")
    assert layout.frame_name == ("arm/post", "arm/rod", "arm", "goal")
    np.testing.assert_allclose(layout.dof_lower[1], -math.pi / 2, rtol=1e-4)
    data = mujoco.MjData(model_of(scene))
    mujoco.mj_forward(model_of(scene), data)
    np.testing.assert_allclose(data.xpos[-1], [1.0, 2.0, 0.8], atol=1e-5)


def test_actuators_of_the_asset_do_not_act_besides_the_drives(files):
    scene = of_robot(files / "pendulum.xml", {"damping": 3.0, "limit": 1.0})
    model = model_of(scene)
    assert model.nu == 2
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 3.0)
    np.testing.assert_allclose(model.actuator_biasprm[:, :3], [[0.0, 0.0, -3.0]] * 2)
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 1.0)
    effort = {"mode": "effort", "joints": ["hinge"], "effort_limit": 5.0, "limit": 2.0}
    model = model_of(of_robot(files / "pendulum.xml", effort))
    assert model.nu == 1
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 1.0)


def test_a_urdf_robot_stands_where_it_is_put(files):
    scene = of_robot(PANDA, position=(0.4, 0.0, 0.2), joint_q={"panda_joint4": -2.0, "panda_finger_joint1": 0.02})
    layout = compiled(scene).layout
    assert (layout.nu, layout.nv) == (8, 9)  # a finger mimics the other
    assert layout.joint_q[layout.joint("arm/panda_joint4")] == -2.0
    model = model_of(scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    first = compiled(scene).body_name[layout.body_name.index("arm/panda_link1")]
    np.testing.assert_allclose(data.body(first).xpos, [0.4, 0.0, 0.533], atol=1e-4)
    # the links before the arm's first joint do not move with it
    assert layout.frame_body[layout.frame("arm")] == layout.body_name.index("arm/panda_link0")


def test_a_usd_robot_moves_on_its_hinge_and_is_never_cached(files):
    scene = of_robot(files / "arm.usda", {"damping": 50.0, "limit": 1.0}, position=(1.0, 2.0, 0.5))
    layout = compiled(scene).layout
    assert layout.control_name == ("arm/hinge",)
    np.testing.assert_allclose((layout.dof_lower[0], layout.dof_upper[0]), np.radians([-90.0, 60.0]), rtol=1e-5)
    q, _, out = simulate(scene, [0.8], steps=10)
    assert q[-1, 0] == pytest.approx(0.8 * 0.4, abs=0.02)
    np.testing.assert_allclose(out.body_q.numpy()[-1, 0, 1, :3], [1.0, 2.0, 1.0], atol=1e-5)
    assert _cache_key(scene) is None
    assert model_of(scene).body(compiled(scene).body_name[1]).mass[0] == pytest.approx(1.5)


def test_a_floating_robot_falls_and_a_fixed_one_does_not():
    drive = {"damping": 1.0, "limit": 1.0}
    floating = of_robot("nv_humanoid.xml", drive, floating=True, position=(0.0, 0.0, 2.0))
    layout = compiled(floating).layout
    assert layout.nq == layout.nv + 1
    assert len(layout.control_name) == layout.nv - 6 == 21  # all but its free joint
    start = layout.joint_q[2]
    q, qd, _ = simulate(floating, np.zeros(layout.nu), steps=5)
    fallen = 0.5 * 9.81 * 0.2**2
    assert start - q[-1, 2] == pytest.approx(fallen, rel=0.1)
    assert qd[-1, 2] == pytest.approx(-9.81 * 0.2, rel=0.1)
    as_written = compiled(of_robot("nv_humanoid.xml", drive, position=(0.0, 0.0, 2.0))).layout
    assert as_written.nq == layout.nq
    fixed = compiled(of_robot("nv_humanoid.xml", drive, floating=False, position=(0.0, 0.0, 2.0))).layout
    assert fixed.nq == fixed.nv == layout.nv - 6  # its own free joint is gone


def test_several_joints_on_one_body_are_driven_by_their_own_names():
    """In MJCF a body may stand on several joints, which Newton takes together: same motion as joint by joint."""
    # forces stay below the limit, where drives this stiff chatter in MuJoCo 4.0: its implicit step leaves them undamped
    drive = {"damping": 600.0, "effort_limit": 500.0, "limit": 1.0}
    control = [0.5, -0.3, 0.8]
    ends = []
    for asset in ("omni_base.urdf", "omni_base.xml"):
        scene = of_robot(asset, drive, ground_contact=False, joint_q={"x": 0.2, "yaw": 0.1})
        layout = compiled(scene).layout
        assert layout.control_name == ("arm/x", "arm/y", "arm/yaw")
        q, _, out = simulate(scene, control, steps=10)
        assert q[-1, layout.joint("yaw")] - q[0, layout.joint("yaw")] == pytest.approx(0.8 * 0.4, abs=0.05)
        ends.append(out.body_q.numpy()[-1, 0, layout.body_name.index("arm/base_link")])
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


def test_joints_are_as_fast_as_a_urdf_says_and_of_any_speed_where_an_asset_says_nothing():
    robots = [
        {"name": name, "asset": f"assets/{name}.{kind}", "drive": {"damping": 1.0, "limit": 1.0}}
        for name, kind in (("panda", "urdf"), ("mobile_panda", "xml"))
    ]
    speed = layout_of(make_scene(robot=robots)).dof_speed
    np.testing.assert_allclose(speed, [2.175] * 4 + [2.61] * 3 + [1e6] * 12)


def test_axes_of_a_humanoid_bear_the_names_of_its_file():
    drive = {"damping": 200.0, "effort_limit": 1000.0, "limit": 1.0}
    keys = {"position": (0.0, 0.0, 2.0), "gravity_compensation": True, "floating": False}
    scene = of_robot("nv_humanoid.xml", drive, **keys)
    layout = compiled(scene).layout
    control = np.zeros(layout.nu)
    control[layout.control_name.index("arm/right_hip_y")] = -0.5
    q, _, _ = simulate(scene, control, steps=10)
    moved = q[-1] - q[0]
    assert moved[layout.joint("right_hip_y")] == pytest.approx(-0.5 * 0.4, abs=0.06)
    others = [layout.joint(name) for name in layout.dof_name if name and name != "arm/right_hip_y"]
    assert np.abs(moved[others]).max() < 0.06


# drives


def test_a_differential_drive_turns_its_wheels(files):
    drive = {
        "mode": "diff_drive",
        "joints": ["left_wheel", "right_wheel"],
        "damping": 20.0,
        "wheel_radius": 0.1,
        "track": 0.4,
        "limit": (1.0, 2.0),
    }
    keys = {"floating": True, "position": (0.0, 0.0, 0.1), "friction": 1.0}
    scene = of_robot(files / "cart.urdf", drive, ground={"friction": 1.0}, **keys)
    layout = compiled(scene).layout
    assert layout.control_name == ("arm/v", "arm/ω")
    assert layout.actuator_mode == ("velocity", "velocity")
    np.testing.assert_allclose(layout.control_upper, [1.0, 2.0])
    # wheel speeds (v ∓ ω track / 2) / radius
    np.testing.assert_allclose(layout.actuator_matrix @ [0.5, 1.0], [(0.5 - 0.2) / 0.1, (0.5 + 0.2) / 0.1], rtol=1e-6)
    _, qd, _ = simulate(scene, [0.4, 0.0], steps=25)
    assert qd[-1, 0] == pytest.approx(0.4, abs=0.03)
    assert abs(qd[-1, 5]) < 0.05
    _, qd, _ = simulate(scene, [0.0, 1.0], steps=25)
    assert qd[-1, 5] == pytest.approx(1.0, rel=0.2)  # to the left


def test_an_effort_drive_is_a_force_on_the_joint():
    drive = {"mode": "effort", "joints": ["x", "y"], "effort_limit": (8.0, 100.0), "limit": 20.0}
    scene = make_scene(robot=[{**DISC, "drive": drive}])
    layout = compiled(scene).layout
    assert layout.control_safe.tolist() == [-1, -1]
    _, qd, _ = simulate(scene, [5.0, 20.0], steps=10)
    # 10 kg all in all, 9.5 kg beyond the first slide
    np.testing.assert_allclose(qd[-1, :2], [5.0 / 10.0 * 0.4, 20.0 / 9.5 * 0.4], rtol=1e-3)
    _, qd, _ = simulate(scene, [20.0, 0.0], steps=10)
    assert qd[-1, 0] == pytest.approx(8.0 / 10.0 * 0.4, rel=1e-3)  # its limit


def test_a_position_drive_holds_positions():
    drive = {"mode": "position", "stiffness": 2000.0, "damping": 200.0, "lower": -1.0, "upper": (1.0, 2.0, 0.5)}
    scene = make_scene(robot=[{**DISC, "joint_q": (0.1, 0.2, 0.3), "drive": drive}])
    layout = compiled(scene).layout
    assert layout.control_safe.tolist() == [0, 1, 2]
    np.testing.assert_allclose(layout.control_lower, -1.0)
    np.testing.assert_allclose(layout.control_upper, [1.0, 2.0, 0.5])
    q, _, _ = simulate(scene, [0.5, -0.4, 0.2], steps=50)
    np.testing.assert_allclose(q[-1], [0.5, -0.4, 0.2], atol=0.01)


def test_controls_of_several_drives_are_stacked_in_their_order():
    drives = [
        {"joints": ["yaw"], "damping": 5.0, "limit": 3.0, "effort_limit": 7.0},
        {"mode": "position", "joints": ["x"], "stiffness": 100.0, "damping": 10.0, "limit": 2.0},
        {"mode": "effort", "joints": ["y"], "limit": 1.0},
    ]
    other = {**DISC, "name": "other", "position": (5.0, 0.0, 0.0)}
    scene = make_scene(robot=[{**DISC, "drive": drives, "armature": (0.3, 0.1, 0.2)}, other])
    layout = compiled(scene).layout
    assert layout.control_name == ("base/yaw", "base/x", "base/y", "other/x", "other/y", "other/yaw")
    assert layout.actuator_dof.tolist() == [2, 0, 1, 3, 4, 5]
    assert layout.control_safe.tolist() == [-1, 0, -1, -1, -1, -1]
    np.testing.assert_allclose(layout.control_upper, [3.0, 2.0, 1.0, 1.0, 1.0, 1.0])
    assert layout.actuator_effort[0] == 7.0
    model = model_of(scene)
    np.testing.assert_allclose(model.dof_armature[:3], [0.1, 0.2, 0.3], rtol=1e-5)
    q, qd, _ = simulate(scene, [1.5, 0.5, 1.0, 0.2, -0.3, 0.4], steps=60)
    np.testing.assert_allclose(qd[-1, [2, 3, 4, 5]], [1.5, 0.2, -0.3, 0.4], atol=0.05)
    assert q[-1, 0] == pytest.approx(0.5, abs=0.1)
    assert qd[-1, 1] == pytest.approx(1.0 / (9.5 + 0.2) * 2.4, rel=0.05)


def test_gravity_compensation_holds_an_arm_that_would_fall(files):
    slack = {"mode": "effort", "limit": 1.0}
    moved = []
    for compensated in (True, False):
        scene = of_robot(files / "pendulum.xml", slack, gravity_compensation=compensated)
        q, _, _ = simulate(scene, np.zeros(2), steps=5)
        moved.append(np.abs(q[-1] - q[0]).max())
    assert moved[0] < 1e-4 < 0.1 < moved[1]


@pytest.mark.parametrize("contact", [True, False])
def test_a_gliding_base_ignores_planes_and_nothing_else(contact):
    """Half sunk into the floor: it is pushed out of it only if it touches it."""
    slope = {"name": "slope", "shape": "plane", "position": (0.0, 0.0, 0.02)}
    scene = make_scene(
        robot=[{**DISC, "position": (0.0, 0.0, -0.05), "ground_contact": contact, "joint_q": (1.25, 0.0, 0.0)}],
        obstacle=[WALL, slope],
    )
    pairs = (Pair("base", "ground"), Pair("base", "slope"), Pair("base", "wall"))
    _, _, out = simulate(scene, np.zeros(3), steps=2, pairs=pairs)
    force = np.linalg.norm(out.contact_force.numpy()[0, 0], axis=-1)
    assert (force[:2] > 1.0).tolist() == [contact, contact]
    assert force[2] > 1.0
