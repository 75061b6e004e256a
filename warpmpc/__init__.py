# SPDX-License-Identifier: Apache-2.0
"""Real-time model-predictive control that uses a parallel physics simulator as its model."""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING

if sys.argv[:1] == ["-m"] and sys.path[:1] == [os.getcwd()] != [os.path.dirname(__path__[0])]:
    del sys.path[0]  # python -m warpmpc takes no random.py of the working directory, as the program warpmpc does not

from .scene import registry

if TYPE_CHECKING:
    from .cost.residual import residual_term
    from .cost.term import (
        ArrayCost,
        CostTerm,
        array_cost,
        cost_term,
    )
    from .cost.user_files import load_terms
    from .extras.record.replay import Replay, replay
    from .extras.record.switch import RecordingSwitch
    from .kernels.cost.view import (
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
    from .loop.log.run_log import RunLog
    from .loop.plant.monitor import Monitor
    from .loop.plant.plant import Plant
    from .loop.realtime.loop import RealTimeReport, RobotLoop
    from .loop.realtime.planning import PlannerThread
    from .loop.realtime.process import PlannerProcess
    from .loop.robots.simulated import simulated_robot
    from .loop.run.batch import run_batch
    from .loop.run.episode import run_episode
    from .loop.run.fit_samples import choose_engine, fit_samples
    from .loop.run.result import EpisodeResult
    from .loop.run.run_recorder import RunRecorder
    from .planner.controller.controller import Controller
    from .planner.plan import Plan, Rollout
    from .scene.errors import SceneError
    from .scene.load import load_scene, shipped_scenes
    from .scene.model.conversion import MujocoStates, NewtonStates
    from .scene.model.state import Info, State
    from .scene.schema import Scene
    from .scene.task.task import AncillaryController, Task, ancillary

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
    "PlannerProcess": "loop.realtime.process",
    "PlannerThread": "loop.realtime.planning",
    "RealTimeReport": "loop.realtime.loop",
    "RobotLoop": "loop.realtime.loop",
    "simulated_robot": "loop.robots.simulated",
    "Controller": "planner.controller.controller",
    "EpisodeResult": "loop.run.episode",
    "RunLog": "loop.log.run_log",
    "RunRecorder": "loop.run.run_recorder",
    "Info": "scene.model.state",
    "Monitor": "loop.plant.monitor",
    "MujocoStates": "scene.model.conversion",
    "NewtonStates": "scene.model.conversion",
    "Plan": "planner.plan",
    "Replay": "extras.record.replay",
    "replay": "extras.record.replay",
    "RecordingSwitch": "extras.record.switch",
    "Plant": "loop.plant.plant",
    "Rollout": "planner.plan",
    "Scene": "scene.schema",
    "SceneError": "scene.errors",
    "State": "scene.model.state",
    "Task": "scene.task.task",
    "AncillaryController": "scene.task.task",
    "ancillary": "scene.task.task",
    "choose_engine": "loop.run.fit_samples",
    "ArrayCost": "cost.term",
    "CostTerm": "cost.term",
    "array_cost": "cost.term",
    "cost_term": "cost.term",
    "residual_term": "cost.residual",
    "fit_samples": "loop.run.fit_samples",
    "load_scene": "scene.load",
    "load_terms": "cost.user_files",
    "run_batch": "loop.run.batch",
    "run_episode": "loop.run.episode",
    "shipped_scenes": "scene.load",
}
"""Module of each public name; names that are not here come from ``kernels.cost.view``."""


registry.ROBOTS.load_shipped = lambda: importlib.import_module(".loop.robots.drivers", __name__).DRIVERS
registry.ENGINES.load_registered = lambda: importlib.import_module(".engine.registry", __name__)
registry.STRATEGIES.load_registered = lambda: importlib.import_module(".planner.step", __name__)
registry.TERMS.load_shipped = lambda: importlib.import_module(".cost.terms", __name__).TERMS


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: physics and kernels take seconds, and a scene file needs neither."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME.get(name, 'kernels.cost.view')}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
