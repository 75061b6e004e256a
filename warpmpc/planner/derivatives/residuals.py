# SPDX-License-Identifier: Apache-2.0
"""Residuals of a scene's cost terms, side by side, and the norms that they are costs by."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...cost.kernel import load_source
from ...cost.residual import fixed_norm
from ...cost.term import CostTerm
from ...kernels.cost.norms import QUADRATIC
from ...kernels.cost.view import StepView
from ...kernels.planner.derivatives import norms_kernel
from ...physics.runtime.launch import Launcher, unrecorded
from ...scene.errors import SceneError

if TYPE_CHECKING:
    from ...cost.stack import CostStack

_SOURCE = '''
@wp.kernel(module="unique", enable_backward=False)
def residual_kernel(
    # inputs
    view: StepView,
    p: Params,
    rollouts: int,  # per environment
    first: int,  # world of thread 0
    # outputs
    residual: wp.array2d[float],  # [W, R]
):
    """One thread: the residuals of all terms after the last control of one world."""
    s = view
    s.t = view.controls.shape[0]
    s.w = first + wp.tid()
    s.e = s.w // rollouts
{rows}
'''


class Residuals:
    """Residuals that the terms of a scene are norms of.

    A term that is no norm of a residual takes part as one whose residual is √(2c) and whose norm is half its square:
    its value and gradient are its own, and its Gauss-Newton Hessian is ∇c ∇cᵀ / 2c, which is never negative.

    Args:
        stack: The terms.

    Raises:
        SceneError: If a term reads whole arrays, or carries numbers along a rollout, so that a single step of it has
            no meaning.
    """

    def __init__(self, stack: CostStack):
        if (refused := self.refusal(stack)) is not None:
            raise refused
        self._stack, self._launch = stack, Launcher(stack.device)
        self.without: list[str] = []
        """Terms without a residual."""
        names: dict[str, Any] = {"wp": wp, "StepView": StepView, "Params": stack.code.params}
        norms, counts, rows = [], [], []
        for i, (term, bound) in enumerate(stack.terms):
            at = sum(counts)
            count = int(term.residual.dimension(bound)) if term.residual else 0
            if not count:
                names[f"term{i}"], count, norm = term.function, 1, fixed_norm(QUADRATIC)
                rows.append(f"    residual[s.w, {at}] = wp.sqrt(2.0 * term{i}(s, p.p{i}))")
                self.without.append(stack.labels[i])
            else:
                names[f"component{i}"], norm = term.residual.component, term.residual.norm(bound)
                rows.append(f"    for i in range({count}):")
                rows.append(f"        residual[s.w, {at} + i] = component{i}(s, p.p{i}, i)")
            counts.append(count)
            norms.append(norm)
        self.count = np.array(counts, dtype=np.int32)
        """Numbers of each term ``[term]``."""
        self.first = np.cumsum([0, *counts[:-1]], dtype=np.int32)
        """First of each term's numbers ``[term]``."""
        self.width = int(self.count.sum())
        """Numbers R of all terms."""
        source = _SOURCE.format(rows="\n".join(rows))
        load_source(source, names, "<residuals ", source)
        self._kernel: wp.Kernel = names["residual_kernel"]

        def array(values: list, kind: type) -> wp.array:
            return wp.array(values, dtype=kind, device="cpu")

        self.norm_arrays = [
            array(self.first, int),
            array(self.count, int),
            array([n.kind for n in norms], int),
            array([n.p for n in norms], float),
            array([n.q for n in norms], float),
        ]
        """First and number of each term's residuals, and kind, p and q of its norm, on the CPU ``[term]`` each."""

    @staticmethod
    def refusal(stack: CostStack) -> SceneError | None:
        """Error about the first term that has no meaning in a single step, None if all have."""
        for (term, _), label in zip(stack.terms, stack.labels, strict=True):
            if isinstance(term, CostTerm) and term.advance is None:
                continue
            what = "it carries numbers along the rollout"
            if not isinstance(term, CostTerm):
                what = "it is a function over whole arrays"
            message = f"planners with derivatives take steps one by one, and this term cannot: {what}"
            return SceneError(message, key=f"cost.{label}", file=stack.file, found=term.name)
        return None

    def launch(self, view: StepView, rollouts: int, first: int, count: int, out: wp.array) -> None:
        """Write the residuals ``[W, R]`` after the last control of some worlds; capture-safe.

        Args:
            view: What is seen of all worlds.
            rollouts: Worlds of an environment.
            first: First of the worlds.
            count: How many they are.
            out: Takes them.
        """
        self._launch(self._kernel, count, [view, self._stack.params, rollouts, first], [out])

    @unrecorded
    def norms(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Norms, their gradients and Hessians.

        Args:
            residual: ``[N, R]``.

        Returns:
            Norm of each term ``[N, term]``, gradient ``[N, R]``, and Hessian ``[N, R, R]``, which is zero between
            terms.
        """
        n, widest = len(residual), int(self.count.max(initial=1))
        shapes = (n, len(self.count)), (n, self.width), (n, self.width, widest)
        value, slope, bend = (wp.zeros(shape, dtype=float, device="cpu") for shape in shapes)
        given = wp.array(residual, dtype=float, device="cpu")
        wp.launch(norms_kernel, shapes[0], [given, *self.norm_arrays], [value, slope, bend], device="cpu")
        hessian = np.zeros((n, self.width, self.width))
        for at, count in zip(self.first, self.count, strict=True):
            hessian[:, at : at + count, at : at + count] = bend.numpy()[:, at : at + count, :count]
        return value.numpy(), slope.numpy(), hessian
