# SPDX-License-Identifier: Apache-2.0
"""Worlds that another simulator steps, in a process with its own Python: a script without this project.

python stepping.py mjbatch|envpool    # reads what to load, then a line for each run; answers each in a line of JSON
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version

import numpy as np


class Mjbatch:
    """A model that mjbatch steps from given states.

    Args:
        xml: File of the model, whose numbers are then replaced by those of another file, where both have them.
        arrays: That file: numbers of the model, and ``q``, ``v``, ``u`` of the worlds.
        threads: Threads; 0 for all cores.
        steps: Physics steps of a run.
    """

    def __init__(self, xml: str, arrays: str, threads: int, steps: int):
        import mujoco
        from mjbatch import Batch

        model, given = mujoco.MjModel.from_xml_path(xml), np.load(arrays)
        for name in given.files:
            here = getattr(model.opt, name[4:], None) if name.startswith("opt.") else getattr(model, name, None)
            if name.startswith("opt.") and not isinstance(here, np.ndarray):
                setattr(model.opt, name[4:], given[name].item())
            elif isinstance(here, np.ndarray) and here.shape == given[name].shape:
                here[...] = given[name]
        self.worlds, self._steps = len(given["q"]), steps
        self._batch = Batch(model, num_sims=self.worlds, num_threads=threads)
        bound = {name: self._batch.bind(name) for name in ("state", "qpos", "qvel", "ctrl")}
        bound["qpos"][:], bound["qvel"][:], bound["ctrl"][:] = given["q"], given["v"], given["u"]
        self._state, self._start, self._qpos = bound["state"], bound["state"].copy(), bound["qpos"]

    def run(self) -> dict:
        """Step from the start; where worlds end, as one number to compare."""
        self._state[:] = self._start
        begin = time.perf_counter()
        self._batch.step(nstep=self._steps)
        spent = time.perf_counter() - begin
        return {"seconds": spent, "world_steps": self.worlds * self._steps, "qpos": self._qpos[:8].tolist()}


class Envpool:
    """A task of EnvPool under random actions.

    Args:
        task: Its name.
        each: Physics steps of a control.
        worlds: Environments.
        threads: Threads; 0 for all cores.
        steps: Physics steps of a run.
    """

    def __init__(self, task: str, each: int, worlds: int, threads: int, steps: int):
        import envpool

        self.worlds, self._each, self._count = worlds, each, max(1, steps // each)
        self._env = envpool.make(task, env_type="gymnasium", num_envs=worlds, num_threads=threads)
        self._env.reset()
        space, rng = self._env.action_space, np.random.default_rng(0)
        low, high = np.maximum(space.low, -1.0), np.minimum(space.high, 1.0)
        self._actions = rng.uniform(low, high, (worlds, *space.shape)).astype(space.dtype)

    def run(self) -> dict:
        """Step on from where the worlds are."""
        begin = time.perf_counter()
        for _ in range(self._count):
            self._env.step(self._actions)
        spent = time.perf_counter() - begin
        return {"seconds": spent, "world_steps": self.worlds * self._count * self._each}


def main() -> None:
    """Answer lines."""
    kinds = {"mjbatch": Mjbatch, "envpool": Envpool}
    stepper = None
    for line in sys.stdin:
        told = json.loads(line)
        if told:
            stepper = kinds[sys.argv[1]](**told)
            answer = {"version": version(sys.argv[1]), "worlds": stepper.worlds}
        else:
            answer = stepper.run()
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
