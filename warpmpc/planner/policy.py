# SPDX-License-Identifier: Apache-2.0
"""Policies as ONNX files, whose controls are tried among the samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..model.assets import resolve_asset
from ..model.state import State
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..model.layout import Layout
    from ..scene.schema import Ancillary, Scene
    from ..task.task import Task
    from .horizon import Ask, Horizon

FLOAT = "tensor(float)"


def policy(scene: Scene, layout: Layout, key: str, wanted: Ancillary, horizon: Horizon, task: Task) -> tuple[int, Ask]:
    """Number of samples that the policy of a file proposes, and the function that runs it.

    Raises:
        SceneError: If onnxruntime or the file is missing, or the policy reads or returns something else.
    """

    def wrong(message: str, **more: object) -> SceneError:
        return SceneError(message, key=key, file=scene.path, found=wanted.policy, **more)

    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(wanted.policy, base=base, key=key, file=scene.path)
    try:
        import onnxruntime
    except ImportError:
        raise wrong('needs onnxruntime: pip install "warpmpc[onnx]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # other cores roll out, and a policy is small
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of onnxruntime's own, derived from nothing else
        raise wrong(f"onnxruntime cannot read it: {' '.join(str(error).split())}") from None
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].type != FLOAT:
        raise wrong(f"has the inputs {', '.join(f'{i.name} {i.type}' for i in inputs)}", allowed=f"one, {FLOAT}")
    _check_observation(scene, task, key.replace("policy", "observation"), wanted)
    (read,) = inputs
    width = len(_observation(wanted, State.start(layout), task.values(0)))
    if len(read.shape) not in (1, 2) or (isinstance(read.shape[-1], int) and read.shape[-1] != width):
        parts = " + ".join(wanted.observation)
        raise wrong(f"reads an array {read.shape}", allowed=f"[{width}] or [1, {width}], which is {parts}")

    def run(state: State, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
        observation = _observation(wanted, state, values)
        try:
            found = session.run(None, {read.name: observation.reshape((1,) * (len(read.shape) - 1) + (-1,))})[0]
        except Exception as error:
            raise wrong(f"onnxruntime cannot run it: {' '.join(str(error).split())}") from None
        return found[0] if len(read.shape) == 2 and len(found) == 1 and found.ndim > 1 else found

    first = run(State.start(layout), task.values(0))
    samples = len(first) if np.ndim(first) == 3 else 1
    try:
        horizon.proposed(first, samples)
    except (ValueError, TypeError) as error:
        raise wrong(str(error), allowed=horizon.allowed(1) + " or several of these") from None
    return samples, lambda state, values: horizon.proposed(run(state, values), samples)


def _check_observation(scene: Scene, task: Task, key: str, wanted: Ancillary) -> None:
    allowed = ["joint_q", "joint_qd", "act", *task.values(0)]
    for name in wanted.observation:
        if name not in allowed:
            raise SceneError("nothing that a policy can read", key=key, file=scene.path, found=name, allowed=allowed)


def _observation(wanted: Ancillary, state: State, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
    """Input of a policy, side by side, in float32."""
    known = {"joint_q": state.joint_q, "joint_qd": state.joint_qd, "act": state.act, **values}
    return np.concatenate([np.atleast_1d(known[name]) for name in wanted.observation]).astype(np.float32)
