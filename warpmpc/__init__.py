# SPDX-License-Identifier: Apache-2.0
"""Real-time model-predictive control that uses a parallel physics simulator as its model."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from . import registry

if TYPE_CHECKING:
    from .cli.terms import load_terms
    from .controller.controller import Controller
    from .controller.rollout import Rollout
    from .cost.residual import residual_term
    from .cost.term import (
        ArrayCost,
        CostTerm,
        array_cost,
        cost_term,
    )
    from .kernels.terms.view import (
        StepView,
        centre_of_mass,
        centre_of_mass_velocity,
        contact_force,
        control,
        frame_acceleration,
        frame_angular_acceleration,
        frame_angular_velocity,
        frame_pose,
        frame_position,
        frame_rotation,
        frame_velocity,
        joint_position,
        joint_velocity,
        memory,
        memory_before,
        remember,
        sensor,
        step_before,
        step_length,
        step_time,
        task_scalar,
    )
    from .log.run_log import RunLog
    from .model.conversion import MujocoStates, NewtonStates
    from .model.state import Info, State
    from .planner.plan import Plan
    from .plant.monitor import Monitor
    from .plant.plant import Plant
    from .realtime.loop import RealTimeReport, RobotLoop
    from .realtime.planning import PlannerThread
    from .realtime.process import PlannerProcess
    from .record.replay import Replay, replay
    from .record.run_recorder import RunRecorder
    from .record.switch import RecordingSwitch
    from .robots.simulated import simulated_robot
    from .run.batch import run_batch
    from .run.choose_engine import choose_engine
    from .run.episode import run_episode
    from .run.fit_samples import fit_samples
    from .run.result import EpisodeResult
    from .scene.errors import SceneError
    from .scene.load import load_scene, shipped_scenes
    from .scene.schema import Scene
    from .task.ancillary import AncillaryController, ancillary
    from .task.task import Task

__version__ = "0.1.0"

__all__ = [
    "AncillaryController",
    "ArrayCost",
    "Controller",
    "CostTerm",
    "EpisodeResult",
    "Info",
    "Monitor",
    "MujocoStates",
    "NewtonStates",
    "Plan",
    "PlannerProcess",
    "PlannerThread",
    "Plant",
    "RealTimeReport",
    "RecordingSwitch",
    "Replay",
    "RobotLoop",
    "Rollout",
    "RunLog",
    "RunRecorder",
    "Scene",
    "SceneError",
    "State",
    "StepView",
    "Task",
    "ancillary",
    "array_cost",
    "centre_of_mass",
    "centre_of_mass_velocity",
    "choose_engine",
    "contact_force",
    "control",
    "cost_term",
    "fit_samples",
    "frame_acceleration",
    "frame_angular_acceleration",
    "frame_angular_velocity",
    "frame_pose",
    "frame_position",
    "frame_rotation",
    "frame_velocity",
    "joint_position",
    "joint_velocity",
    "load_scene",
    "load_terms",
    "memory",
    "memory_before",
    "remember",
    "replay",
    "residual_term",
    "run_batch",
    "run_episode",
    "sensor",
    "shipped_scenes",
    "simulated_robot",
    "step_before",
    "step_length",
    "step_time",
    "task_scalar",
]

_HOME = {
    "PlannerProcess": "realtime.process",
    "PlannerThread": "realtime.planning",
    "RealTimeReport": "realtime.loop",
    "RobotLoop": "realtime.loop",
    "simulated_robot": "robots.simulated",
    "Controller": "controller.controller",
    "EpisodeResult": "run.episode",
    "RunLog": "log.run_log",
    "RunRecorder": "record.run_recorder",
    "Info": "model.state",
    "Monitor": "plant.monitor",
    "MujocoStates": "model.conversion",
    "NewtonStates": "model.conversion",
    "Plan": "planner.plan",
    "Replay": "record.replay",
    "replay": "record.replay",
    "RecordingSwitch": "record.switch",
    "Plant": "plant.plant",
    "Rollout": "controller.rollout",
    "Scene": "scene.schema",
    "SceneError": "scene.errors",
    "State": "model.state",
    "Task": "task.task",
    "AncillaryController": "task.ancillary",
    "ancillary": "task.ancillary",
    "choose_engine": "run.choose_engine",
    "ArrayCost": "cost.term",
    "CostTerm": "cost.term",
    "array_cost": "cost.term",
    "cost_term": "cost.term",
    "residual_term": "cost.residual",
    "fit_samples": "run.fit_samples",
    "load_scene": "scene.load",
    "load_terms": "cli.terms",
    "run_batch": "run.batch",
    "run_episode": "run.episode",
    "shipped_scenes": "scene.load",
}
"""Module of each public name; names that are not here come from ``kernels.terms.view``."""


registry.ROBOTS.load_shipped = lambda: importlib.import_module(".robots.drivers", __name__).DRIVERS
registry.TERMS.load_shipped = lambda: importlib.import_module(".terms", __name__).TERMS


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: physics and kernels take seconds, and a scene file needs neither."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME.get(name, 'kernels.terms.view')}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
