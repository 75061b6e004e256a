# SPDX-License-Identifier: Apache-2.0
"""Plans improved by derivatives, behind the samples or alone: gradient descent and iLQG (Howell et al. 2022)."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..engine.protocol import Proposal, TimeGrid
from ..kernels.planner.weights import forget_cost_kernel
from ..physics.runtime.launch import Launcher, assign, unrecorded
from ..scene.errors import SceneError
from ..scene.model.properties import Properties
from ..scene.model.state import PROPOSERS
from ..scene.schema import Method, Refinement
from .derivatives.expansion import Differences, Quadratic, backward, gauss_newton, held
from .derivatives.residuals import Residuals
from .derivatives.rollouts import Policy, PolicyRollouts
from .feedback import Feedback, StateSpace
from .splines import spline_value

if TYPE_CHECKING:
    from typing import Any

    from ..engine.protocol import Engine, EngineRequest, PhysicsSteps
    from ..scene.schema import Scene
    from .derivatives.expansion import Backward, Linear
    from .strategy import SamplingStrategy

logger = logging.getLogger("warpmpc")

LEAST_SHARE = 1e-3
"""Smallest step of a line search, as a share of the whole one: what needs smaller ones is left to the next plan."""
DAMPING = (1e-6, 1e-3, 1e6)
"""Least, first and largest damping μ of ∂²Q/∂u², per squared half range of the controls."""
DRAWS = 4
"""Worlds that a candidate is tried in where properties are drawn or there is noise: the nominal one, without noise, and
the first draws. With the nominal one alone, pushes of what weighs or slides otherwise took up to a fifth longer than
with the samples' plan."""
FACTOR = 10.0
"""By which the damping grows when a step does not help, and shrinks when it does."""


def some_draws(properties: Properties, candidates: int, draws: int) -> Properties:
    """Properties of the worlds that candidates are tried in: each in the nominal one first, then in the first draws."""

    def of_worlds(values: np.ndarray, nominal: float) -> np.ndarray:
        first = np.full_like(values[:1], nominal)
        drawn = values[np.arange(draws - 1) % len(values)]
        return np.tile(np.concatenate([first, drawn]), (candidates, *[1] * (values.ndim - 1)))

    mass, friction = (of_worlds(x, 1.0) for x in (properties.mass, properties.friction))
    return Properties(properties.names, mass, friction, of_worlds(properties.size, 0.0))


class Refiner(ABC):
    """Improves a strategy's mean by derivatives along its rollout.

    Args:
        steps: Physics steps of the horizon.

    Raises:
        SceneError: If the engine, the time grid or a cost term does not allow it.
    """

    feedback: Feedback | None = None
    """Gains of the last plan, if there are any, over the time since its start."""
    policies = 1
    """Policies that are rolled out at once, at most."""
    noisy = False
    """Whether candidates are tried under noise."""

    def __init__(self, engine: Engine, request: EngineRequest, steps: PhysicsSteps, strategy: SamplingStrategy):
        scene, layout = request.scene, request.costs.layout
        self._planner = planner = scene.planner
        if not request.grid.even:
            raise SceneError(
                "planners with derivatives take steps of one length: give one number", key="planner.dt", file=scene.path
            )
        self._request, self._engine, self._strategy = request, engine, strategy
        self.layout, self.horizon = layout, request.grid.steps
        self._settings = planner.refine
        self._launch = Launcher(request.device)
        self.residuals = Residuals(request.costs)
        whole = refined(scene) is not Refinement.GRADIENT
        self.hold = control_hold(scene.timing.control_dt, request.grid) if whole else 1
        count, drawn = self._settings.candidates, request.properties
        nominal = tried = replace(request, properties=None)
        draws = DRAWS if self.noisy or (drawn is not None and drawn.names) else 1
        if drawn is not None and drawn.names:
            tried = replace(request, properties=some_draws(drawn, count, draws))
        sizes = {"policies": self.policies, "draws": draws, "hold": self.hold}
        self.rollouts = PolicyRollouts(engine, tried, steps, self.residuals, count, **sizes)
        self.tangent = self.rollouts.tangent
        self.differences = Differences(engine, nominal, steps, self.residuals, self.tangent)
        self._lower, self._upper = layout.control_lower.astype(float), layout.control_upper.astype(float)
        half = 0.5 * (self._upper - self._lower)
        self._scale = np.where(np.isfinite(half), half, 1.0)
        self._failed = False
        self._forget()
        self._knots, self._alone = np.zeros(strategy.knots.shape, dtype=np.float32), self._held(1)

    def _held(self, samples: int) -> Proposal:
        """Proposal of the first samples, whose knots are there already."""
        return Proposal(self._strategy.knots, self._strategy.offset, samples)

    def _forget(self) -> None:
        envs = self._request.shape.envs
        self._proposers, self._lowered = [PROPOSERS[0]] * envs, np.zeros(envs)

    def told(self, e: int) -> dict[str, Any]:
        """Proposer of an environment's plan, and the share by which derivatives lowered its predicted cost."""
        return {"proposer": self._proposers[e], "lowered": float(self._lowered[e])}

    def __call__(self) -> None:
        """Improve the plan for the observed state; where that fails it stays as it was, and why is logged."""
        state, rollouts = self._request.state, self.rollouts
        self._lower, self._upper = (limit.numpy().astype(float) for limit in self._request.limits)
        for user in (rollouts, self.differences):
            user.set_limits(self._lower, self._upper)
        start, before = rollouts.worlds.observed(), state.last_control.numpy().astype(float)
        self._forget()
        try:
            self._improve(start, before)
        except FloatingPointError as error:
            self.reset()
            if not self._failed:  # once until they work again
                level = logging.DEBUG if self._settings.method is Refinement.AUTO else logging.WARNING  # if asked for
                what = "t = %.2f s: no derivatives: %s; the plan stays as it was"
                logger.log(level, what, state.start.numpy()[0], error)
            self._failed = True
        else:
            self._failed = False
        self._conclude()

    @property
    def summary(self) -> str:
        """A sentence about what derivatives are taken of."""
        worlds = self.differences.worlds.shape.worlds
        out = f"differences of {self.residuals.width} residuals in {worlds} worlds of one control"
        rough = self.residuals.without
        return out + (f"; no residual, hence a rough Hessian: {', '.join(rough)}" if rough else "")

    @abstractmethod
    def _improve(self, start: np.ndarray, before: np.ndarray) -> None:
        """Improve the mean.

        Args:
            start: Observed states ``[E, nx]``.
            before: Controls that act now ``[E, nu]``.
        """

    def _expand(self, state: np.ndarray, control: np.ndarray, before: np.ndarray) -> tuple[Linear, Quadratic]:
        """Derivatives along rollouts ``[E, T, nx]`` under controls ``[E, T, nu]``."""
        linear = self.differences(state, control, before)
        return linear, gauss_newton(linear, self.residuals, self._request.weights, self._planner.stage_risk)

    def _nominal(self, control: np.ndarray) -> Policy:
        """A policy that sends controls ``[E, T, nu]`` whatever the state."""
        envs, steps, nu = control.shape
        n, nx = self.tangent.size, self.tangent.width
        gain = np.zeros((envs, steps, nu, n))
        return Policy(np.ones((envs, steps, nx)), control, np.zeros_like(control), gain)

    def _conclude(self) -> None:
        """Let the engine have rolled out, evaluated and recorded the plan, as the only sample."""
        strategy, cost = self._strategy, self._engine.cost
        self._knots[:, 0] = strategy.mean.numpy()
        assign(strategy.knots, self._knots)
        self._engine.evaluate(self._alone)
        if cost.shape[1] > 1:
            self._launch(forget_cost_kernel, (cost.shape[0], cost.shape[1] - 1), [1], [cost])
        assign(strategy.eta, np.ones(len(strategy.eta)))

    def reset(self) -> None:
        """Forget earlier plans."""
        self.feedback = self._control = None

    def close(self) -> None:
        """Stop the threads."""
        self.rollouts.close()
        self.differences.close()


def refined(scene: Scene) -> Refinement | None:
    """Method of a scene's refinement, None without."""
    return scene.planner.refine and scene.planner.refine.method


def control_hold(control_dt: float, grid: TimeGrid) -> int:
    """Steps of a time grid that a control is sent for, at least one.

    Args:
        control_dt: Length of a control [s].
        grid: The time grid.
    """
    return max(round(control_dt / float(grid.dt[0])), 1)


def shares(candidates: int) -> np.ndarray:
    """Step sizes α of a line search ``[N]``: none, and from the whole step down."""
    return np.concatenate([[0.0], np.geomspace(1.0, LEAST_SHARE, candidates - 1)])


class GradientRefiner(Refiner):
    """Steepest descent on the knots, θ ← θ - α ∂J/∂θ, by the adjoint recursion (Howell et al. 2022, Eq. 12 to 14).

    The direction is in units of each control's half range, its longest step is :data:`LONGEST` of it.
    """

    LONGEST = 0.5
    """Largest change of a knot that a line search tries, as a share of the control's half range: it reaches every point
    of the range in two plans, whatever the units of the cost."""

    def __init__(self, *args: object):
        super().__init__(*args)
        planner, strategy, request = self._planner, self._strategy, self._request
        count = self._settings.candidates
        if count > strategy.knots.shape[1]:
            what = f"the line search tries {count} candidates as samples, and there are fewer of these"
            raise SceneError(what, key="planner.samples", file=request.scene.path, found=planner.samples)
        self._candidates = self._held(count)
        self._shares = shares(count)

    def _improve(self, start: np.ndarray, before: np.ndarray) -> None:
        strategy, rows = self._strategy, np.arange(len(start))
        for _ in range(self._settings.iterations):
            mean, blend = strategy.mean.numpy().astype(float), self._blend()
            control = np.clip(np.einsum("etp,epu->etu", blend, mean), self._lower, self._upper)
            outcome = self.rollouts(start, before, [self._nominal(control)], np.zeros_like(self._shares), 0.0)
            state = outcome.state[:, 0, :-1]
            if not np.isfinite(outcome.state).all():
                raise FloatingPointError("the physics of the plan's own rollout failed")
            gradient = self._gradient(*self._expand(state, outcome.control[:, 0], before))
            step = -np.einsum("etp,etu->epu", blend, gradient) * self._scale**2
            longest = np.max(np.abs(step) / self._scale, axis=(1, 2), keepdims=True)
            step *= self.LONGEST / np.maximum(longest, 1e-30)
            tried = mean[:, None] + self._shares[:, None, None] * step[:, None]
            tried = np.clip(tried, self._lower, self._upper)
            self._knots[:, : len(self._shares)] = tried
            assign(strategy.knots, self._knots)
            self._engine.evaluate(self._candidates)
            cost = self._engine.cost.numpy()[:, : len(self._shares)]
            best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=1)
            known = np.isfinite(cost[:, 0]) & (cost[:, 0] > 0.0)
            left = np.where(known, cost[rows, best], 1.0) / np.where(known, cost[:, 0], 1.0)
            self._lowered = 1.0 - (1.0 - self._lowered) * left
            assign(strategy.mean, self._knots[rows, best])

    def _blend(self) -> np.ndarray:
        """Share of each knot in a step's control ``[E, T, P]``."""
        times, grid = self._request.spline.time.numpy().astype(float), self._request.grid.t[:-1]
        kind, unit = self._planner.spline, np.eye(len(times))
        offsets = self._strategy.offset.numpy()
        return np.stack([[spline_value(kind, times, unit, float(t + offset)) for t in grid] for offset in offsets])

    @staticmethod
    def _gradient(linear: Linear, cost: Quadratic) -> np.ndarray:
        """∂J/∂u ``[E, T, nu]`` by λ_t = ∂c/∂x + (∂x'/∂x)ᵀ λ_{t+1}."""
        out, adjoint = np.empty_like(cost.u), np.zeros_like(cost.x[:, 0])
        for t in reversed(range(out.shape[1])):
            out[:, t] = cost.u[:, t] + np.einsum("enu,en->eu", linear.b[:, t], adjoint)
            adjoint = cost.x[:, t] + np.einsum("enm,en->em", linear.a[:, t], adjoint)
        return out


class IlqgRefiner(Refiner):
    """iLQG on all controls, with limits and feedback gains."""

    policies = 3

    def __init__(self, *args: object):
        super().__init__(*args)
        self._check_knots()
        self._shares, self._noise = shares(self._settings.candidates), 0.0
        self._damping = np.full(self._request.shape.envs, DAMPING[1])
        self._space = StateSpace(self.tangent, self.rollouts.worlds.rows)
        self._control = None

    def _check_knots(self) -> None:
        if self._strategy.mean.shape[1] != -(-self._request.grid.steps // self.hold):
            raise SceneError(
                'iLQG solves for every control: planner.knots = "steps"',
                key="planner.knots",
                file=self._request.scene.path,
                found=self._planner.knots,
            )

    def reset(self) -> None:
        """Forget earlier plans."""
        super().reset()
        self._damping[:] = DAMPING[1]

    def _improve(self, start: np.ndarray, before: np.ndarray) -> None:
        hold, steps = self.hold, self._request.grid.steps
        starts = self._starts()
        state, control, cost, gains = self._follow(start, before, starts)
        rows, first, lost = np.arange(len(start)), cost, ~np.isfinite(cost)
        if lost.all():
            raise FloatingPointError("the physics of the plan's own rollout failed")
        for array in (state, control, gains):  # about these an environment that is lost is solved for, in vain
            array[lost] = array[np.argmin(lost)]
        for _ in range(self._settings.iterations):
            solved = self._solve(*held(*self._expand(state[:, :-1], control, before), hold), control[:, ::hold])
            change, gain = (x.repeat(hold, axis=1)[:, :steps] for x in (solved.change, solved.gain))
            policy = Policy(state[:, :-1], control, change, gain)
            outcome = self.rollouts(start, before, [policy], self._shares, noise=self._noise)
            best = np.argmin(outcome.cost, axis=1)
            found = outcome.cost[rows, best]
            up = np.where(found < cost, 1.0 / FACTOR, FACTOR)
            self._damping = np.clip(self._damping * up, DAMPING[0], DAMPING[2])
            helps = (found <= cost)[:, None, None]
            state = np.where(helps, outcome.state[rows, best], state)
            control = np.where(helps, outcome.control[rows, best], control)
            gains = np.where(helps[..., None], solved.gain, gains)
            cost = np.minimum(found, cost)
        self._lowered = np.where(lost, 0.0, 1.0 - cost / np.where(lost | (first <= 0.0), 1.0, first))
        control[lost], gains[lost] = starts[0][lost], 0.0
        self._take(control[:, ::hold])
        times = np.tile(self._request.grid.t[:-1:hold], (len(start), 1))
        self.feedback = Feedback(times, state[:, :-1:hold], gains, self._space)
        self._control = control[:, ::hold]

    @unrecorded
    def _starts(self) -> list[np.ndarray]:
        """Controls ``[E, T, nu]`` that are tried first."""
        control = np.clip(self._strategy.mean.numpy().astype(float), self._lower, self._upper)
        return [control.repeat(self.hold, axis=1)[:, : self._request.grid.steps]]

    @unrecorded
    def _take(self, control: np.ndarray) -> None:
        """Let the plan be controls ``[E, T/hold, nu]``."""
        self._strategy.mean.assign(control.astype(np.float32))
        self._strategy.offset.zero_()

    def _follow(self, start: np.ndarray, before: np.ndarray, controls: list[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Roll controls out with and without the last plan's feedback, behind samples the last plan with it, too.

        What is unstable follows no controls for long without feedback: samples would replace a plan that holds it.

        Returns:
            States ``[E, T+1, nx]``, controls ``[E, T, nu]``, cost ``[E]`` and gains ``[E, T/hold, nu, n]`` of the
            cheapest.
        """
        policies = [self._nominal(control) for control in controls]
        names = PROPOSERS[:2] if self._planner.method is not Method.ILQG else PROPOSERS[2:]
        if self.feedback is not None:
            times = self._request.state.elapsed.numpy().astype(float)[:, None] + self._request.grid.t[:-1]
            policies = [self.feedback.policy(times, control) for control in controls]
            if self._planner.method is not Method.ILQG:
                policies.append(self.feedback.policy(times, self.feedback.planned(times, self._control)))
                names = (*names[: len(controls)], PROPOSERS[2])
        each = np.arange(self._settings.candidates) // 2
        followed = np.where(each < len(policies), each, 0)
        feedback = np.arange(len(each)) % 2.0
        outcome = self.rollouts(start, before, policies, np.zeros(len(each)), feedback, followed, self._noise)
        rows, best = np.arange(len(start)), np.argmin(outcome.cost, axis=1)
        gain = np.stack([policy.gain for policy in policies], axis=1)[rows, followed[best], :: self.hold]
        gain = gain * feedback[best][:, None, None, None]
        self._proposers = [names[i] for i in followed[best]]
        return outcome.state[rows, best], outcome.control[rows, best], outcome.cost[rows, best], gain

    def _solve(self, linear: Linear, cost: Quadratic, control: np.ndarray) -> Backward:
        """The backward pass of every environment, with as much damping as it needs."""
        room = self._lower - control, self._upper - control
        while (solved := backward(linear, cost, room, self._scale, self._damping)).failed.any():
            if (self._damping[solved.failed] >= DAMPING[2]).any():
                raise FloatingPointError("the quadratic model of the cost has no minimum, with any damping")
            more = np.minimum(self._damping * FACTOR, DAMPING[2])
            self._damping = np.where(solved.failed, more, self._damping)
        return solved
