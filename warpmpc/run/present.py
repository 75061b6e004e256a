# SPDX-License-Identifier: Apache-2.0
"""Prediction of late observations to the present, under the controls that were sent since."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from ..realtime.predictor import Predictor

if TYPE_CHECKING:
    from ..controller.controller import Controller
    from ..model.state import State
    from ..scene.schema import Scene


class Present:
    """Predicts observations of an episode to the present where the scene estimates what it observes late.

    Without an estimate observations stay as late as ``plant.delay`` makes them, and with ``agent.compensate = false``.

    Args:
        scene: The scene, drawn for the episode.
        controller: Its controller.
    """

    def __init__(self, scene: Scene, controller: Controller):
        self._dt = scene.timing.control_dt
        late = round(scene.plant.delay / self._dt)
        self._predict = None
        if late and scene.agent.compensate and (scene.estimate or scene.estimate_base):
            self._predict = Predictor(scene, controller.compiled, controller.layout, controller.task)
        self._sent: deque[np.ndarray] = deque(maxlen=late)

    def sent(self, control: np.ndarray) -> None:
        """Take note of a control ``[nu]`` that acts from now on for one control step."""
        self._sent.append(np.array(control))

    def __call__(self, state: State, now: float) -> State:
        """The state now [s], from one that was observed earlier."""
        duration = now - float(state.time)
        if self._predict is None or not self._sent or duration <= 0.0:
            return state

        def acting(time: float) -> np.ndarray:
            ago = int((now - time) / self._dt - 1e-6)  # whole controls
            return self._sent[-1 - min(ago, len(self._sent) - 1)]

        return self._predict(state, acting, duration)
