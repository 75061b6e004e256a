# SPDX-License-Identifier: Apache-2.0
"""The suite's environments: what is seen of their physics, and their models as files to plan with."""

from __future__ import annotations

import logging
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from warpmpc import MujocoStates, State
from warpmpc.scene.model.compiled import CompiledScene, cache_folder
from warpmpc.scene.model.mujoco_model import make_world

if TYPE_CHECKING:
    import dm_env
    from dm_control.rl.control import Environment


def load(domain: str, task: str, *, seed: int) -> Environment:
    """An environment of the suite, as the suite makes it.

    Raises:
        ValueError: If dm-control is not installed, or has no such task.
    """
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn
    logging.getLogger("absl").setLevel(logging.ERROR)  # some models use what MuJoCo calls old
    try:
        from dm_control import suite
    except ImportError:
        raise ValueError('the suite is not installed: pip install "warpmpc[bench]"') from None
    if (domain, task) not in suite.ALL_TASKS:
        raise ValueError(f"the suite has no task '{domain} {task}'")
    return suite.load(domain, task, task_kwargs={"random": seed})


def save_model(domain: str, task: str) -> Path:
    """Write the model that an environment has once an episode has begun to a file; returns its path.

    The suite edits models after it has read them: scaled masses, other dampings, floors of another size. Places and
    sizes of targets are those of one episode; where a target is comes from the physics.
    """
    environment = load(domain, task, seed=0)
    environment.reset()
    model = environment.physics.model.ptr
    folder = cache_folder().parent / "dm_suite"
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as own:
        path = Path(own) / "model.xml"
        mujoco.mj_saveLastXML(str(path), model)
        spec = mujoco.MjSpec.from_file(str(path))
        spec.option.enableflags = 0  # the energy, which is counted for nobody here
        spec.compiler.settotalmass = -1.0
        for body in spec.bodies[1:]:
            own_body = model.body(body.name)
            body.explicitinertial = True
            body.mass, body.ipos, body.iquat = own_body.mass[0], own_body.ipos, own_body.iquat
            body.inertia = own_body.inertia
        path.write_text(spec.to_xml(), encoding="utf-8")
        return path.replace(folder / f"{domain}_{task}.xml")


class Eyes:
    """What a controller may see of an environment: the state of its physics, and where its targets are.

    Args:
        compiled: The scene that is planned in, made of the environment's own model.
        environment: The environment.

    Raises:
        ValueError: If the scene's joints, controls or limits are not the environment's.
    """

    def __init__(self, compiled: CompiledScene, environment: Environment):
        self._physics, layout = environment.physics, compiled.layout
        own = self._physics.model.ptr
        world = make_world(compiled, timestep=own.opt.timestep, sensors=())
        _same("joints", _names(own, own.njnt, own.joint), _names(world.model, world.model.njnt, world.model.joint))
        _same("controls", _names(own, own.nu, own.actuator), [name.split("/")[-1] for name in layout.control_name])
        limits = environment.action_spec()
        _same("limits", np.float32(limits.minimum).tolist(), layout.control_lower.tolist())
        _same("limits", np.float32(limits.maximum).tolist(), layout.control_upper.tolist())
        self._states = MujocoStates(compiled, own)

    def state(self) -> State:
        """The physics state in Newton's conventions."""
        return self._states.read(self._physics.data.ptr)

    def place(self, name: str) -> np.ndarray:
        """Where a target is: the pose (x, y, z, qx, qy, qz, qw) of the site or geom of that name.

        Raises:
            ValueError: If the model has neither.
        """
        model, data = self._physics.model.ptr, self._physics.data
        for kind, positions in ((mujoco.mjtObj.mjOBJ_SITE, data.site_xpos), (mujoco.mjtObj.mjOBJ_GEOM, data.geom_xpos)):
            i = mujoco.mj_name2id(model, kind, name)
            if i >= 0:
                return np.array([*positions[i], 0.0, 0.0, 0.0, 1.0])
        raise ValueError(f"the suite's model has neither a site nor a geom '{name}' for the scene's target")


def step(environment: Environment, action: np.ndarray) -> dm_env.TimeStep:
    """One control step of the environment's own physics, with its own reward."""
    return environment.step(action.astype(np.float64))


def _names(model: mujoco.MjModel, count: int, get) -> list[str]:
    return [get(i).name.split("/")[-1] for i in range(count)]


def _same(what: str, own: list, planned: list) -> None:
    if own != planned:
        raise ValueError(f"the scene's {what} are not the environment's: {planned} instead of {own}")
