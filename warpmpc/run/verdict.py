# SPDX-License-Identifier: Apache-2.0
"""The verdict on an episode that did not succeed: likely reasons, each with what to try."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import some
from ..scene.schema import Method
from .plant_signs import EDGE, OFTEN, PlantSigns

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..controller.controller import Controller
    from ..model.state import Info
    from ..plant.monitor import Progress
    from ..plant.plant import Plant

ENDS = 20.0
"""Factor on the last step that is advised: with it the end counts more than fifteen steps of the way."""
SLACK = 1e-6
"""Tolerance of times [s]: they are sums of steps."""
DIVERGED = 0.1
"""Share of the rollouts that may diverge: what is left finds its way."""
SETTLED = 0.9
"""Share of a run in which the best value came, for one that has stopped getting better."""
ONE, ALL = 1.5, 0.9
"""η below which one sample decides, and share of the samples above which all count alike."""


class Symptoms:
    """Counts, over an episode, what tells why it fails."""

    def __init__(self, controller: Controller, plant: Plant):
        self.controller, self.plant, layout = controller, plant, controller.layout
        self._steps = self._diverged = self._fallbacks = self._lone = self._even = 0
        self._at_limit = np.zeros(layout.nu)
        self._of_plant = PlantSigns(controller, plant)

    def note(self, info: Info, control: np.ndarray) -> None:
        """Keep what the plan just made and its control ``[nu]`` show."""
        lower, upper = self.controller.limits
        edge = EDGE * (upper - lower)
        self._at_limit += (control <= lower + edge) | (control >= upper - edge)
        self._of_plant.note(info, control)
        self._steps += 1
        self._diverged += info.diverged_worlds
        self._fallbacks += info.fallback
        self._lone += info.eta < ONE
        self._even += info.eta > ALL * self.controller.shape.rollouts

    def verdict(self) -> list[str]:
        """Sentences, the most telling first; none where nothing stands out."""
        return [*self._unmet(), *(self._signs() if self._steps else ())]

    def _unmet(self) -> Iterator[str]:
        monitor, scene = self.plant.monitor, self.controller.scene
        phase = f" of phase {monitor.phases[-1][0]}" if monitor.phases else ""
        unmet = [item for item in monitor.progress if not item.last.holds]
        for item in unmet:
            yield f"not met{phase}: {_shortfall(item)}"
        left = [item.last.name for item in unmet if item.best.holds]
        if left:
            yield (
                f"{some(left)} was as wanted and left it again: a term on speeds (joint_velocity, speed), or more "
                "planner.iterations or samples"
            )
        end = self.plant.time - SLACK
        if monitor.failure is not None or end <= 0.0:  # what ended the run is the reason
            return
        away = [item for item in unmet if not item.best.holds]
        stuck = [item for item in away if item.when < SETTLED * end]
        if stuck:
            ahead, planner = float(self.controller.plan_step.grid.t[-1]), scene.planner
            ends = "" if planner.terminal >= ENDS else f"let where plans end count more (planner.terminal = {ENDS:g}), "
            yield (
                f"{some([item.last.name for item in stuck])} came no nearer after {max(i.when for i in stuck):.2f} s: "
                f"look further ahead (planner.lookahead, {ahead:.3g} s now), {ends}then raise planner.iterations "
                f"({planner.iterations} now)"
            )
        nearer = [item.last.name for item in away if end <= item.when]
        if nearer and not self._of_plant.still():  # what creeps does not arrive
            yield f"{some(nearer)} was still coming nearer at the end: a longer timing.timeout, or faster drives"
        if monitor.progress and not unmet and scene.success is not None and not self.plant.success:
            yield (
                f"all that success asks for{phase} is met at the end, but has not held for {scene.success.hold:g} s: "
                "lower success.hold, or a longer timing.timeout"
            )

    def _signs(self) -> Iterator[str]:
        controller, layout = self.controller, self.controller.layout
        unmet = any(not item.last.holds for item in self.plant.monitor.progress)
        yield from self._of_plant.signs(unmet=unmet)
        share = self._at_limit / self._steps
        stuck = [name for name, part in zip(layout.control_name, share, strict=True) if part > OFTEN]
        if stuck:
            yield (
                f"control {some(stuck)} is at a limit {share.max():.0%} of the time: wider limits, another sign or "
                "unit of the drive, or a term on the control (control, control_rate)"
            )
        worlds = self._steps * controller.shape.rollouts
        if self._diverged > DIVERGED * worlds:
            yield (
                f"{self._diverged / worlds:.0%} of the rollouts diverged: a finer physics step (engine.substeps), "
                "lower gains, or real effort limits"
            )
        if self._fallbacks:
            yield f"{self._fallbacks} safe commands were sent because no rollout survived or had a finite cost"
        if controller.scene.planner.method is Method.MPPI:
            yield from self._weights()

    def _steered(self) -> str:
        """Key by which the temperature is found, or that is it."""
        t = self.controller.scene.planner.temperature
        return f"temperature.{'ess' if t.ess else 'eta' if t.eta else 'initial'}"

    def _weights(self) -> Iterator[str]:
        """Weights of MPPI that lie on one sample, or on all alike."""
        if self._lone > OFTEN * self._steps and self.controller.shape.samples > 2:
            yield (
                f"one sample alone decides in {self._lone / self._steps:.0%} of the plans (η below {ONE}): raise "
                f"{self._steered()}, or give more samples"
            )
        if self._even > OFTEN * self._steps:
            yield (
                f"all samples count alike in {self._even / self._steps:.0%} of the plans (η above {ALL:.0%} of the "
                "samples): their costs hardly differ; raise planner.noise.sigma, look further ahead, lower "
                f"{self._steered()}, or add a term that leads to the goal"
            )


def _shortfall(item: Progress) -> str:
    last, best = item.last, item.best
    wanted = f"at {'least' if last.above else 'most'} {last.bound:.4g}"
    return (
        f"{last.name} is {last.value:.4g} at the end, {best.value:.4g} at best (at {item.when:.2f} s), wanted {wanted}"
    )
