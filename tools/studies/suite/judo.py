# SPDX-License-Identifier: Apache-2.0
"""judo's own tasks and controller (PyPI ``judo-rai``) with ``warpmpc.physics.rollout`` in place of ``mujoco.rollout``.

    python -m venv there && there/bin/pip install warpmpc && there/bin/pip install --no-deps judo-rai dora-utils \
        omegaconf antlr4-python3-runtime==4.9.3
    there/bin/python tools/study.py judo --seeds 10 --json docs/data/judo.json

One name is changed, ``Rollout`` in ``judo.utils.mj_rollout_backend``. Every plan of a closed loop is made twice from
the same state and random numbers, with either, in turns; then whole episodes are run with each. Tasks whose meshes are
not installed are left out. Success is judo's at the end of an episode; its cartpole has none: there the pole is upright
and the cart in the middle in the last second.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco.rollout
import numpy as np
from rich.console import Console
from rich.table import Table
from shared.files import write_json
from shared.machine import machine

from warpmpc.cli.setup import start_warp
from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.physics import rollout

if TYPE_CHECKING:
    from judo.controller import Controller
    from judo.simulation.mj_simulation import MJSimulation

ROLLOUTS: dict[str, type[mujoco.rollout.Rollout]] = {"mujoco": mujoco.rollout.Rollout, "warpmpc": rollout.Rollout}
TASK_STEPS = 750
"""Steps of an episode, as in judo's ``run_mpc``."""
UPRIGHT, CENTRED, LAST = 0.95, 0.2, 1.0
"""Least cosine of the cartpole's angle, largest distance from the middle [m], for so long at the end [s]."""


class _Timed:
    """A function that adds up the time of its calls.

    Args:
        function: The function.
    """

    def __init__(self, function: Callable):
        self._function, self.seconds = function, 0.0

    def __call__(self, *args: object) -> object:
        begin = time.perf_counter()
        out = self._function(*args)
        self.seconds += time.perf_counter() - begin
        return out


def make_controller(task: str, optimizer: str, name: str) -> Controller:
    """Return judo's controller of a task, whose rollouts are those of MuJoCo or of warpmpc."""
    import judo.utils.mj_rollout_backend as backend
    from judo.controller import make_controller

    backend.Rollout = ROLLOUTS[name]
    return make_controller(task, optimizer)


def start(task: str, seed: int, *controllers: Controller) -> MJSimulation:
    """Return a new simulation, and bring controllers to its start."""
    try:
        import mujoco_extensions.policy_rollout  # noqa: F401
    except ImportError:  # built for the one version of MuJoCo that judo asks for, and of use to its Spot alone
        here = types.ModuleType("mujoco_extensions.policy_rollout")
        here.create_systems_vector = here.threaded_rollout = None
        sys.modules["mujoco_extensions"], sys.modules[here.__name__] = types.ModuleType("mujoco_extensions"), here
    from judo.simulation.mj_simulation import MJSimulation

    np.random.seed(seed)  # noqa: NPY002  judo draws from it
    simulation = MJSimulation(init_task=task)
    simulation.task.reset()
    for controller in controllers:
        controller.reset()
        controller.update_states(simulation.sim_state)
    return simulation


def episode(task: str, optimizer: str, name: str, seed: int, steps: int) -> dict[str, Any]:
    """One episode in the order of judo's ``run_mpc``: whether it succeeds, and judo's reward summed over it."""
    controller = make_controller(task, optimizer, name)
    simulation = start(task, seed, controller)
    controller.update_action()
    each = int(1.0 / controller.controller_cfg.control_freq / simulation.task.dt)
    reward, visited = 0.0, []
    for step in range(steps):
        data = simulation.task.data
        control = controller.compute(data)
        state = np.concatenate([data.qpos, data.qvel])[None, None]
        reward += float(simulation.task.reward(state, data.sensordata[None, None], control[None, None])[0])
        visited.append(data.qpos.copy())
        if step % max(1, each) == 0:
            controller.update_states(simulation.sim_state)
            controller.update_action()
        simulation.step(control)
    if task == "cartpole":
        last = np.array(visited[-max(1, round(LAST / simulation.task.dt)) :])
        success = bool((np.cos(last[:, 1]) > UPRIGHT).all() and (abs(last[:, 0]) < CENTRED).all())
    else:
        success = simulation.task.success(simulation.task.model, simulation.task.data)
    return {"seed": seed, "success": success, "reward": reward}


def plan_times(task: str, optimizer: str, plans: int) -> dict[str, dict[str, float]]:
    """Milliseconds of a plan with either, and of its rollouts, medians over plans from the same states in turns."""
    controllers = {name: make_controller(task, optimizer, name) for name in ROLLOUTS}
    timed = {name: _Timed(c.rollout_backend.rollout) for name, c in controllers.items()}
    for name, controller in controllers.items():
        controller.rollout_backend.rollout = timed[name]
    simulation = start(task, 0, *controllers.values())
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in ROLLOUTS}
    for plan in range(plans + 2):  # kernels are compiled and threads started in the first
        order = list(ROLLOUTS)[:: 1 if plan % 2 else -1]
        draws = np.random.get_state()  # noqa: NPY002
        for name in order:
            np.random.set_state(draws)  # noqa: NPY002
            controllers[name].update_states(simulation.sim_state)
            before, begin, work = timed[name].seconds, time.perf_counter(), time.process_time()
            controllers[name].update_action()
            spent = time.perf_counter() - begin, timed[name].seconds - before, time.process_time() - work
            found[name].append(spent)
        for _ in range(2):
            simulation.step(controllers["mujoco"].compute(simulation.task.data))
    times = {name: 1e3 * np.median(rows[2:], axis=0) for name, rows in found.items()}
    return {
        name: dict(zip(("plan_ms", "rollout_ms", "processor_ms"), map(float, row), strict=True))
        for name, row in times.items()
    }


def loaded(task: str) -> str | None:
    """Why a task does not load, or None."""
    import judo.tasks.base
    from judo.tasks import get_registered_tasks

    judo.tasks.base.download_and_extract_meshes = lambda **_: None  # tasks without meshes need none
    try:
        get_registered_tasks()[task][0]()
    except Exception as error:
        return str(error).strip().splitlines()[0]
    return None


def study(task: str, *, optimizer: str, seeds: int, plans: int, steps: int) -> dict[str, Any]:
    """Plan times and episodes of a task with either."""
    controller = make_controller(task, optimizer, "mujoco")
    times = plan_times(task, optimizer, plans)
    episodes = {name: [episode(task, optimizer, name, seed, steps) for seed in range(seeds)] for name in ROLLOUTS}
    mujoco_ms, own_ms = times["mujoco"], times["warpmpc"]
    return {
        "task": task,
        "optimizer": optimizer,
        "rollouts": int(controller.optimizer_cfg.num_rollouts),
        "steps": int(controller.num_timesteps),
        "lacks": rollout.lacking(controller.model),
        "plans": plans,
        "times": times,
        "ratio": {key: mujoco_ms[key] / own_ms[key] for key in mujoco_ms},
        "task_steps": steps,
        "episodes": episodes,
        "successes": {name: sum(e["success"] for e in rows) for name, rows in episodes.items()},
        "reward": {name: float(np.mean([e["reward"] for e in rows])) for name, rows in episodes.items()},
    }


def main(arguments: list[str]) -> None:
    """Run tasks with either and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="*", help="judo's tasks; all that load by default")
    parser.add_argument("--optimizer", default="cem", choices=("cem", "mppi", "ps"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--plans", type=int, default=200, help="plans that are timed")
    parser.add_argument("--steps", type=int, default=TASK_STEPS, help="steps of an episode")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    try:
        from judo.tasks import get_registered_tasks
    except ImportError as error:
        raise ValueError(f"this Python has no judo: {error} (python tools/study.py judo --help)") from error
    silence_mujoco()
    start_warp()
    before, results, left_out = machine(), [], {}
    table = Table("task", "rollouts", *(f"plan, {n} [ms]" for n in ROLLOUTS), "ratio", "of rollouts", "won", "reward")
    for task in options.task or get_registered_tasks():
        if why := loaded(task):
            left_out[task] = why
            continue
        many = {"seeds": options.seeds, "plans": options.plans, "steps": options.steps}
        r = study(task, optimizer=options.optimizer, **many)
        results.append(r)
        plans = (f"{r['times'][name]['plan_ms']:.2f}" for name in ROLLOUTS)
        won = " / ".join(str(r["successes"][name]) for name in ROLLOUTS)
        reward = " / ".join(f"{r['reward'][name]:.1f}" for name in ROLLOUTS)
        ratios = (f"{r['ratio'][key]:.2f}" for key in ("plan_ms", "rollout_ms"))
        table.add_row(task, f"{r['rollouts']} x {r['steps']}", *plans, *ratios, won, reward)
    console = Console(width=150)
    console.print(table)
    for task, why in left_out.items():
        console.print(f"left out: {task}: {why}", markup=False)
    about = {"judo": importlib.metadata.version("judo-rai"), "requires": _pinned(), "machine": before}
    if options.json:
        write_json(options.json, {**about, "results": results, "left_out": left_out})


def _pinned() -> str:
    """Stand-in for the part of ``mujoco`` that judo uses."""
    return next(r for r in importlib.metadata.requires("judo-rai") or () if r.startswith("mujoco"))
