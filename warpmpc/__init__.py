# SPDX-License-Identifier: Apache-2.0
"""Real-time model-predictive control that uses a parallel physics simulator as its model."""

from .controller import Controller
from .cost.term import ArrayCost, CostTerm, array_cost, cost_term
from .kernels.costs import (
    StepView,
    contact_force,
    control,
    frame_pose,
    frame_position,
    frame_rotation,
    frame_velocity,
    joint_position,
    joint_velocity,
)
from .plant import Plant
from .scene.errors import SceneError
from .scene.load import load_scene, shipped_scenes
from .scene.schema import Scene
from .state import Info, State

__version__ = "0.1.0"

__all__ = [
    "ArrayCost",
    "Controller",
    "CostTerm",
    "Info",
    "Plant",
    "Scene",
    "SceneError",
    "State",
    "StepView",
    "array_cost",
    "contact_force",
    "control",
    "cost_term",
    "frame_pose",
    "frame_position",
    "frame_rotation",
    "frame_velocity",
    "joint_position",
    "joint_velocity",
    "load_scene",
    "shipped_scenes",
]
