# SPDX-License-Identifier: Apache-2.0
"""The verdict on an episode that did not succeed: likely reasons, each with what to try."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...loop.run.result import Changes, Guess, Shortfall
from ...scene.errors import some
from ...scene.model.mujoco_model import driven_joint
from .signs import PlantSigns, SampleSigns

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ...loop.plant.monitor import Progress
    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller
    from ...scene.model.state import Info

OFTEN = 1.0 / 3.0
"""Share of the controls from which something is the rule rather than an exception."""
EDGE = 0.01
"""Share of its range within which a control counts as being at the limit."""
SLACK = 1e-6
"""Tolerance of times [s]: they are sums of steps."""
SETTLED = 0.9
"""Share of a run in which the best value came, for one that has stopped getting better."""
PATIENCE = 5.0
"""Multiple of ``timing.timeout`` in which what comes nearer has to arrive for a longer one to be advised."""
BEFORE = 0.5
"""Time over which movements are looked at [s]."""
PART, NAMED = 0.25, 2
"""Share of a movement from which the joint behind it is named, and how many are."""
SETS_OUT = 2.0
"""Ratio of the rates in two thirds of a run from which something counts as setting out: it gets faster still."""


class Symptoms:
    """Counts, over an episode, what tells why it fails.

    Args:
        controller: The controller.
        plant: The plant.
    """

    def __init__(self, controller: Controller, plant: Plant):
        self.controller, self.plant = controller, plant
        self._controls: list[np.ndarray] = []
        self._at_limit = np.zeros(controller.layout.nu)
        self._progress: list[tuple[float, list[float]]] = []  # time, and how far each number is beyond its bound
        self._changes = Changes(controller)
        self._of_plant = PlantSigns(controller, plant)
        self._of_samples = SampleSigns(controller, plant, self._of_plant, self._changes)

    def note(self, info: Info, control: np.ndarray) -> None:
        """Keep what the plan just made and its control ``[nu]`` show."""
        lower, upper = self.controller.limits
        edge = EDGE * (upper - lower)
        self._at_limit += (control <= lower + edge) | (control >= upper - edge)
        self._of_plant.note(info)
        self._of_samples.note(info)
        self._controls.append(np.array(control))
        self._progress.append((self.plant.time, self._excess()))

    def shortfall(self) -> Shortfall:
        """How far the episode came, and guesses why no farther."""
        plant, monitor = self.plant, self.plant.monitor
        unmet = [item for item in monitor.progress if not item.last.holds]
        ended = [*self._of_plant.fallen().values()]
        ended += [plant.time] if monitor.failure is not None or plant.diverged else []
        guesses = [*self._unmet(unmet), *(self._signs(unmet) if self._controls else ())]
        return Shortfall(
            guesses=tuple({f"{guess}{guess.sets}": guess for guess in guesses}.values()),
            nearest={item.best.name: (item.best.value, item.best.excess) for item in unmet},
            phases=len(monitor.phases),
            lasted=min(ended, default=None),
        )

    def _excess(self) -> list[float]:
        return [item.last.excess for item in self.plant.monitor.progress]

    def _unmet(self, unmet: Sequence[Progress]) -> Iterator[Guess]:
        monitor, scene, changes = self.plant.monitor, self.plant.scene, self._changes
        phase = f" of phase {monitor.phases[-1][0]}" if monitor.phases else ""
        for item in unmet:
            yield Guess(f"not met{phase}: {_shortfall(item)}")
        yield from self._saturated()
        if monitor.failure is not None:
            yield _failed_on(self.plant, self._of_plant.states, self._controls, changes.further())
        left = [item.last.name for item in unmet if item.best.holds]
        if left:
            cure = (
                "a term on speeds (joint_velocity, speed), more planner.iterations or samples, or a smaller noise.sigma"
            )
            yield Guess(f"{some(left)} was as wanted and left it again", cure, changes.rounds())
            yield Guess("", changes=changes.sigma(0.5))
        end = self.plant.time - SLACK
        if monitor.failure is not None or end <= 0.0:  # what ended the run is the reason
            return
        away = [item for item in unmet if not item.best.holds]
        beyond = self._beyond() if away else []
        yield from beyond
        if away and not beyond:
            yield from self._far(away, end)
        if monitor.progress and not unmet and scene.success is not None and not self.plant.success:
            longer = {"timing.timeout": f"{scene.timing.timeout + scene.success.hold:g}"}
            seen = f"all that success asks for{phase} is met at the end, but has not held for {scene.success.hold:g} s"
            yield Guess(seen, "lower success.hold, or a longer timing.timeout", longer)

    def _beyond(self) -> list[Guess]:
        """Places that nothing can reach, as ``warpmpc check`` finds them."""
        from ...scene.model.at_start import Subject
        from .joints import travel_findings
        from .places import place_findings  # slow to import

        subject = Subject(self.plant.scene, self.controller.compiled)
        found = [*place_findings(subject)] or [*travel_findings(subject)]
        return [Guess(f"{finding.text} ({finding.key})", finding.cure) for finding in found]

    def _far(self, away: Sequence[Progress], end: float) -> Iterator[Guess]:
        """Numbers that never were as wanted: out of time, too slow, or stuck."""
        changes, planner, timeout = self._changes, self.controller.scene.planner, self.plant.scene.timing.timeout
        still = self._of_plant.still()  # what creeps does not arrive
        stuck = [item for item in away if item.when < SETTLED * end]
        arrivals = [(item.best, self._arrival(item)) for item in away if SETTLED * end <= item.when and not still]
        soon = [(best, time) for best, time in arrivals if time <= PATIENCE * timeout]
        late = [(best, time) for best, time in arrivals if time > PATIENCE * timeout]
        if still or stuck or late:
            yield from self._of_samples.outweighed()
            yield from self._of_samples.poor()
        if stuck:
            ends = "let where plans end count more (planner.terminal), " if changes.ends() else ""
            yield Guess(
                f"{some([item.last.name for item in stuck])} came no nearer after {max(i.when for i in stuck):.2f} s",
                f"look further ahead (planner.lookahead, {changes.ahead:.3g} s now), {ends}then raise "
                f"planner.iterations ({planner.iterations} now)",
                changes.further() | changes.ends(),
            )
        if soon:
            until = max(time for _, time in soon)
            names = some([best.name for best, _ in soon])
            seen = f"{names} was still coming nearer at the end, to arrive at about {until:.2g} s at this rate"
            longer = {"timing.timeout": f"{1.5 * until:.2g}"}
            yield Guess(seen, "a longer timing.timeout, or faster drives", longer)
        for best, time in late:
            more = time - self.plant.time
            seen = f"{best.name} came nearer by only {best.excess / more:.2g} a second, which takes {more:.3g} s more"
            if self._at_limits():
                yield Guess(seen, "faster drives (wider limits of controls)")
            else:
                yield Guess(seen, "a larger weight of what leads there, or look further ahead", changes.further())

    def _arrival(self, item: Progress) -> float:
        """Time at which a number would be within its bound, from how fast it changed lately [s]."""
        monitor, end = self.plant.monitor, self.plant.time
        index, begun = monitor.progress.index(item), monitor.phases[-1][1] if monitor.phases else 0.0
        third = (end - begun) / 3.0
        known = [(t, left[index]) for t, left in self._progress if t >= begun - SLACK and len(left) > index]
        if not known:
            return end
        times, values = np.array([*known, (end, item.last.excess)]).T
        values = np.fmin.accumulate(values)
        left = values[-1]
        one, two = np.interp([end - 2.0 * third, end - third], times, values)
        before, rate = (one - two) / third, (two - left) / third
        gain = (rate - before) / third if rate > SETS_OUT * before else 0.0
        if rate <= 0.0:
            return np.inf
        return end + 2.0 * left / (rate + np.sqrt(rate**2 + 2.0 * gain * left))

    def _saturated(self) -> Iterator[Guess]:
        """Controls at a limit as a rule, before advice to look further ahead, which gives them no more."""
        if stuck := self._at_limits():
            yield Guess(
                f"control {some(stuck)} is at a limit {self._at_limit.max() / len(self._controls):.0%} of the time",
                "wider limits, another sign or unit of the drive, or a term on the control (control, control_rate)",
            )

    def _at_limits(self) -> list[str]:
        """Controls that are at a limit as a rule."""
        often = self._at_limit > OFTEN * len(self._controls)
        return [name for name, at in zip(self.controller.layout.control_name, often, strict=True) if at]

    def _signs(self, unmet: Sequence[Progress]) -> Iterator[Guess]:
        cures = list(self._of_samples.of_falls()) if self._of_plant.fallen() else []
        yield from self._of_plant.signs(unmet=bool(unmet), cures=cures, larger=self._changes.sigma(2.0))
        if not cures:
            yield from self._of_samples.poor()
        yield from self._of_samples.signs()
        yield from self._of_samples.dear()
        for changes in (self._changes.samples(), self._changes.rounds(), self._changes.sigma(0.5)):
            yield Guess("", changes=changes)


def _shortfall(item: Progress) -> str:
    last, best = item.last, item.best
    wanted = f"at {'least' if last.above else 'most'} {last.bound:.4g}"
    return (
        f"{last.name} is {last.value:.4g} at the end, {best.value:.4g} at best (at {item.when:.2f} s), wanted {wanted}"
    )


def _failed_on(
    plant: Plant, states: Sequence[np.ndarray], controls: Sequence[np.ndarray], changes: Mapping[str, str]
) -> Guess:
    """Guess what led to the failure that came.

    Args:
        plant: The plant, in the state in which it failed.
        states: Joint coordinates ``[nq]`` before each control.
        controls: The controls ``[nu]``.
        changes: What may help.
    """
    from .control import names_in  # slow to import

    scene, monitor = plant.scene, plant.monitor
    failure = next(failure for failure in scene.failure if failure.name == monitor.failure)
    seen, cure = f"failure {failure.name} was met at {monitor.failing_since:.2f} s", "a later failure.after"
    if failure.conditions:
        told = _told(plant, states, controls)
        seen += f", with {' and '.join(told)}"
        names = {name for c in failure.conditions for name in (c.frame, c.joint) if name}
        about = [label for label, c in zip(scene.cost_labels, scene.cost, strict=True) if names_in(c.params) & names]
        about += [c.term for c in failure.conditions if c.term and c.term not in about]
        cure = f"raise the weight of {some(about)}, or " if about else ""
        cure += "a term that costs more the nearer it comes (height, posture, joint_limit), and look further ahead"
    return Guess(seen, cure, changes)


def _told(plant: Plant, states: Sequence[np.ndarray], controls: Sequence[np.ndarray]) -> list[str]:
    """Each condition of the failure: its value, its value before, and the joints that made the difference."""
    now, dt, monitor = plant.state, plant.scene.timing.control_dt, plant.monitor
    back = min(max(round(BEFORE / dt), 1), len(states))
    start = states[-back] if back else now.joint_q
    ended = monitor.of_failure(now)
    before = monitor.of_failure(replace(now, joint_q=start))
    share: dict[str, np.ndarray] = {}  # of each joint in the change of each value
    for j, first in enumerate(plant.layout.joint_q_start):
        last = plant.layout.joint_q_start[j + 1] if j + 1 < len(plant.layout.joint_q_start) else plant.layout.nq
        q = now.joint_q.copy()
        q[first:last] = start[first:last]
        if not np.array_equal(q, now.joint_q):
            without = monitor.of_failure(replace(now, joint_q=q))
            name = plant.layout.body_name[plant.layout.joint_child[j]] + _sent(plant, j, controls[-back:])
            share[name] = np.array([one.value - other.value for one, other in zip(ended, without, strict=True)])
    found = []
    for i, (new, old) in enumerate(zip(ended, before, strict=True)):
        value = plant.terms.get(new.name, new.value)
        text = f"{new.name} {value:.3g} ({'above' if new.above else 'below'} {new.bound:g})"
        moved = new.value - old.value
        if moved:
            by = sorted((n for n in share if share[n][i] / moved > PART), key=lambda n: -abs(share[n][i]))[:NAMED]
            text += f", from {old.value:.3g} {back * dt:.2g} s before" + f", moved by {' and '.join(by)}" * bool(by)
        found.append(text)
    return found


def _sent(plant: Plant, joint: int, controls: Sequence[np.ndarray]) -> str:
    """What the controls of a joint's actuators were."""
    layout, world, model = plant.layout, plant.world, plant.model
    dof = int(world.joint_qd[joint])
    if dof < 0 or layout.joint_dof_dim[joint].sum() > 1:  # what floats is driven by way of others
        return ""
    own = [a for a in range(model.nu) if driven_joint(model, a) == model.dof_jntid[dof]]
    sent = np.flatnonzero(np.abs(world.actuator_matrix[own]).sum(axis=0)) if own else ()
    texts = [
        f"{layout.control_name[i]} {np.mean([u[i] for u in controls]):.3g} of {layout.control_lower[i]:g} to "
        f"{layout.control_upper[i]:g}"
        for i in sent
    ]
    return f" (sent {some(texts)})" if texts else " (no control drives it)"
