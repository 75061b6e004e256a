# SPDX-License-Identifier: Apache-2.0
"""Mistakes in what scenes are built from: robots, their assets, meshes."""

import pytest
from small_scenes import DISC, layout_of, make_scene

from warpmpc import SceneError, Task
from warpmpc.cost.stack import CostStack
from warpmpc.scene.model.builder import build_world
from warpmpc.scene.model.compiled import compile_scene


def scene_of(**keys):
    return make_scene(robot=[{**DISC, **keys}])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"frames": {"tip": {"link": "base_lnk"}}}, r"robot\.base\.frames\.tip\.link.*Did you mean 'base_link'"),
        ({"joint_q": {"yow": 0.1}}, r"robot\.base\.joint_q.*Did you mean 'yaw'"),
        ({"joint_q": {"armature": 0.1}}, "it is a key of the robot: write it above"),
        ({"joint_q": (0.1, 0.2)}, r"robot\.base\.joint_q: needs one value per joint, 3 in all \(x, y, yaw\)"),
        ({"armature": (0.1, 0.2)}, r"robot\.base\.armature: needs 1 or 3 values"),
        (
            {"drive": {"joints": ["x", "z"], "damping": 1.0, "limit": 1.0}},
            r"drive\.joints.*'z'.*x, y, yaw",
        ),
        ({"drive": {"damping": (1.0, 2.0), "limit": 1.0}}, r"robot\.base\.drive\.damping: needs 1 or 3 values"),
        ({"drive": {"damping": 1.0, "limit": (1.0, 2.0)}}, r"robot\.base\.drive\.limit: needs 1 or 3 values"),
        ({"drive": {"damping": 1.0, "lower": 1.0, "upper": 0.5}}, "lower must stay below upper"),
        (
            {"drive": [{"joints": ["x"], "damping": 1.0, "limit": 1.0}, {"damping": 1.0, "limit": 1.0}]},
            "this joint has two drives",
        ),
        ({"asset": "no_such.urdf"}, r"robot\.base\.asset.*no such file"),
    ],
)
def test_mistakes_about_a_robot_name_the_key(keys, message):
    with pytest.raises(SceneError, match=message):
        build_world(scene_of(**keys))


@pytest.mark.parametrize(
    ("name", "text"),
    [("empty.urdf", "<robot name='r'></robot>"), ("odd.xml", "<mujoco><worldbody/></mujoco>"), ("bad.urdf", "<robot>")],
)
def test_an_asset_without_links_or_sense_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(SceneError, match=r"asset|not valid XML"):
        build_world(scene_of(asset=str(tmp_path / name), frames={}, drive={"damping": 1.0, "limit": 1.0}))


def test_a_mesh_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "bad.stl").write_text("solid nothing")
    item = {"name": "thing", "shape": "mesh", "mesh": str(tmp_path / "bad.stl"), "mass": 1.0}
    with pytest.raises(SceneError, match=r"object\.thing\.mesh"):
        build_world(make_scene(object=[item]))


SEVERAL = {
    "frames": {"tip": {"link": "base_lnk"}, "toe": {"link": "bas"}},
    "spheres": {"bse_link": ()},
    "joint_q": {"yow": 0.1, "x": 0.0, "why": 0.0},
    "drive": {"joints": ["z", "w"], "damping": 1.0, "limit": 1.0},
}


@pytest.mark.parametrize("mjcf", [False, True])
def test_all_mistakes_of_bodies_are_told_at_once(tmp_path, mjcf):
    (tmp_path / "r.xml").write_text(
        '<mujoco><worldbody><body name="base_link"><joint name="x"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    robots = [{**DISC, **SEVERAL, **({"asset": str(tmp_path / "r.xml")} if mjcf else {})}]
    robots.append({**DISC, "name": "other", "asset": "no_such.urdf"})
    walls = [{"name": n, "shape": "mesh", "mesh": f"{n}.stl", "position": (0.0, 0.0, 0.0)} for n in ("left", "right")]
    with pytest.raises(SceneError) as caught:
        compile_scene(make_scene(robot=robots, obstacle=walls), cache=True)
    expected = ["robot.base.joint_q"] * 2 + ["robot.base.drive.joints"] * 2
    expected += ["robot.base.frames.tip.link", "robot.base.frames.toe.link", "robot.base.spheres.bse_link"]
    expected += ["robot.other.asset", "obstacle.left.mesh", "obstacle.right.mesh"]
    assert [each.key for each in caught.value.each] == expected


def test_all_mistakes_of_costs_are_told_at_once():
    scene = make_scene(
        cost=[{"term": "distance", "between": ["a", "goal"]}, {"term": "ywa"}, {"term": "yaw", "off": "b"}]
    )
    with pytest.raises(SceneError) as caught:
        CostStack(scene, layout_of(scene), Task(scene))
    assert [each.key for each in caught.value.each] == ["cost.distance.between", "cost.ywa.term", "cost.yaw.off"]
