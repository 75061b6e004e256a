# SPDX-License-Identifier: Apache-2.0
"""Models of robots and tasks that Python packages bring along."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import mujoco

from shared.models import model_of
from warpmpc import Scene
from warpmpc.scene.model.assets import package_dirs

ROBOT_DATA = "example-robot-data"
PACKAGES = (
    "mujoco",
    "mjlab",
    "dm_control",
    "gymnasium_robotics",
    ROBOT_DATA,
    "gymnasium",
    "newton",
    "mujoco_playground",
    "metaworld",
)
"""Packages with files of models: URDF in the robot data, MJCF in the others."""
LEGGED = {
    "laikago_description/urdf/laikago.urdf": 0.5,
    "g1_description/urdf/g1_29dof_rev_1_0.urdf": 0.8,
    "go1_description/urdf/go1.urdf": 0.5,
    "go2_description/urdf/go2.urdf": 0.5,
    "a1_description/urdf/a1.urdf": 0.5,
    "b1_description/urdf/b1.urdf": 0.75,
    "anymal_c_simple_description/urdf/anymal.urdf": 0.75,
    "hyq_description/robots/hyq_no_sensors.urdf": 0.8,
    "solo_description/robots/solo12.urdf": 0.4,
    "bolt_description/robots/bolt.urdf": 0.6,
    "talos_data/robots/talos_reduced.urdf": 1.2,
    "icub_description/robots/icub_reduced.urdf": 0.8,
    "simple_humanoid_description/urdf/simple_humanoid.urdf": 0.65,
    "centauro_description/urdf/centauro.urdf": 1.0,
}
"""Robots of ``example-robot-data`` that walk, and the height of their root [m]; the others' stands still."""
_PART = re.compile(r"<mujocoinclude\b")


def robot_data() -> Path | None:
    """Folder of the robots of ``example-robot-data``; None if it is not installed."""
    return next((d / ROBOT_DATA / "robots" for d in package_dirs() if (d / ROBOT_DATA).is_dir()), None)


def package_files() -> dict[str, Path]:
    """Files of models by package and path: MJCF but for parts that others include, and URDF."""
    found = {}
    for package in PACKAGES:
        folder, suffix = robot_data(), "urdf"
        if package != ROBOT_DATA:
            spec, suffix = find_spec(package), "xml"
            folder = Path(next(iter(spec.submodule_search_locations))) if spec else None
        files = sorted(folder.rglob(f"*.{suffix}")) if folder else []
        found |= {f"{package}/{f.relative_to(folder).as_posix()}": f for f in files}
    return {name: f for name, f in found.items() if not _PART.search(f.read_text(encoding="utf-8", errors="replace"))}


def load_file(name: str) -> mujoco.MjModel:
    """A file's model: MJCF as MuJoCo reads it, URDF as a scene's robot with velocity drives over a floor.

    Args:
        name: One of :func:`package_files`.

    Raises:
        ValueError: If it is no model of its own.
    """
    path = package_files()[name]
    if path.suffix == ".xml":
        return mujoco.MjModel.from_xml_path(str(path))
    robot = {"name": "robot", "asset": str(path), "drive": {"mode": "velocity", "damping": 10.0, "limit": 1.0}}
    if height := LEGGED.get(name.removeprefix(f"{ROBOT_DATA}/")):
        robot |= {"floating": True, "position": (0.0, 0.0, height)}
    return model_of(
        Scene.model_validate(
            {
                "timing": {"control_dt": 0.04, "timeout": 1.0},
                "robot": [robot],
                "cost": [{"term": "joint_velocity"}],
                "planner": {"samples": 16, "horizon": 10},
            }
        )
    )
