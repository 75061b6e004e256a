# SPDX-License-Identifier: Apache-2.0
"""Signs of failure in how a plant moves: falls and a standstill.

Signs of failure in the samples of plans: how many tumble, whose noise wins, what tells them apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...loop.run.result import Changes, Guess
from ...scene.errors import some
from ...scene.model.layout import rotate
from ...scene.schema import Method

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller
    from ...scene.model.state import Info

TILT, LOWER, LOW = np.radians(60.0), 0.8, 0.5
"""A base has fallen that is tilted by more than this and below this share of its height at the start, or lower than
this share however it lies."""
LYING = 0.5
"""Time from which a base that has fallen counts as staying so [s]."""
STILL, STANDING = 0.02, 1.0
"""Coordinates that move less than this [m or rad] over the last third of a run stand still, if that is long [s]."""
IMPACT = 0.5
"""Time before a fall in which the greatest speed of a base is looked for [s]."""
ALONE, COUNTS = 0.9, 0.05
"""Share of the cost from which a term is nearly all of it, and below which it is not worth its name."""
FREE = 4
"""Newton's type of a free joint."""


class PlantSigns:
    """Counts, over an episode, how a plant moves.

    Args:
        controller: The controller, for the terms of its plans.
        plant: The plant.
    """

    def __init__(self, controller: Controller, plant: Plant):
        self._controller, self._plant, layout = controller, plant, plant.layout
        self.bases = {
            entity.name: int(layout.joint_q_start[joint])
            for entity in layout.entities
            for joint in entity.joints
            if entity.kind == "robot"
            and layout.joint_type[joint] == FREE
            and layout.joint_child[joint] == entity.bodies[0]
        }
        self._start = plant.state.joint_q
        self._fallen: dict[str, float] = {}  # since when a robot's base lies
        self.states: list[np.ndarray] = []
        """Joint coordinates before each control ``[nq]``."""
        self._terms: list[np.ndarray] = []

    def note(self, info: Info) -> None:
        """Keep what the state of the plant and the plan just made show."""
        q = self._plant.state.joint_q
        for name, first in self.bases.items():
            if self.lies(q, first):
                self._fallen.setdefault(name, self._plant.time)
            else:
                self._fallen.pop(name, None)
        self.states.append(q)
        self._terms.append(np.array(list(info.terms.values())))

    def _heights(self, q: np.ndarray, first: int) -> tuple[float, float]:
        """Heights of a base now and at the start, above the ground where there is one [m]."""
        ground = self._plant.scene.ground
        below = ground.height if ground is not None else 0.0
        return float(q[first + 2]) - below, float(self._start[first + 2]) - below

    def _tilt(self, q: np.ndarray, first: int) -> float:
        """Angle between what points up of a base and what did at the start [rad]."""
        turned = np.array([-1.0, -1.0, -1.0, 1.0]) * self._start[first + 3 : first + 7]
        up = rotate(q[first + 3 : first + 7], rotate(turned, np.array([0.0, 0.0, 1.0])))
        return float(np.arccos(np.clip(up[2], -1.0, 1.0)))

    def lies(self, q: np.ndarray, first: int | None = None) -> bool:
        """Return whether the base that begins at a coordinate has fallen in a state ``[nq]``; any base if None."""
        if first is None:
            return any(self.lies(q, first) for first in self.bases.values())
        now, start = self._heights(q, first)
        grounded = self._plant.scene.ground is not None and start > 0.0
        down = now < LOWER * start if grounded else now < start
        return (down and self._tilt(q, first) > TILT) or (grounded and now < LOW * start)

    def _collide(self) -> np.ndarray:
        """Pairs of geoms that touch ``[n, 2]``."""
        model, data = self._plant.model, mujoco.MjData(self._plant.model)
        self._plant.show(data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return data.contact.geom[: data.ncon].copy()

    def _touched(self, robots: Collection[str]) -> list[str]:
        """Names of what robots touch now, but for each other."""
        entities, geoms = self._plant.layout.entities, self._plant.world.geoms
        owner = {geom: entity.name for entity in entities for geom in geoms.get(entity.name, ())}
        pairs = [{owner.get(geom, "ground") for geom in pair} for pair in self._collide().tolist()]
        return sorted(set().union(*(pair for pair in pairs if pair & set(robots))) - set(robots))

    def fallen(self) -> dict[str, float]:
        """Robots whose base has fallen and stayed so, or lies still on its side or back, and since when [s]."""
        now = self._plant.time
        over = self._plant.monitor.failure is not None or self._plant.diverged
        found = {name: when for name, when in self._fallen.items() if over or now - when >= LYING}
        if now - self.rest >= STANDING:
            for name, first in self.bases.items():
                when = self._since(lambda q, first=first: self._tilt(q, first) > TILT)
                if when < now:
                    found.setdefault(name, when)
        return found

    @property
    def rest(self) -> float:
        """Time since when nothing moves [s]."""
        end = self._plant.state.joint_q
        return self._since(lambda q: np.abs(q - end).max(initial=0.0) <= STILL)

    def _since(self, holds: Callable[[np.ndarray], bool]) -> float:
        """Time since when something holds of the state, until the end without a break [s]."""
        states = [*self.states, self._plant.state.joint_q]
        count = next((n for n, q in enumerate(reversed(states)) if not holds(q)), len(states))
        return self._plant.time - max(count - 1, 0) * self._plant.scene.timing.control_dt

    def signs(
        self, *, unmet: bool, cures: Sequence[Guess] = (), larger: Mapping[str, str] | None = None
    ) -> Iterator[Guess]:
        """Guesses, the most telling first.

        Args:
            unmet: Whether something that is wanted is not there.
            cures: What may keep robots from falling.
            larger: Change to larger noise.
        """
        fallen = self.fallen()
        cure = "a term that keeps it up (height, orientation with tilt), or a start that it can hold"
        for name, when in fallen.items():
            yield Guess(self._fall(name, when), cure)
        if fallen:
            yield from cures
        if fallen or not self.states:
            return
        if unmet:
            yield from self._standstill(larger or {})

    def _fall(self, name: str, when: float) -> str:
        """What a fall looked like, and where it ended."""
        q, first, dt = self._plant.state.joint_q, self.bases[name], self._plant.scene.timing.control_dt
        now, start = self._heights(q, first)
        rest, end = self.rest, self._plant.time
        still = end - rest >= STANDING
        places = np.array([row[first : first + 3] for row in (*self.states, q)])
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / dt
        window = slice(max(round((when - IMPACT) / dt), 0), round((rest if still else end) / dt) + 1)
        text = (
            f"{name} fell at {when:.2f} s, at up to {speeds[window].max(initial=0.0):.1f} m/s; it is tilted by "
            f"{np.degrees(self._tilt(q, first)):.0f}° and its base is at {now:.2g} m, from {start:.2g} m at the start"
        )
        if not still:
            return text
        on = self._touched([name])
        return f"{text}, and it lies still since {rest:.2f} s{' on ' * bool(on)}{some(on)}"

    def still(self) -> bool:
        """Return whether nothing moved over the last third of the run, if that is long."""
        return self._plant.time - self.rest >= max(STANDING, self._plant.time / 3.0)

    def _standstill(self, larger: Mapping[str, str]) -> Iterator[Guess]:
        if not self.still():
            return
        rest, end = self.rest, self._plant.time
        costs = np.abs(np.nanmean(self._terms[round(rest / self._plant.scene.timing.control_dt) :], axis=0))
        if not np.isfinite(costs).all() or not costs.sum() > 0.0:
            return
        share = dict(zip(self._controller.costs.labels, costs / costs.sum(), strict=True))
        ranked = [name for name in sorted(share, key=lambda name: -share[name]) if share[name] > COUNTS]
        listed = ", ".join(f"{name} {share[name]:.0%}" for name in ranked)
        robots = [robot.name for robot in self._plant.scene.robot]
        on = [name for name in self._touched(robots) if name != "ground"]
        seen = f"all stands still since {rest:.2f} s, the last {end - rest:.1f} s{', at ' * bool(on)}{some(on)}"
        if share[ranked[0]] > ALONE:
            cure = "raise planner.noise.sigma, look further ahead, or add a term that leads to the goal"
            yield Guess(f"{seen}; {listed} of the cost is left and no sample finds less", cure, larger)
        else:
            cure = "raise the weight of what leads to the goal, or lower the others"
            yield Guess(f"{seen}; costs balance there ({listed})", cure)


OFTEN = 1.0 / 3.0
"""Share from which something is the rule rather than an exception."""
MOSTLY = 0.6
"""Share of the plans whose cheapest sample has the most noise, or of the samples that tumble, for σ to be wrong."""
ONE, ALL = 1.5, 0.9
"""η below which one sample decides, and share of the samples above which all count alike."""
FEW = 32
"""Samples below which they are few for any plan."""
DECIDES = 0.75
"""Share of one term in what tells samples apart from which it, and not the goal, decides."""
WIDE = 4.0
"""Ratio of ``planner.noise.spread`` from which the noise of the cheapest sample tells something."""
LOOKS, LOOKED_AT = 4, 16
"""Ratio of the numbers of the plans whose rollouts are looked at (the 1st, 4th, 16th, ...), and how many of them."""


class SampleSigns:
    """Counts, over an episode, what becomes of the samples of its plans.

    Args:
        controller: The controller.
        plant: The plant.
        of_plant: Signs of the plant, which know what a fall is.
        changes: Changes that guesses try.
    """

    def __init__(self, controller: Controller, plant: Plant, of_plant: PlantSigns, changes: Changes):
        self._controller, self._plant, self._of_plant, self._changes = controller, plant, of_plant, changes
        self._steps = self._lone = self._even = self._far = 0
        self._beta = 0.0
        self._paid = np.zeros(len(controller.costs.labels))
        self._tumbled: list[tuple[float, float]] = []  # time of a look, share of the samples that tumble

    def note(self, info: Info) -> None:
        """Keep what the plan just made shows."""
        shape = self._controller.shape
        self._steps += 1
        self._lone += info.eta < ONE
        self._even += info.eta > ALL * shape.rollouts
        self._beta += info.beta
        self._paid += np.abs(list(info.terms.values()))
        place = (info.best // shape.domains) % shape.samples / (shape.samples - 1)  # noise grows with it
        self._far += not info.fallback and place > 1.0 - OFTEN
        looks = self._controller.envs == 1 and self._of_plant.bases
        if looks and self._steps == LOOKS ** round(np.log(self._steps) / np.log(LOOKS)):
            chosen = np.unique(np.linspace(0, shape.samples - 1, LOOKED_AT).astype(int)) * shape.domains
            ends = self._controller.engine.record(chosen.tolist()).joint_q[-1]
            self._tumbled.append((self._plant.time, float(np.mean([self._of_plant.lies(q) for q in ends]))))

    def of_falls(self) -> Iterator[Guess]:
        """Guesses why a robot fell."""
        yield from self.poor()
        seen = f"no more than {self._tumble():.0%} of the samples tumble within the {self._changes.ahead:.3g} s ahead"
        further = "look further ahead, with more samples", self._changes.further() | self._changes.samples()
        yield Guess(seen * bool(self._tumbled and self._tumble() <= MOSTLY), *further)
        yield Guess("", changes=self._changes.sigma(0.5))

    def _tumble(self) -> float:
        """Share of the samples that tumble, of those that were looked at before a robot fell."""
        until = min(self._of_plant.fallen().values(), default=np.inf)
        return float(np.mean([share for time, share in self._tumbled if time <= until] or [0.0]))

    def poor(self) -> Iterator[Guess]:
        """Guesses that samples are too wild, or too few for the numbers of a plan."""
        tumble, samples, numbers = self._tumble(), self._controller.shape.samples, self._changes.numbers
        if tumble > MOSTLY:
            seen = f"{tumble:.0%} of the samples tumble that were looked at"
            yield Guess(seen, "a smaller planner.noise.sigma", self._changes.sigma(0.5))
        if samples < max(FEW, numbers):
            seen = f"{samples} samples are few for the {numbers} numbers of a plan (controls × knots)"
            yield Guess(seen, "more samples", self._changes.samples())

    def signs(self) -> Iterator[Guess]:
        """Guesses from all plans, the most telling first."""
        shape, changes, steps = self._controller.shape, self._changes, self._steps
        planner = self._controller.scene.planner
        low, high = planner.noise.spread
        if high >= WIDE * low and self._far > MOSTLY * steps:
            seen = f"in {self._far / steps:.0%} of the plans the cheapest sample is of the third with the most noise"
            yield Guess(seen, "a larger planner.noise.sigma", changes.sigma(2.0))
        if planner.method is not Method.MPPI:
            return
        temperature, beta = planner.temperature, self._beta / steps
        key = f"temperature.{'ess' if temperature.ess else 'eta' if temperature.eta else 'initial'}"
        if self._lone > OFTEN * steps and shape.samples > 2:
            yield Guess(
                f"one sample alone decides in {self._lone / steps:.0%} of the plans (η below {ONE}, β {beta:.2g})",
                f"raise {key}, or give more samples",
                changes.samples(),
            )
        if self._even > OFTEN * steps:
            yield Guess(
                f"all samples count alike in {self._even / steps:.0%} of the plans (η above {ALL:.0%} of the samples, "
                f"β {beta:.2g}), so their costs hardly differ",
                f"raise planner.noise.sigma, look further ahead, lower {key}, or add a term that leads to the goal",
                changes.sigma(2.0),
            )

    def _leads(self) -> np.ndarray:
        """Whether each term leads to what is wanted ``[term]``."""
        from .control import names_in  # slow to import

        scene = self._plant.scene
        conditions = [*(scene.success.conditions if scene.success else ()), *(c for p in scene.phase for c in p.until)]
        wanted = {name for c in conditions for name in (c.frame, c.to, c.joint, c.term)} - {None}
        wanted |= {"goal", scene.goal.target} if scene.goal else set()
        labels = self._controller.costs.labels
        return np.array(
            [bool(wanted & (names_in(cost.params) | {name})) for name, cost in zip(labels, scene.cost, strict=True)]
        )

    def _lighter(self, term: int) -> tuple[float, dict[str, str]]:
        """Weight of a term, and the change to a tenth of it."""
        label = self._controller.costs.labels[term]
        weight = float(np.ravel(self._controller.task[label])[0])
        return weight, {f"cost.{label}.weight": f"{0.1 * weight:.3g}"}

    def dear(self) -> Iterator[Guess]:
        """What is merely worth a try: a tenth of a term that costs more over the run than all that lead to the goal."""
        if not self._steps:
            return
        leads = self._leads()
        paid = np.where(leads, 0.0, self._paid)
        if leads.any() and paid.max() > self._paid[leads].sum():
            yield Guess("", changes=self._lighter(int(np.argmax(paid)))[1])

    def outweighed(self) -> Iterator[Guess]:
        """Guess that a term which does not lead to what is wanted decides between samples."""
        from .control import term_costs, told_apart  # slow to import

        controller = self._controller
        if controller.envs > 1 or not self._steps:
            return
        apart = told_apart(term_costs(controller))
        if not apart.any():
            return
        share, term = apart / apart.sum(), int(np.argmax(apart))
        if share[term] > DECIDES and not self._leads()[term]:
            label, (weight, lighter) = controller.costs.labels[term], self._lighter(term)
            yield Guess(
                f"{label} is {share[term]:.0%} of what tells samples apart, and it does not lead to what is wanted",
                f"lower its weight ({weight:g} now)",
                lighter,
            )
