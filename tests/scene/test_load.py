# SPDX-License-Identifier: Apache-2.0
"""What a scene file, its variants and overrides become."""

import math
import os
import subprocess
import sys

import pytest
from needs import need_scene
from scene_text import SMALL, write

from warpmpc import Scene, SceneError, load_scene, shipped_scenes
from warpmpc.scene.load import variants
from warpmpc.scene.model.assets import resolve_asset
from warpmpc.scene.overrides import expand, parse_override, split_key, with_values

SHIPPED = [name + suffix for name in shipped_scenes() for suffix in ("", *(f":{v}" for v in variants(name)))]


@pytest.mark.parametrize("source", SHIPPED)
def test_every_shipped_scene_and_variant_is_valid_and_finds_its_assets(source):
    scene = load_scene(source)
    assert scene.name == source.partition(":")[0]
    need_scene(scene.name)
    for robot in scene.robot:
        assert resolve_asset(robot.asset, base=scene.path.parent, key="asset").is_file()


def test_the_paper_task_has_the_paper_numbers():
    scene = load_scene("omni_push_box")
    assert scene.timing.control_dt == 0.04
    assert scene.timing.timeout == 45.0
    assert scene.robot[0].joint_q == (0.0, 2.0, 0.0)
    assert scene.robot[0].drive[0].limit == (0.8, 0.8, 1.0)
    assert (scene.object[0].mass, scene.object[0].friction) == (1.0, 0.3)
    assert (scene.success.position, scene.success.yaw) == ((0.05,), 0.17)
    assert load_scene("omni_push_box:B").robot[0].joint_q == (0.0, 0.0, 1.5708)


def test_a_path_and_a_variant_behind_it_are_found(tmp_path, monkeypatch):
    path = write(tmp_path)
    assert load_scene(path).variant is None
    assert load_scene(path).path == path
    scene = load_scene(f"{path}:near")
    assert (scene.path, scene.variant) == (path, "near")
    monkeypatch.chdir(tmp_path)
    assert load_scene("small.toml:near") == scene


def test_a_file_with_a_colon_in_its_name_is_a_file(tmp_path):
    path = tmp_path / "a:b.toml"
    path.write_text(SMALL, encoding="utf-8")
    assert load_scene(path).variant is None
    assert load_scene(f"{path}:near").variant == "near"


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert load_scene(path).object[0].name == "box"


def test_a_variant_changes_what_it_names_and_nothing_else(tmp_path):
    plain, near = load_scene(write(tmp_path)), load_scene(f"{write(tmp_path)}:near")
    assert near.goal.position == (1.0, 0.0)
    assert near.goal.object == "box"
    assert near.obstacle[0].position == (5.0, 5.0, 0.0)
    assert near.obstacle[1] == plain.obstacle[1]
    assert [cost.weight for cost in near.cost] == [7.0, 1.0]
    assert near.planner.noise.sigma == (0.1, 0.2, 0.3)
    assert near.planner.samples == plain.planner.samples
    assert variants(write(tmp_path)) == ("near",)


def test_a_variant_may_replace_a_whole_array(tmp_path):
    text = SMALL + '[[variants.empty.obstacle]]\nname = "pole"\nshape = "cylinder"\nsize = [0.1, 1.0]\n'
    scene = load_scene(f"{write(tmp_path, text)}:empty")
    assert [obstacle.name for obstacle in scene.obstacle] == ["pole"]


def test_variants_are_laid_one_over_the_other(tmp_path):
    text = SMALL + "[variants.far]\ngoal.position = [8.0, 0.0]\nplanner.samples = 77\n"
    scene = load_scene(f"{write(tmp_path, text)}:near+far")
    assert (scene.goal.position, scene.planner.samples, scene.variant) == ((8.0, 0.0), 77, "near+far")
    assert scene.planner.noise.sigma == (0.1, 0.2, 0.3)
    assert load_scene(f"{write(tmp_path, text)}:far+near").goal.position == (1.0, 0.0)
    with pytest.raises(SceneError, match="no such variant"):
        load_scene(f"{write(tmp_path, text)}:near+fur")


@pytest.mark.parametrize(
    ("override", "get", "value"),
    [
        ("planner.samples=500", lambda s: s.planner.samples, 500),
        ("planner.noise.sigma=[1, 2, 3]", lambda s: s.planner.noise.sigma, (1.0, 2.0, 3.0)),
        ("planner.noise.sigma = 2", lambda s: s.planner.noise.sigma, (2.0,)),
        ("robot.base.joint_q=[0,0,1]", lambda s: s.robot[0].joint_q, (0.0, 0.0, 1.0)),
        ("robot.base.joint_q.yaw=1", lambda s: s.robot[0].joint_q, {"yaw": 1.0}),
        ("robot.base.drive.limit=3", lambda s: s.robot[0].drive[0].limit, (3.0,)),
        ("robot.base.asset=../robots/other.urdf", lambda s: s.robot[0].asset, "../robots/other.urdf"),
        ("robot.base.asset=package://p/x.urdf", lambda s: s.robot[0].asset, "package://p/x.urdf"),
        ("object.box.mass=2", lambda s: s.object[0].mass, 2.0),
        ("obstacle.wall.position=[1,2,3]", lambda s: s.obstacle[0].position, (1.0, 2.0, 3.0)),
        ("obstacle.*.friction=0.25", lambda s: [o.friction for o in s.obstacle], [0.25, 0.25]),
        ("cost.distance.weight=3", lambda s: s.cost[0].weight, 3.0),
        ("cost.distance.metric=geodesic", lambda s: s.cost[0].params["metric"], "geodesic"),
        ("cost.*.weight=0", lambda s: [c.weight for c in s.cost], [0.0, 0.0]),
        ("planner.method=cem", lambda s: s.planner.method, "cem"),
        ("goal.position.1=4", lambda s: s.goal.position, (2.0, 4.0)),
        ("ground=false", lambda s: s.ground, None),
        ("ground.height=-1", lambda s: s.ground.height, -1.0),
        ("goal={object='box', position=[9, 9]}", lambda s: s.goal.position, (9.0, 9.0)),
        ("randomize.box={mass={uniform=0.1}}", lambda s: s.randomize["box"].mass.uniform, 0.1),
        ("planner.temperature.ess=20", lambda s: (s.planner.temperature.ess, s.planner.temperature.eta), (20.0, None)),
        ("planner.temperature.eta=false", lambda s: s.planner.temperature.eta, None),
        ("title=Hello", lambda s: s.title, "Hello"),
    ],
)
def test_an_override_sets_the_value_it_addresses(tmp_path, override, get, value):
    assert get(load_scene(write(tmp_path), overrides=[override])) == value


def test_overrides_follow_the_variant_and_each_other(tmp_path):
    source = f"{write(tmp_path)}:near"
    scene = load_scene(source, overrides=["goal.position=[3, 3]", "planner.samples=8", "planner.samples=9"])
    assert scene.goal.position == (3.0, 3.0)
    assert scene.planner.samples == 9


def test_a_cost_name_goes_before_a_cost_term(tmp_path):
    text = SMALL + '[[cost]]\nname = "contact_force"\nterm = "distance"\n[[cost]]\nname = "far"\nterm = "yaw"\n'
    text = text.replace('term = "contact_force"', 'term = "contact_force"\nname = "bump"')
    scene = load_scene(write(tmp_path, text), overrides=["cost.contact_force.weight=5", "cost.yaw.weight=6"])
    assert {cost.label: cost.weight for cost in scene.cost} == {
        "distance": 1.0,
        "bump": 1.0,
        "contact_force": 5.0,
        "far": 6.0,
    }


def test_drives_without_names_are_addressed_by_their_place(tmp_path):
    two = '[{joints=["x"], damping=1, limit=1}, {joints=["y"], damping=1, limit=1}]'
    overrides = [f"robot.base.drive={two}", "robot.base.drive.1.limit=2", "robot.base.drive.*.damping=3"]
    scene = load_scene(write(tmp_path), overrides=overrides)
    assert [(d.limit, d.damping) for d in scene.robot[0].drive] == [((1.0,), (3.0,)), ((2.0,), (3.0,))]


def test_rotations_become_unit_quaternions(tmp_path):
    scene = load_scene(write(tmp_path), overrides=["object.box.rotation=[0, 0, 2, 0]", "goal.rotation=[0, 0, 0, 9]"])
    assert scene.object[0].rotation == (0.0, 0.0, 1.0, 0.0)
    assert scene.goal.rotation == (0.0, 0.0, 0.0, 1.0)


def test_with_values_changes_a_scene_in_python(tmp_path):
    scene = load_scene(f"{write(tmp_path)}:near")
    changed = with_values(scene, {"obstacle.*.friction": 0.5, "goal.position": (0.0, 1.0)})
    assert [o.friction for o in changed.obstacle] == [0.5, 0.5]
    assert changed.goal.position == (0.0, 1.0)
    assert (changed.path, changed.variant) == (scene.path, scene.variant)
    assert scene.goal.position == (1.0, 0.0)
    assert with_values(scene, {}) == scene


def test_keys_split_at_dots_outside_quotes():
    assert split_key('randomize_task.draw."goal.position".low') == ("randomize_task", "draw", "goal.position", "low")
    assert parse_override(" a . b = [1,\t2] ") == (("a", "b"), [1, 2])
    with pytest.raises(SceneError):
        split_key("a..b")


def test_a_star_expands_to_full_keys(tmp_path):
    data = load_scene(write(tmp_path)).model_dump(mode="json")
    assert list(expand(data, ("obstacle", "*", "size"))) == [("obstacle", "wall", "size"), ("obstacle", "ball", "size")]


def test_a_scene_built_in_python_needs_no_file(tmp_path):
    scene = load_scene(write(tmp_path))
    built = Scene(robot=scene.robot, object=scene.object, goal=scene.goal, cost=scene.cost, success=scene.success)
    assert built.path is None
    assert built.name == "scene"


BARE = """
import importlib.util, sys, types
package = types.ModuleType("warpmpc")  # the room alone, without what the package's front door brings along
package.__path__ = list(importlib.util.find_spec("warpmpc").submodule_search_locations)
sys.modules["warpmpc"] = package
from warpmpc.scene.load import load_scene
load_scene("omni_push_box")
print([name for name in ("newton", "warp", "trimesh", "scipy", "mujoco", "numpy") if name in sys.modules])
"""


def test_loading_needs_no_physics():
    done = subprocess.run([sys.executable, "-c", BARE], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_minus_nothing_is_nothing():
    scene = load_scene("point_reach", overrides=["plant.noise.velocity=-0.0"])
    assert math.copysign(1.0, scene.plant.noise.velocity) == 1.0  # numpy draws nothing from a deviation of -0


@pytest.mark.parametrize(
    ("planner", "steps", "dt", "knots"),
    [
        ({}, 15, 0.08, 5),
        ({"samples": 32, "method": "cem"}, 15, 0.08, 5),
        ({"dt": 0.05}, 24, 0.05, 5),
        ({"knots": 9}, 15, 0.08, 9),
        ({"horizon": "auto", "dt": 0.4}, 3, 0.4, 3),
        ({"lookahead": 2.4}, 30, 0.08, 5),
        ({"lookahead": 0.2}, 3, 0.08, 3),
    ],
)
def test_steps_follow_from_how_far_a_planner_looks_ahead(planner, steps, dt, knots):
    data = load_scene("pendulum").model_dump(exclude_unset=True)  # controls of 0.02 s
    scene = Scene.model_validate({**data, "planner": planner})
    for found in (scene.planner, Scene.model_validate(scene.model_dump(exclude_unset=True)).planner):
        assert (found.horizon, found.dt, found.knots, found.spline, found.discount) == (
            steps,
            (dt,),
            knots,
            "cubic",
            1.0,
        )
        assert (found.noise.shape, found.noise.spread, found.temperature.ess) == ("identity", (0.02, 1.0), 4.0)


def test_derivatives_look_as_far_ahead_in_steps_of_controls():
    data = load_scene("pendulum").model_dump(exclude_unset=True)
    scene = Scene.model_validate({**data, "planner": {"method": "ilqg", "lookahead": 0.5}})
    for found in (scene.planner, Scene.model_validate(scene.model_dump(exclude_unset=True)).planner):
        assert (found.horizon, found.dt) == (25, (0.02,))


def test_a_horizon_and_a_lookahead_are_one_too_many():
    data = load_scene("pendulum").model_dump(exclude_unset=True)
    with pytest.raises(ValueError, match="horizon and lookahead say the same"):
        Scene.model_validate({**data, "planner": {"horizon": 20, "lookahead": 2.0}})


def test_the_later_of_two_keys_that_say_the_same_replaces_the_other():
    longer = load_scene("quadrotor", overrides=["planner.horizon=20"])  # its file has a lookahead
    assert (longer.planner.horizon, longer.planner.lookahead, longer.planner.spline) == (20, None, "cubic")
    assert load_scene("quadrotor", overrides=["planner.horizon=20", "planner.lookahead=1.6"]).planner.lookahead == 1.6
    temperature = load_scene("walker", overrides=["planner.temperature.ess=3"]).planner.temperature
    assert (temperature.ess, temperature.eta) == (3.0, None)


def test_what_is_said_comes_before_the_defaults():
    data = load_scene("pendulum").model_dump(exclude_unset=True)
    said = {"noise": {"sigma": 0.3, "redraw": False}, "temperature": {"eta": (3.0, 8.0)}, "discount": 0.9}
    planner = Scene.model_validate({**data, "planner": said}).planner
    assert (planner.noise.sigma, planner.noise.redraw, planner.noise.constant) == ((0.3,), False, 0.1)
    assert (planner.temperature.eta, planner.temperature.ess, planner.discount) == ((3.0, 8.0), None, 0.9)


@pytest.mark.parametrize("planner", [{"method": "ilqg"}, {"refine": {"method": "gradient"}}])
def test_derivatives_keep_the_steps_of_controls(planner):
    data = load_scene("pendulum").model_dump(exclude_unset=True)
    found = Scene.model_validate({**data, "planner": planner}).planner
    assert (found.horizon, found.dt, found.spline, found.iterations) == (60, (0.02,), "zero", 1)


@pytest.mark.parametrize("override", ["planner.horizon=1", "planner.lookahead=0.08"])
def test_a_plan_of_one_step_has_one_knot(override):
    planner = load_scene("pendulum", overrides=[override]).planner
    assert (planner.horizon, planner.knot_count) == (1, None)


def test_a_planner_without_derivatives_has_the_defaults():
    planner = load_scene("pendulum", overrides=["planner.refine=false"]).planner
    assert (planner.refine, planner.iterations, planner.knots, planner.spline) == (None, 2, 5, "cubic")


def test_a_methods_own_settings_go_with_it():
    scene = load_scene("pendulum", overrides=["planner.method=ilqg", "planner.noise.sigma=0.3"])
    noise = with_values(scene, {"planner.method": "mppi"}).planner.noise
    assert (noise.shape, noise.sigma) == ("identity", (0.3,))


def test_a_folder_or_a_pipe_is_told_as_such(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    for place, says in ((tmp_path, "is a folder"), (tmp_path / "pipe.toml", "is no regular file")):
        with pytest.raises(SceneError, match=f"{place}: {says}"):
            load_scene(place)


def test_a_variant_has_no_variants(tmp_path):
    path = write(tmp_path, SMALL + "\n[variants.near.variants.nearer]\nplanner.samples = 5\n")
    with pytest.raises(SceneError, match=r"variants\.near\.variants: a variant cannot contain variants"):
        load_scene(f"{path}:near")


def test_the_frame_of_a_goal_that_is_a_robot_says_what_a_frame_is(tmp_path):
    with pytest.raises(SceneError, match=r"goal\.frame: .*robot/frame.*allowed: base/tip, base/LINK"):
        load_scene(write(tmp_path, SMALL.replace('object = "box"', 'frame = "base"')))
