# SPDX-License-Identifier: Apache-2.0
"""Robot models of Python packages, each in a scene that asks nothing of it."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from shared.packages import LEGGED, robot_data

from warpmpc import Scene

ARMS = (
    "panda_description/urdf/panda.urdf",
    "so_arm_description/urdf/so101.urdf",
    "z1_description/urdf/z1.urdf",
    "ur_description/urdf/ur5_robot.urdf",
    "ur_description/urdf/ur10_joint_limited_robot.urdf",
    "ur_description/urdf/ur3_gripper.urdf",
    "kinova_description/robots/kinova.urdf",
    "xarm_description/urdf/xarm7.urdf",
    "allegro_hand_description/urdf/allegro_right_hand.urdf",
    "talos_data/robots/talos_left_arm.urdf",
    "finger_edu_description/robots/finger_edu.urdf",
    "double_pendulum_description/urdf/double_pendulum.urdf",
    "asr_twodof_description/urdf/TwoDofs.urdf",
    "baxter_description/urdf/baxter.urdf",
    "pr2_description/urdf/pr2.urdf",
    "tiago_description/robots/tiago.urdf",
    "tiago_pro_description/robots/tiago_pro.urdf",
    "alex_description/urdf/alex_nub_hands.urdf",
)
"""Robots of ``example-robot-data`` with a fixed root."""
MJCF = {
    "dm_control": [
        f"suite/{name}.xml"
        for name in (
            "acrobot",
            "ball_in_cup",
            "cartpole",
            "cheetah",
            "finger",
            "hopper",
            "humanoid_CMU",
            "manipulator",
            "pendulum",
            "point_mass",
            "quadruped",
            "reacher",
            "stacker",
            "walker",
        )
    ],
    "gymnasium_robotics": [
        "envs/assets/adroit_hand/adroit_door.xml",
        "envs/assets/adroit_hand/adroit_hammer.xml",
        "envs/assets/adroit_hand/adroit_pen.xml",
        "envs/assets/hand/manipulate_block.xml",
        "envs/assets/hand/reach.xml",
        "envs/assets/point/point.xml",
    ],
    "gymnasium": [
        f"envs/mujoco/assets/{name}.xml"
        for name in (
            "ant",
            "half_cheetah",
            "hopper",
            "humanoid",
            "humanoidstandup",
            "inverted_double_pendulum",
            "inverted_pendulum",
            "pusher_v5",
            "reacher",
            "swimmer",
            "walker2d_v5",
        )
    ],
    "mjlab": [
        "tasks/cartpole/cartpole.xml",
    ],
    "mujoco_playground": ["_src/dm_control_suite/xmls/cheetah.xml"],
    "metaworld": [
        f"assets/sawyer_xyz/sawyer_{name}.xml"
        for name in ("drawer", "door_pull", "push_v3", "reach_v3", "window_horizontal", "hammer")
    ],
    "newton": ["examples/assets/nv_ant.xml", "examples/assets/nv_humanoid.xml"],
}


DRIVEN = (
    ("gymnasium_robotics", "envs/assets/fetch/push.xml"),
    ("mjlab", "asset_zoo/robots/i2rt_yam/xmls/yam.xml"),
    ("mjlab", "asset_zoo/robots/unitree_g1/xmls/g1.xml"),
    ("mjlab", "asset_zoo/robots/unitree_go1/xmls/go1.xml"),
)
"""MJCF files without actuators."""


def package_models() -> dict[str, Scene]:
    """A scene for each model that is installed, by package and file."""
    scenes = {}
    data = robot_data()
    drive = {"mode": "velocity", "damping": 10.0, "limit": 1.0}
    for name in (*ARMS, *LEGGED) if data else ():
        keys = {"floating": True, "position": (0.0, 0.0, LEGGED[name])} if name in LEGGED else {}
        scenes[f"example-robot-data/{name}"] = _scene(data / name, drive=drive, **keys)
    for package, files in MJCF.items():
        spec = find_spec(package)
        for name in files if spec else ():
            scenes[f"{package}/{name}"] = _scene(Path(spec.submodule_search_locations[0]) / name)
    for package, name in DRIVEN:
        if spec := find_spec(package):
            asset = Path(spec.submodule_search_locations[0]) / name
            scenes[f"{package}/{name}"] = _scene(asset, drive={**drive, "effort_limit": 50.0})
    return scenes


def _scene(asset: Path, **robot) -> Scene:
    return Scene.model_validate(
        {
            "timing": {"control_dt": 0.04, "timeout": 1.0},
            "robot": [{"name": "robot", "asset": str(asset), **robot}],
            "cost": [{"term": "joint_velocity"}],
            "planner": {"samples": 16, "horizon": 10},
        }
    )


KNOWN = (
    (
        "outside its range",
        ("panda", "kinova", "allegro", "laikago", "go1.", "go2.", "a1.", "b1.", "hyq", "icub", "hopper"),
    ),
    ("outside its range", ("gymnasium/envs/mujoco/assets/ant", "nv_ant", "sawyer", "fetch")),
    ("to hold the start against gravity", ("baxter", "pr2", "fetch")),
    ("of the speed it is sent", ("pr2", "tiago", "fetch")),
    ("deep in each other", ("humanoidstandup", "sawyer_hammer")),
)
"""True findings: a part of the sentence, and parts of the names of the models of which it is true.

Zero lies outside the ranges of knees and elbows; arms with springs or compensation of gravity need it here, too; the
scenes' drive of gain 10 is too weak for what lifts a torso, and for fingers that mimic each other; two files start with
an overlap.
"""
