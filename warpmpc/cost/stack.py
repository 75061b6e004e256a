# SPDX-License-Identifier: Apache-2.0
"""All cost terms of a scene, bound once, and evaluators that apply them to the rollouts of an engine.

Factors by which cost terms become the cost of a rollout: weight, terminal factor and discount, as data.

J = Σ_t γ_t ρ(Σ_i τ_it w_i n_i; R) with ρ the risk of ``planner.stage_risk``. τ is zero where a term does not count:
terminal terms take the place of the last stage's cost (Bhardwaj et al. 2021, Eq. 2). Kernels, the source of launches
and derivatives all read the same arrays.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.cost.view import StepView
from ..kernels.geometry.kinematics import forward_kinematics_kernel
from ..kernels.planner.costs import CostWeights, weigh_values_kernel
from ..physics.runtime.launch import Launcher, unrecorded
from ..scene.errors import Mistakes, SceneError
from ..scene.model.joints import joint_table
from ..scene.registry import TERMS
from ..scene.schema import When
from .binding import Binding
from .kernel import EvaluationCode, evaluation_code
from .term import ArrayCost, CostTerm, UserTerm
from .user_files import complaint, raised

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from ..scene.model.trajectory import BatchSize, Trajectory
    from ..scene.schema import Cost, Scene
    from ..scene.task.observed import ObservedState
    from ..scene.task.task import Task


def term_factors(costs: Sequence[Cost]) -> np.ndarray:
    """Factors on what terms cost before the last step of a horizon, and at it ``[term, 2]``."""
    ends = [cost.when is When.TERMINAL for cost in costs]
    replaced = any(end and cost.weight for end, cost in zip(ends, costs, strict=True))
    counted = [(not end, end or not replaced) for end in ends]
    return np.array([(a, b * cost.terminal) for cost, (a, b) in zip(costs, counted, strict=True)]).reshape(-1, 2)


@unrecorded
def cost_weights(weight: wp.array, factors: np.ndarray, discount: np.ndarray) -> CostWeights:
    """Factors of terms at every step, on the device of their weights.

    Args:
        weight: Weights ``[E, term]``; the array itself is read, since the task may change them between plans.
        factors: Factors of :func:`term_factors` ``[term, 2]``.
        discount: γ_t ``[T]``.
    """
    each = np.tile(factors[:, 0], (len(discount), 1))
    each[-1] = factors[:, 1]
    out = CostWeights()
    out.term = weight
    out.terminal = wp.array(each, dtype=float, device=weight.device)
    out.discount = wp.array(discount, dtype=float, device=weight.device)
    return out


def stage_weights(weights: CostWeights) -> np.ndarray:
    """Factor τ_it w_i on what each term costs at each step ``[E, T, term]``."""
    return weights.term.numpy()[:, None].astype(float) * weights.terminal.numpy()


class CostStack:
    """The cost terms of a scene, bound to its layout, with the resources that they share.

    Args:
        scene: The scene.
        layout: Its layout, targets included.
        task: What resources follow besides the observed state, for E environments.
        terms: Users' own terms, next to the built-in ones.
        device: Warp device of the rollouts.
        costs: Entries of the scene's ``cost`` list, all of them if None.

    Raises:
        SceneError: If a term, one of its keys, or a frame or entity they name does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        *,
        terms: Sequence[UserTerm] = (),
        device: str = "cpu",
        costs: Sequence[Cost] | None = None,
    ):
        costs = scene.cost if costs is None else costs
        self.layout, self.device, self.task, self.file = layout, device, task, scene.path
        known = ChainMap(_users(terms, scene), TERMS)
        self.labels = scene.cost_labels if costs is scene.cost else [cost.label for cost in costs]
        self.terms: list[tuple[CostTerm | ArrayCost, Any]] = []
        """Each term with its parameters."""
        binding = Binding(scene, layout, device=device)
        mistakes = Mistakes()
        for label, cost in zip(self.labels, costs, strict=True):
            binding.key = f"cost.{cost.label}"
            binding.label = label
            with mistakes.of_part():
                if cost.term not in known:
                    raise SceneError(
                        "no such cost term (your own ones come with --terms FILE.py)",
                        key=f"{binding.key}.term",
                        file=scene.path,
                        found=cost.term,
                        allowed={name: getattr(term, "summary", None) for name, term in known.items()},
                    )
                term = known[cost.term]
                self.terms.append((term, term.bind(cost.params, binding)))
        mistakes.raise_all()
        self.factors = term_factors(costs)
        """Factors on what each term costs before the last step and at it ``[term, 2]``."""
        self.pairs = tuple(binding.pairs)
        self.sensors = tuple(dict.fromkeys(binding.sensors))
        self.resources, self._kept = binding.resources, binding.kept
        self._launch = Launcher(device)
        self._table = joint_table(layout, device)
        for resource in self.resources:
            resource.allocate(task.envs, device)
        self.code, self.params = self.code_of(
            [i for i, (term, _) in enumerate(self.terms) if isinstance(term, CostTerm)]
        )
        """Code of all terms that are kernels, and their parameters."""
        self.memory = sum(binding.memory.values())
        """Numbers that terms carry along every rollout."""
        task.on_change(self._on_task_change)
        self._on_task_change(frozenset(task))
        self.users = [i for i, (term, _) in enumerate(self.terms) if term.name not in TERMS.shipped]
        """Terms that users wrote."""

    def code_of(self, numbers: Collection[int]) -> tuple[EvaluationCode, Any]:
        """Code of some terms that are kernels, and their parameters as it takes them; nothing is compiled.

        Args:
            numbers: Which terms.
        """
        code = evaluation_code([(i, self.terms[i][0]) for i in numbers])
        params = code.params()
        for i in numbers:
            setattr(params, f"p{i}", self.terms[i][1])
        return code, params

    def _on_task_change(self, names: frozenset[str]) -> None:
        for resource in self.resources:
            resource.on_task_change(self.task, names)

    @property
    def capturable(self) -> bool:
        """True where every term is a kernel, so that a CUDA graph can hold them all."""
        return not any(isinstance(term, ArrayCost) for term, _ in self.terms)

    def reset(self) -> None:
        """Forget earlier plans; waits for whatever is prepared beside them, so that every run begins alike."""
        for resource in self.resources:
            resource.reset()
            resource.settle()

    def refresh(self) -> None:
        """Hand what was prepared beside the last plan over to the device; on the host, before a plan."""
        for resource in self.resources:
            resource.refresh()

    def before_plan(self, state: ObservedState) -> None:
        """Bring the resources up to date with the observed state; capture-safe."""
        resources = list(self.resources)
        if not resources:
            return
        self.kinematics(*state.as_slice)
        for resource in resources:
            resource.before_plan(state)

    def kinematics(self, q: wp.array, qd: wp.array, body_q: wp.array, body_qd: wp.array) -> None:
        """Write poses and twists of the bodies ``[T, W, nb]`` from joint coordinates and velocities; capture-safe."""
        self._launch(forward_kinematics_kernel, body_q.shape[:2], [self._table, q, qd], [body_q, body_qd])


def _users(terms: Sequence[UserTerm], scene: Scene) -> dict[str, CostTerm | ArrayCost]:
    """Users' cost terms by name."""
    terms = [term for term in terms if isinstance(term, CostTerm | ArrayCost)]
    for term in terms:
        if TERMS.shipped.get(term.name, term) is not term:
            what = "there is a built-in cost term of this name: choose another"
            raise complaint(term.name, term, what, file=scene.path)
    return {term.name: term for term in terms}


class CostEvaluator:
    """Evaluates the terms of a stack over the recorded rollouts of one engine.

    Args:
        stack: The terms.
        trajectory: Recorded rollouts.
        control: Controls ``[T, W, nu]``.
        state: What the rollouts started from.
        shape: Sizes of the batch.
        step_end: Time of each slice of the trajectory after the observed state ``[T+1]`` [s].
    """

    cost: wp.array3d[float]
    """Weighted stage cost of every term, step and world, ``[term, T, W]``."""

    def __init__(
        self,
        stack: CostStack,
        trajectory: Trajectory,
        control: wp.array,
        state: ObservedState,
        shape: BatchSize,
        step_end: np.ndarray,
    ):
        layout, device = stack.layout, stack.device
        self.stack, self.shape = stack, shape
        self._launch = Launcher(device)
        self.cost = wp.zeros((len(stack.terms), shape.horizon, shape.worlds), dtype=float, device=device)
        view = StepView()
        view.joint_q, view.joint_qd = trajectory.joint_q, trajectory.joint_qd
        view.body_q, view.body_qd = trajectory.body_q, trajectory.body_qd
        view.force, view.sensor, view.controls = trajectory.contact_force, trajectory.sensor, control
        view.last_control = state.last_control
        view.start, view.pose, view.scalar = state.start, state.pose, state.scalar
        half_range = 0.5 * (layout.control_upper - layout.control_lower)
        view.step_end = wp.array(step_end, dtype=float, device=device)
        view.control_scale = wp.array(half_range, dtype=float, device=device)
        view.frame_body = wp.array(layout.frame_body, dtype=int, device=device)
        view.frame_pose = wp.array(layout.frame_pose, dtype=wp.transform, device=device)
        view.body_com = wp.array(layout.body_com, dtype=wp.vec3, device=device)
        view.body_mass = wp.array(layout.body_mass, dtype=float, device=device)
        owner = {body: i for i, entity in enumerate(layout.entities) for body in entity.bodies}
        view.body_robot = wp.array([owner.get(body, -1) for body in range(layout.nb)], dtype=int, device=device)
        slices, worlds = trajectory.joint_q.shape[:2]
        view.memory = wp.zeros((slices, worlds, stack.memory), dtype=float, device=device)
        self._weights = cost_weights(state.weight, stack.factors, np.ones(shape.horizon))  # not discounted
        self.view, self._trajectory, self._control, self._state = view, trajectory, control, state

    def launch(self, first: int = 0, count: int | None = None, code: tuple[EvaluationCode, Any] | None = None) -> None:
        """Evaluate terms that are kernels at every step of some worlds into :attr:`cost`.

        Args:
            first: First of these worlds.
            count: How many they are, all from the first on if None.
            code: Code of the terms and their parameters, as :meth:`CostStack.code_of` returns them; all terms if None.
        """
        code, params = code or (self.stack.code, self.stack.params)
        count, rollouts = self.shape.worlds - first if count is None else count, self.shape.rollouts
        if code.advances:
            self._launch(code.advance_kernel, count, [self.view, params, rollouts, self.shape.horizon, first], [])
        inputs = [self.view, params, self._weights, rollouts, first]
        self._launch(code.kernel, (self.shape.horizon, count), inputs, [self.cost])

    def launch_arrays(self) -> None:
        """Evaluate the terms over whole arrays, on the host; raises as :meth:`evaluate_array`."""
        for i, (term, _) in enumerate(self.stack.terms):
            if isinstance(term, ArrayCost):
                self.evaluate_array(i)

    def evaluate_array(self, i: int) -> None:
        """Evaluate a term over whole arrays.

        Args:
            i: Which of the stack's terms.

        Raises:
            SceneError: If its function raises, or returns anything but an array of numbers ``[T, W]``.
        """
        (term, params), label, file = self.stack.terms[i], self.stack.labels[i], self.stack.file
        out, device = self._trajectory, self.stack.device
        batch = {
            "joint_q": out.joint_q,
            "joint_qd": out.joint_qd,
            "body_q": out.body_q,
            "body_qd": out.body_qd,
            "contact_force": out.contact_force,
            "sensor": out.sensor,
            "control": self._control,
            "goal": self._state.pose[:, 0],
            "pose": self._state.pose,
            "scalar": self._state.scalar,
        }
        if device == "cpu":
            batch = {name: array.numpy() for name, array in batch.items()}
        try:
            value = term.function({**batch, "params": params})
        except Exception as error:
            raise raised(error, label, term, file=file) from error
        wanted = tuple(self.cost.shape[1:])
        if not hasattr(value, "shape"):
            what = f"an array cost returns an array [T, W] = {wanted}, this one returned {type(value).__name__}"
            raise complaint(label, term, what, file=file)
        if tuple(value.shape) != wanted:
            found = tuple(value.shape)
            what = f"this cost term returned an array of the wrong shape, {found} in place of [T, W] = {wanted}"
            raise complaint(label, term, what, file=file)
        if device == "cpu":
            if np.asarray(value).dtype.kind not in "fiub":
                what = f"an array cost returns real numbers, this one returned {np.asarray(value).dtype}"
                raise complaint(label, term, what, file=file)
            value = wp.array(value, dtype=float, device=device)
        else:
            value = wp.from_dlpack(value)
            if value.dtype is not wp.float32:
                raise complaint(label, term, "on a GPU an array cost returns numbers of type float32", file=file)
        inputs = [value, self._weights, i, self.shape.rollouts]
        self._launch(weigh_values_kernel, wanted, inputs, [self.cost])
