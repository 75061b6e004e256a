# SPDX-License-Identifier: Apache-2.0
"""A small network of rows of ReLU6 units and one linear output, trained in NumPy with Adam."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


@dataclass
class Network:
    """x → ReLU6(W x + b) → ... → W x + b, one number for every row of x."""

    weights: list[np.ndarray]
    """``[inputs, outputs]`` of each layer."""
    biases: list[np.ndarray]
    """``[outputs]``."""

    @classmethod
    def drawn(cls, sizes: Sequence[int], rng: np.random.Generator) -> Network:
        """A network of random weights, scaled by the inputs of each unit (He et al. 2015)."""
        pairs = list(itertools.pairwise(sizes))
        weights = [rng.normal(0.0, np.sqrt(2.0 / a), (a, b)).astype(np.float32) for a, b in pairs]
        return cls(weights, [np.zeros(b, dtype=np.float32) for b in sizes[1:]])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Outputs ``[n]`` of inputs ``[n, inputs]``."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.clip(x @ weight + bias, 0.0, 6.0)
        return (x @ self.weights[-1] + self.biases[-1])[:, 0]

    def gradient(self, x: np.ndarray, slope: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
        """Gradient of a loss by all parameters, weights first.

        Args:
            x: Inputs ``[n, inputs]``.
            slope: Derivative of the loss by each output, given the outputs ``[n]``.
        """
        values = [x]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values.append(np.clip(values[-1] @ weight + bias, 0.0, 6.0))
        back = slope((values[-1] @ self.weights[-1] + self.biases[-1])[:, 0])[:, None]
        weights, biases = [], []
        for layer in reversed(range(len(self.weights))):
            weights.append(values[layer].T @ back)
            biases.append(back.sum(axis=0))
            if layer:
                inside = (values[layer] > 0.0) & (values[layer] < 6.0)
                back = (back @ self.weights[layer].T) * inside
        return weights[::-1] + biases[::-1]

    def normalized(self, mean: np.ndarray, deviation: np.ndarray, scale: float) -> Network:
        """The same as scale · network((x - mean) / deviation), without normalisation around it."""
        weights, biases = [w.copy() for w in self.weights], [b.copy() for b in self.biases]
        weights[0] = (self.weights[0] / deviation[:, None]).astype(np.float32)
        biases[0] = (self.biases[0] - mean @ weights[0]).astype(np.float32)
        weights[-1], biases[-1] = weights[-1] * np.float32(scale), biases[-1] * np.float32(scale)
        return Network(weights, biases)


class Adam:
    """Steps along gradients, each parameter at its own pace (Kingma and Ba 2015).

    Args:
        parameters: Arrays that are changed in place.
    """

    def __init__(self, parameters: Sequence[np.ndarray]):
        self.parameters = list(parameters)
        self._first = [np.zeros_like(p) for p in self.parameters]
        self._second = [np.zeros_like(p) for p in self.parameters]
        self._count = 0

    def step(self, gradient: Iterable[np.ndarray], rate: float) -> None:
        """Change the parameters."""
        self._count += 1
        rate *= np.sqrt(1.0 - 0.999**self._count) / (1.0 - 0.9**self._count)
        for p, g, m, v in zip(self.parameters, gradient, self._first, self._second, strict=True):
            m += 0.1 * (g - m)
            v += 0.001 * (g * g - v)
            p -= np.float32(rate) * m / (np.sqrt(v) + 1e-8)


def train(
    network: Network,
    draw: Callable[[int], tuple[np.ndarray, np.ndarray]],
    slope: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    steps: int,
    batch: int,
    rate: float = 2e-3,
    told: Callable[[int], None] = lambda step: None,
) -> None:
    """Train a network in place; the pace falls to nothing along half a cosine.

    Args:
        network: The network.
        draw: Inputs ``[n, inputs]`` and what they should give ``[n]``, given n.
        slope: Derivative of each row's loss by its output, given outputs and what they should be.
        steps: How many batches are drawn.
        batch: Rows of a batch.
        rate: Greatest pace.
        told: Called with the number of every step.
    """
    adam = Adam([*network.weights, *network.biases])
    for step in range(steps):
        x, wanted = draw(batch)
        gradient = network.gradient(x, lambda out, wanted=wanted: slope(out, wanted) / len(out))
        warm = min(1.0, (step + 1) / 200.0)
        adam.step(gradient, rate * warm * 0.5 * (1.0 + np.cos(np.pi * step / steps)))
        told(step)
