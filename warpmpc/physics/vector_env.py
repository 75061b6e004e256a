# SPDX-License-Identifier: Apache-2.0
"""Worlds of a simulator as an environment of gymnasium, with rewards, terminations and observations in Warp."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from .runtime.compiling import compile_kernel
from .runtime.launch import CapturedLaunches, Launcher, capturing, one_thread
from .runtime.thread_pool import ThreadPool
from .simulator import BatchSimulator
from .world_view import KINDS, WorldView

try:
    from gymnasium.error import ClosedEnvironmentError, ResetNeeded
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ImportError('warpmpc.physics.vector_env needs gymnasium: pip install "warpmpc[gymnasium]"') from error

Draw = Callable[[np.random.Generator, np.ndarray], Mapping[str, np.ndarray]]
"""Draws for some worlds, given the generator and their indices ``[n]``: arrays by name, ``[n, ...]`` each."""
SPARE = 64
"""Numbers beyond an observation's size that a function may write before memory is lost: it is told of them instead."""
TRIAL = 1 << 18
"""The same before and behind, in the trial that an environment begins with."""
LEAVE, STEP, BEGIN = (wp.constant(n) for n in range(3))
"""Tasks of the kernel for a world: nothing, evaluate a step, observe the start of an episode."""


@lru_cache(maxsize=64)
def _kernel(observe: wp.Function, rewards: tuple[wp.Function, ...], ends: tuple[wp.Function, ...]) -> wp.Kernel:

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": max(16, len(rewards), len(ends))})
    def evaluate_kernel(
        # inputs
        view: WorldView,
        first: int,  # world of thread 0
        task: wp.array[int],  # [W] LEAVE, STEP or BEGIN
        diverged: wp.array[int],  # [W]
        weight: wp.array[float],  # [terms]
        rest: wp.array[float],  # [nu] controls of an action at rest
        # outputs
        observation: wp.array2d[float],  # [W, n]
        term: wp.array2d[float],  # [W, terms] weighted
        reward: wp.array[float],  # [W]
        terminated: wp.array[int],  # [W]
    ):
        """One thread: observation, reward and termination of one world."""
        s = view
        s.w = first + wp.tid()
        w = s.w
        if task[w] == LEAVE:
            return
        if task[w] == BEGIN:
            for i in range(rest.shape[0]):
                s.controls[w, i] = rest[i]
                s.controls_before[w, i] = rest[i]
        elif diverged[w] != 0:  # its numbers would be no numbers
            for i in range(observation.shape[1]):
                observation[w, i] = 0.0
            for i in range(weight.shape[0]):
                term[w, i] = 0.0
            reward[w] = 0.0
            terminated[w] = 1
            return
        observe(s, observation[w])
        if task[w] == BEGIN:
            return
        total = wp.float32(0.0)
        for i in range(wp.static(len(rewards))):
            value = weight[i] * wp.static(rewards[i])(s)
            term[w, i] = value
            total += value
        reward[w] = total
        ended = wp.int32(0)
        for i in range(wp.static(len(ends))):
            if wp.static(ends[i])(s):
                ended = 1
        terminated[w] = ended
        for i in range(rest.shape[0]):
            s.controls_before[w, i] = s.controls[w, i]

    return evaluate_kernel


class BatchVectorEnv(VectorEnv):
    """Environments of gymnasium that are the worlds of a simulator.

    Functions of Warp say what they are about, each of one world, evaluated in one launch for all worlds; they read it
    by the functions of ``warpmpc.physics.world_view``, such as ``joint_position(s, i)``. A world that diverges
    terminates with reward 0 and an observation of zeros. The same seed gives the same bits, whatever the number of
    threads. One thread at a time uses it: a call while another thread is in one is a ``RuntimeError``.

    Args:
        simulator: Worlds, on a CPU or a GPU.
        observe: ``(s: WorldView, o: wp.array[float])`` that writes an observation ``[n]``.
        size: Number n of what it writes.
        rewards: Functions ``(s: WorldView) -> float`` and the weight of each in the reward.
        terminations: Functions ``(s: WorldView) -> bool``; an episode terminates when one is true.
        start: Draws ``qpos`` and ``qvel`` ``[n, ...]`` of worlds whose episodes begin, given a generator and the
            indices ``[n]`` of these worlds; the model's own if None.
        numbers: Draws arrays of :meth:`BatchSimulator.set_numbers` when :meth:`reset` is called. Worlds keep them
            when they reset themselves, since what follows from numbers takes long.
        actions: Offset and scale ``[nu]`` of controls: actions are in [-1, 1] then, else they are controls in
            MuJoCo's range.
        substeps: Physics steps of a step.
        max_episode_steps: Steps after which an episode is truncated; never if None.
        autoreset_mode: When worlds reset themselves whose episodes are over.

    Raises:
        TypeError: If a function is no ``wp.func``.
        ValueError: If ``observe`` writes beyond its size.
        IndexError: If a function reads a coordinate, body, sensor, pair or control that is not there, here or later.

    Example:
        >>> @wp.func
        ... def fallen(s: WorldView) -> bool:
        ...     return wp.abs(joint_position(s, 1)) > 0.2
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        *,
        observe: wp.Function,
        size: int,
        rewards: Mapping[wp.Function, float],
        terminations: Sequence[wp.Function] = (),
        start: Draw | None = None,
        numbers: Draw | None = None,
        actions: tuple[np.ndarray, np.ndarray] | None = None,
        substeps: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        self._in_use = threading.RLock()
        for function in (observe, *rewards, *terminations):
            if not isinstance(function, wp.Function):
                raise TypeError(f"{getattr(function, '__name__', function)} is no function of Warp: add @wp.func")
        self.simulator, self.num_envs = simulator, simulator.worlds
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self._start, self._numbers = start, numbers
        self._substeps, self._limit = substeps, max_episode_steps or np.inf
        self._set_spaces(size, actions)
        with capturing:  # another thread's recording would take in what is allocated here
            self._set_kernel(observe, rewards, terminations, size)
        self._steps = np.zeros(self.num_envs, dtype=int)
        self._over = np.ones(self.num_envs, dtype=bool)  # until the first reset

    def _set_spaces(self, size: int, actions: tuple[np.ndarray, np.ndarray] | None) -> None:
        m = self.simulator.model
        if actions is None:
            low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, (-np.inf, np.inf)).T
            self._offset, self._scale, rest = 0.0, 1.0, np.clip(0.0, low, high)
        else:
            self._offset, self._scale = (np.broadcast_to(np.asarray(x, np.float32), m.nu) for x in actions)
            low, high, rest = -np.ones(m.nu), np.ones(m.nu), self._offset
        self._rest = np.array(rest, dtype=np.float32)
        self.single_action_space = Box(low.astype(np.float32), high.astype(np.float32))
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _set_kernel(
        self,
        observe: wp.Function,
        rewards: Mapping[wp.Function, float],
        terminations: Sequence[wp.Function],
        size: int,
    ) -> None:
        sim, worlds = self.simulator, self.num_envs
        batch = sim.batch
        device = batch.device
        view = WorldView()
        view.state, view.nq, view.nv = batch.work.initial, sim.model.nq, sim.model.nv
        view.outside = self._outside = wp.zeros(1, dtype=int, device=device)
        view.poses, view.forces = batch.outputs.poses, batch.outputs.force
        view.readings = batch.sensordata.reshape((worlds, sim.model.nsensordata))
        view.controls = batch.work.knots.reshape((worlds, sim.model.nu))
        view.controls_before = wp.zeros_like(view.controls)
        self.reward_names = tuple(function.func.__name__ for function in rewards)
        self._weight = wp.array(list(rewards.values()), dtype=float, device=device)
        self._task, self._terminated = (wp.zeros(worlds, dtype=int, device=device) for _ in range(2))
        self._reward = wp.zeros(worlds, dtype=float, device=device)
        self._terms = wp.zeros((worlds, len(rewards)), dtype=float, device=device)
        self._wide = wp.full((worlds, size + SPARE), np.nan, dtype=float, device=device)
        self._observation = self._wide[:, :size]
        rest = wp.array(self._rest, device=device)
        self._kept = view, rest  # recorded launches do not hold their arrays
        kernel = _kernel(observe, tuple(rewards), tuple(terminations))
        compile_kernel(kernel, device, 256, "the rewards of an environment")
        launch = Launcher(device)
        inputs = [self._task, batch.work.diverged, self._weight, rest]
        outputs = [self._wide, self._terms, self._reward, self._terminated]

        trial = wp.full((3, TRIAL), np.nan, dtype=float, device=device)
        begin = wp.full(worlds, int(BEGIN), dtype=int, device=device)
        launch(kernel, 1, [view, 0, begin, *inputs[1:]], [trial[1:2], *outputs[1:]])
        written = np.flatnonzero(~np.isnan(trial.numpy())) - TRIAL
        if beyond := written[(written < 0) | (written >= size)].tolist():
            raise ValueError(f"observe writes number {beyond[0]}, beyond size={size}")
        self._check()

        def part(first: int, end: int) -> CapturedLaunches:
            return CapturedLaunches(lambda: launch(kernel, end - first, [view, first, *inputs], outputs), device=device)

        parts = 1 if device.is_cuda else max(1, min(batch.threads, worlds // 64))
        self._replays = [part(a, b) for a, b in pairwise(np.linspace(0, worlds, parts + 1).astype(int).tolist())]
        self._pool = ThreadPool(parts, parts) if parts > 1 else None

    def _evaluate(self, mask: np.ndarray, task: int) -> None:
        """Evaluate some worlds ``[W]``; what was written for the others stays."""
        with capturing:
            self._task.assign(np.where(mask, task, LEAVE).astype(np.int32))
        if self._pool is None:
            self._replays[0]()
        else:
            self._pool.run(self._replays)
        self._check()

    def _check(self) -> None:
        """Raise an error if a function read what is not there."""
        if kind := int(self._outside.numpy()[0]):
            self._outside.zero_()
            raise IndexError(f"observe, a reward or a termination reads a {KINDS[kind - 1]} that is out of range")

    @one_thread
    def set_weights(self, **weights: float) -> None:
        """Change weights of rewards by the names of their functions; nothing is compiled.

        Raises:
            ValueError: If there is no such reward.
        """
        values = self._weight.numpy().copy()
        for name, value in weights.items():
            if name not in self.reward_names:
                raise ValueError(f"there is no reward {name}; there is: {', '.join(self.reward_names)}")
            values[[own == name for own in self.reward_names]] = value
        with capturing:
            self._weight.assign(values)

    @one_thread
    def close_extras(self, **options: object) -> None:
        """Refuse to close while another thread steps; nothing works afterwards."""

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environments have been closed: make them anew")

    def reward_terms(self) -> dict[str, np.ndarray]:
        """Share of each reward in the last step ``[W]``, by the name of its function."""
        terms = self._terms.numpy()
        return {name: terms[:, [own == name for own in self.reward_names]].sum(axis=1) for name in self.reward_names}

    @one_thread
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: Seed of all draws from now on; they go on as they were if None.
            options: ``reset_mask`` may say which worlds ``[W]``, as in gymnasium; all if it is left out.

        Returns:
            Observations ``[W, n]`` and an empty dictionary.

        Raises:
            ClosedEnvironmentError: After ``close``.
            ValueError: If the mask has no boolean for each world, or none is true, or the observation is longer than
                its size.
        """
        self._check_open()
        super().reset(seed=seed)
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"reset_mask has {self.num_envs} booleans of which one is true, not {mask!r}")
        if self._numbers is not None:
            self.simulator.set_numbers(mask, **self._numbers(self.np_random, np.flatnonzero(mask)))
        self._begin(mask)
        if not np.isnan(self._wide.numpy()[mask, self._observation.shape[1] :]).all():
            raise ValueError(f"observe writes numbers beyond size={self._observation.shape[1]}")
        return self._observation.numpy().copy(), {}

    def _begin(self, mask: np.ndarray) -> None:
        """Begin episodes of some worlds ``[W]``."""
        drawn = {} if self._start is None else self._start(self.np_random, np.flatnonzero(mask))
        self.simulator.reset(mask, **drawn)
        self._evaluate(mask, BEGIN)
        self._steps[mask], self._over[mask] = 0, False

    @one_thread
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step in every world.

        Args:
            actions: Actions ``[W, nu]``, clipped into their space.

        Returns:
            Observations ``[W, n]``, rewards ``[W]``, terminations ``[W]``, truncations ``[W]``, and a dictionary that
            in the mode ``SAME_STEP`` has ``final_obs`` and ``_final_obs`` of episodes that are over, as in gymnasium.

        Raises:
            ClosedEnvironmentError: After ``close``.
            ResetNeeded: Before the first reset, and in the mode ``DISABLED`` where an episode is over.
            ValueError: If the actions have another shape.
        """
        self._check_open()
        over, info = self._over.copy(), {}
        if over.any() and (self.autoreset_mode != AutoresetMode.NEXT_STEP or (over.all() and not self._steps.any())):
            raise ResetNeeded(f"{over.sum()} of {self.num_envs} worlds need a reset before they step")
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(f"actions have the shape {np.shape(actions)}, not {self.action_space.shape}")
        actions = np.clip(actions, self.action_space.low, self.action_space.high)
        self.simulator.step(self._offset + self._scale * actions, self._substeps)
        self._evaluate(np.ones(self.num_envs, bool), STEP)
        self._steps += 1
        reward = self._reward.numpy().astype(float)
        terminated, truncated = self._terminated.numpy() != 0, self._steps >= self._limit
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            reward[over], terminated[over], truncated[over] = 0.0, False, False
        done = terminated | truncated
        self._over = done.copy()
        begin = over
        if self.autoreset_mode == AutoresetMode.SAME_STEP and done.any():
            begin, final, last = done, np.full(self.num_envs, None, dtype=object), self._observation.numpy()
            for world in np.flatnonzero(done):
                final[world] = last[world].copy()
            info = {"final_obs": final, "_final_obs": done.copy(), "final_info": {}, "_final_info": done.copy()}
        if begin.any():
            self._begin(begin)
        return self._observation.numpy().copy(), reward, terminated, truncated, info
