# SPDX-License-Identifier: Apache-2.0
"""URDF files of strangers: meshes that are nowhere, inertias that nothing has, limits that mean nothing."""

import logging

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_scenes import make_scene

from warpmpc import SceneError
from warpmpc.scene.model.assets import AssetKind, asset_kind
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.urdf_physics import nearest_inertia
from warpmpc.scene.schema_bodies import Robot

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BALL = "<inertial><mass value='1'/><inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' iyz='0'/></inertial>"
LIMIT = "<limit lower='-1' upper='1' effort='5' velocity='2'/>"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "cache"))


def joint(child: str, *, parent: str = "base", kind: str = "revolute", inside: str = LIMIT) -> str:
    return (
        f"<joint name='to_{child}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<axis xyz='0 0 1'/>{inside}</joint>"
    )


def scene(tmp_path, *, base: str = "", arm: str = BALL, joints: str | None = None, links: str = ""):
    text = f"<robot name='r'><link name='base'>{base}</link><link name='arm'>{arm}</link>{links}"
    (tmp_path / "r.urdf").write_text(f"{text}{joint('arm') if joints is None else joints}</robot>")
    robot = {"name": "r", "asset": str(tmp_path / "r.urdf"), "drive": {"mode": "effort", "limit": 1.0}}
    return make_scene(robot=[robot], ground=False, goal={"frame": "r/arm", "position": (0.0, 0.0)})


def shape(tag: str, mesh: str) -> str:
    return f"<{tag}><geometry><mesh filename='{mesh}'/></geometry></{tag}>"


def model_of(compiled):
    return compiled.spec().compile()


# meshes


@pytest.mark.parametrize("uri", ["package://foo/x.stl", "x.stl", "https://somewhere/x.stl", "file:///nowhere/x.stl"])
def test_a_collision_mesh_that_is_nowhere_is_an_error_with_file_link_and_path(tmp_path, uri):
    with pytest.raises(SceneError) as caught:
        compile_scene(scene(tmp_path, arm=BALL + shape("collision", uri)))
    text = str(caught.value)
    assert text.startswith("robot.r.asset: ")
    assert all(part in text for part in (str(tmp_path / "r.urdf"), "link 'arm'", uri, "ROS_PACKAGE_PATH"))


@pytest.mark.parametrize("content", [bytes(range(256)) * 3, b"solid nothing\nendsolid nothing\n", b""])
def test_a_collision_mesh_that_cannot_be_read_is_an_error_with_file_link_and_path(tmp_path, content):
    (tmp_path / "noise.stl").write_bytes(content)
    with pytest.raises(SceneError) as caught:
        compile_scene(scene(tmp_path, arm=BALL + shape("collision", "noise.stl")))
    text = str(caught.value)
    assert "charset" not in text
    assert all(part in text for part in (str(tmp_path / "r.urdf"), "link 'arm'", str(tmp_path / "noise.stl")))


@pytest.mark.parametrize("broken", [False, True])
def test_a_visual_mesh_that_is_missing_or_broken_is_warned_of_every_time(tmp_path, broken, caplog):
    if broken:
        (tmp_path / "x.stl").write_bytes(bytes(range(256)) * 3)
    (tmp_path / "part.obj").write_text(MESH)
    wanted = scene(tmp_path, arm=BALL + shape("visual", "x.stl") + shape("visual", "part.obj"))
    seen = []
    for _ in range(3):  # the first compiles, the others come from the cache
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="warpmpc"):
            compiled = compile_scene(wanted)
        seen.append(caplog.messages)
    assert len(list((tmp_path / "cache" / "scenes").glob("*.json"))) == 1
    assert seen[0] == seen[1] == seen[2]
    assert len(seen[0]) == 1
    assert "link 'arm'" in seen[0][0]
    assert "x.stl" in seen[0][0]
    assert len(compiled.layout.meshes) == 1  # the good one


def test_a_good_file_is_not_warned_of(tmp_path, caplog):
    (tmp_path / "part.obj").write_text(MESH)
    compiled = compile_scene(scene(tmp_path, arm=BALL + shape("visual", "part.obj") + shape("collision", "part.obj")))
    assert not compiled.repaired
    assert not caplog.messages
    assert model_of(compiled).nmesh == 1


def test_a_mesh_of_a_package_on_the_ros_path_is_found_and_part_of_the_cache_key(tmp_path, monkeypatch):
    mesh = tmp_path / "elsewhere" / "foo" / "part.obj"
    mesh.parent.mkdir(parents=True)
    mesh.write_text(MESH)
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "elsewhere"))
    wanted = scene(tmp_path, arm=BALL + shape("collision", "package://foo/part.obj"))
    before = compile_scene(wanted).layout.meshes[0][0].max()
    mesh.write_text(MESH.replace("v 1 0 0", "v 2 0 0"))
    assert compile_scene(wanted).layout.meshes[0][0].max() == 2.0 * before


# inertias


def second_moments(inertia: np.ndarray) -> np.ndarray:
    return np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_the_nearest_inertia_is_one_of_some_body_and_no_further_than_it_must_be(numbers):
    xx, yy, zz, xy, xz, yz = numbers
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    nearest, moments = nearest_inertia(inertia), second_moments(inertia)
    scale = np.abs(moments).max()
    assert second_moments(nearest).min() >= -1e-12 * scale
    if moments.min() > 1e-4 * scale:
        assert nearest is inertia
    # in second moments only those below zero move, and these to zero
    np.testing.assert_allclose(second_moments(nearest), np.maximum(moments, 0.0), atol=1e-4 * scale + 1e-300)


def test_an_inertia_that_breaks_the_triangle_is_mended_with_a_warning(tmp_path):
    bad = BALL.replace("izz='.1'", "izz='.3'")
    compiled = compile_scene(scene(tmp_path, arm=bad))
    np.testing.assert_allclose(np.sort(model_of(compiled).body("r_arm").inertia), [0.15, 0.15, 0.3], rtol=1e-3)
    assert len(compiled.repaired) == 1
    assert "link 'arm'" in compiled.repaired[0]
    assert "A + B ≥ C" in compiled.repaired[0]


def test_a_flat_plate_is_left_alone(tmp_path):
    plate = BALL.replace("izz='.1'", "izz='.2'")
    compiled = compile_scene(scene(tmp_path, arm=plate))
    np.testing.assert_allclose(np.sort(model_of(compiled).body("r_arm").inertia), [0.1, 0.1, 0.2], rtol=1e-4)
    assert not compiled.repaired


def test_a_link_without_mass_between_joints_gets_next_to_none(tmp_path):
    links, joints = f"<link name='hand'>{BALL}</link>", joint("arm") + joint("hand", parent="arm")
    compiled = compile_scene(scene(tmp_path, arm="", links=links, joints=joints))
    assert model_of(compiled).body("r_arm").mass[0] == pytest.approx(1e-6, rel=1e-3)
    assert ["link 'arm'" in line and "no mass" in line for line in compiled.repaired] == [True]


def test_a_link_that_moves_nothing_is_refused_with_file_link_and_cure(tmp_path):
    with pytest.raises(SceneError, match=r"r\.urdf: link 'arm' moves, but .* give it an <inertial>"):
        compile_scene(scene(tmp_path, arm=""))


def test_a_mass_without_inertia_and_shapes_without_inertial_are_told(tmp_path):
    compiled = compile_scene(scene(tmp_path, arm="<inertial><mass value='1'/></inertial>"))
    radius = (3.0 / (4.0 * np.pi * 1000.0)) ** (1.0 / 3.0)
    np.testing.assert_allclose(model_of(compiled).body("r_arm").inertia, 0.4 * radius**2, rtol=1e-3)
    assert "no inertia" in compiled.repaired[0]
    box = "<collision><geometry><box size='.1 .1 .1'/></geometry></collision>"
    compiled = compile_scene(scene(tmp_path, arm=box))
    assert model_of(compiled).body("r_arm").mass[0] == pytest.approx(1.0, rel=1e-3)
    assert "1000 kg/m³" in compiled.repaired[0]


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("value='1'", "value='heavy'", "link 'arm': value of its <mass> must be a finite number, not 'heavy'"),
        ("value='1'", "value='-1'", "link 'arm': its mass must not be negative"),
        ("ixx='.1'", "ixx='nan'", "link 'arm': ixx of its <inertia> must be a finite number"),
    ],
)
def test_masses_that_are_none_are_refused(tmp_path, before, after, says):
    with pytest.raises(SceneError, match=f"r.urdf: {says}"):
        compile_scene(scene(tmp_path, arm=BALL.replace(before, after)))


# joints


@pytest.mark.parametrize(
    ("kind", "limit", "limited", "told"),
    [
        ("continuous", "<limit lower='0' upper='0' effort='5' velocity='2'/>", False, []),
        ("revolute", "<limit lower='0' upper='0' effort='5' velocity='2'/>", False, ["no range"]),
        ("revolute", "<limit effort='5' velocity='2'/>", False, ["no range"]),
        ("revolute", "<limit lower='-1' upper='1' effort='0' velocity='0'/>", True, ["effort and velocity"]),
        ("revolute", LIMIT, True, []),
    ],
)
def test_limits_that_say_nothing_limit_nothing(tmp_path, kind, limit, limited, told):
    compiled = compile_scene(scene(tmp_path, joints=joint("arm", kind=kind, inside=limit)))
    assert bool(model_of(compiled).joint("r_to_arm").limited[0]) is limited
    assert compiled.layout.dof_speed[0] > 0.0
    assert len(compiled.repaired) == len(told)
    assert all(part in line for part, line in zip(told, compiled.repaired, strict=True))


def test_a_range_that_ends_before_it_begins_is_refused(tmp_path):
    wrong = "<limit lower='1' upper='-1' effort='5' velocity='2'/>"
    with pytest.raises(SceneError, match=r"r\.urdf: joint 'to_arm': lower must be below upper"):
        compile_scene(scene(tmp_path, joints=joint("arm", inside=wrong)))


def test_a_fixed_joint_mimics_nothing(tmp_path):
    mimic = "<mimic joint='to_arm'/>"
    joints = joint("arm") + joint("tip", parent="arm", kind="fixed", inside=mimic)
    compiled = compile_scene(scene(tmp_path, joints=joints, links="<link name='tip'/>"))
    assert compiled.layout.nv == 1
    assert "joint 'to_tip' is fixed" in compiled.repaired[0]


def mimicking(tmp_path, *, first=(0.3, -2.0), second=(0.0, 0.5), leader="to_arm", kind="continuous", **robot):
    """An arm that leads, a finger that follows it, and a tip that follows the finger and comes first in the file."""
    links = "".join(f"<link name='{name}'>{BALL}</link>" for name in ("finger", "tip"))
    following = [
        joint(child, kind=kind, inside=f"<mimic joint='{other}' offset='{offset}' multiplier='{multiplier}'/>")
        for child, other, (offset, multiplier) in (("tip", "to_finger", second), ("finger", leader, first))
    ]
    wanted = scene(tmp_path, joints="".join(following) + joint("arm"), links=links)
    drive = {"mode": "velocity", "damping": 20.0, "limit": 1.0} | robot.pop("drive", {})
    return make_scene(
        robot=[wanted.robot[0].model_dump(exclude_unset=True) | {"drive": drive} | robot],
        ground=False,
        goal={"frame": "r/arm", "position": (0.0, 0.0)},
    )


PAIR = st.tuples(st.floats(-0.5, 0.5), st.floats(-2.0, 2.0))


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(first=PAIR, second=PAIR, start=st.floats(-0.5, 0.5))
def test_joints_that_mimic_have_no_drive_and_follow_from_the_start(tmp_path, first, second, start):
    compiled = compile_scene(mimicking(tmp_path, first=first, second=second, joint_q={"to_arm": start}), cache=False)
    layout = compiled.layout
    assert layout.control_name == ("r/to_arm",)

    def followed(arm):
        finger = first[0] + first[1] * arm
        return {"r/to_arm": arm, "r/to_finger": finger, "r/to_tip": second[0] + second[1] * finger}

    at = dict(zip(layout.dof_name, layout.joint_q[layout.dof_coord], strict=True))
    assert at == pytest.approx(followed(start), abs=1e-6)
    model = model_of(compiled)
    data = mujoco.MjData(model)
    data.qpos[:] = layout.joint_q
    data.ctrl[:] = 0.5
    mujoco.mj_step(model, data, 200)
    assert data.qpos[layout.dof_name.index("r/to_arm")] > start + 0.1
    for name, value in followed(data.qpos[layout.dof_name.index("r/to_arm")]).items():
        assert data.qpos[layout.dof_name.index(name)] == pytest.approx(value, abs=0.02)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"drive": {"joints": ["to_tip"]}}, r"drive\.joints: this joint follows 'to_arm'"),
        ({"joint_q": {"to_finger": 0.1}}, r"joint_q: this joint follows 'to_arm'"),
        ({"joint_q": [0.1, 0.1, 0.1]}, r"joint_q: needs one value per joint, 1 in all \(to_arm\)"),
        ({"leader": "nobody"}, "'to_finger': it mimics 'nobody', which is no joint"),
        ({"leader": "to_tip"}, "Cyclic URDF mimic joints: to_"),
        ({"kind": "floating"}, "'to_tip': it mimics 'to_finger', but 'to_tip' is floating"),
        ({"first": ("no", 1.0)}, "'to_finger': offset of its <mimic> is no number"),
        ({"first": (0.0, "inf")}, "'to_finger': multiplier of its <mimic> is infinite"),
    ],
)
def test_what_cannot_follow_or_be_set_is_named(tmp_path, keys, said):
    with pytest.raises(SceneError, match=said):
        compile_scene(mimicking(tmp_path, **keys), cache=False)


def test_a_joint_of_no_link_is_refused_by_name(tmp_path):
    with pytest.raises(SceneError, match=r"r\.urdf: joint 'to_leg': its child is no link of the file \('leg'\)"):
        compile_scene(scene(tmp_path, joints=joint("arm") + joint("leg")))


def test_links_that_form_a_loop_are_refused_by_name(tmp_path):
    links = "".join(f"<link name='{name}'>{BALL}</link>" for name in ("elbow", "wrist"))
    joints = joint("arm") + joint("elbow", parent="arm") + joint("wrist", parent="elbow")
    closing = joint("elbow", parent="wrist").replace("to_elbow", "closing")
    with pytest.raises(SceneError, match=r"links '(wrist' → 'elbow' → 'wrist|elbow' → 'wrist' → 'elbow)' form"):
        compile_scene(scene(tmp_path, joints=joints + closing, links=links))
    loose = joint("elbow", parent="wrist") + joint("wrist", parent="elbow")  # without a root
    with pytest.raises(SceneError, match="form a loop of joints, but a URDF is a tree: take one"):
        compile_scene(scene(tmp_path, joints=joint("arm") + loose, links=links))


def test_what_contact_alone_moves_has_an_empty_drive(tmp_path):
    wanted = scene(tmp_path)
    (driven,) = wanted.robot
    door = {"name": "door", "asset": driven.asset}
    layout = compile_scene(wanted.model_copy(update={"robot": (driven, Robot(**door, drive=()))})).layout
    assert layout.control_name == ("r/to_arm",)
    assert "door/to_arm" in layout.joint_name
    with pytest.raises(SceneError, match=r"robot\.gate\.drive: .*give the robot a drive, or drive = \[\]"):
        compile_scene(wanted.model_copy(update={"robot": (driven, Robot(name="gate", asset=driven.asset))}))


def test_a_file_without_links_is_refused(tmp_path):
    wanted = scene(tmp_path)
    (tmp_path / "r.urdf").write_text("<robot name='r'/>")
    with pytest.raises(SceneError, match=r"r\.urdf: this asset has no links"):
        compile_scene(wanted)


# xacro


def test_xacro_in_a_comment_is_none(tmp_path):
    path = tmp_path / "a.urdf"
    path.write_text("<robot><!-- made by\n<xacro:include/> --><link name='a'/></robot>")
    assert asset_kind(path) is AssetKind.URDF


@pytest.mark.parametrize("name", ["a.urdf", "a.urdf.xacro", "a.xacro"])
@pytest.mark.parametrize("there", [(), ("a.urdf",), ("a.urdf", "a_expanded.urdf")])
def test_the_hint_about_xacro_overwrites_no_file(tmp_path, name, there):
    for file in {name, *there}:
        (tmp_path / file).write_text("<robot><xacro:arm/></robot>")
    with pytest.raises(SceneError, match=r"expanded first: xacro") as caught:
        asset_kind(tmp_path / name)
    target = str(caught.value).split(" > ")[1].split(";")[0]
    assert target.endswith(".urdf")
    assert not (tmp_path / target).exists()


@pytest.mark.parametrize(("effort", "says"), [("nan", "no number"), ("-3", "below zero")])
def test_an_effort_that_is_none_is_refused(tmp_path, effort, says):
    inside = f"<limit lower='-1' upper='1' effort='{effort}' velocity='2'/>"
    with pytest.raises(SceneError, match=f"joint 'to_arm'.*{says}"):
        compile_scene(scene(tmp_path, joints=joint("arm", inside=inside)))


# names and shapes


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        ({"links": "<link name='arm'/>"}, "two links are called 'arm'"),
        ({"links": "<link/>"}, "a link has no name"),
        ({"joints": joint("arm") + joint("arm")}, "two joints are called 'to_arm'"),
        ({"joints": joint("arm").replace("to_arm", "")}, "a joint has no name: the one between 'base' and 'arm'"),
        ({"joints": joint("arm", parent="nobody")}, "its parent is no link of the file \\('nobody'\\)"),
    ],
)
def test_names_that_are_missing_or_taken_are_errors(tmp_path, inside, said):
    with pytest.raises(SceneError, match=said):
        compile_scene(scene(tmp_path, **inside))


@pytest.mark.parametrize(
    ("geometry", "size"),
    [
        ("capsule radius='.03' length='.2'", (0.03, 0.1)),
        ("cylinder radius='.03' length='.2'", (0.03, 0.1)),
        ("sphere radius='.03'", (0.03,)),
        ("box size='.1 .2 .3'", (0.05, 0.1, 0.15)),
    ],
)
def test_shapes_have_the_sizes_of_the_file(tmp_path, geometry, size):
    model = model_of(
        compile_scene(scene(tmp_path, arm=f"{BALL}<collision><geometry><{geometry}/></geometry></collision>"))
    )
    np.testing.assert_allclose(model.geom_size[-1][: len(size)], size, rtol=1e-6)
