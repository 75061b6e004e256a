# SPDX-License-Identifier: Apache-2.0
"""Rows that go straight to postures in which a frame is where it is wanted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.postures import Reach, posture_rows_kernel, replace_posture_kernel, search_posture_kernel
from ..kernels.planning.sampling import advance_counter_kernel
from ..launch import Launcher
from ..model.joints import chain, chain_axes, driving, joint_table
from ..model.layout import GOAL
from ..scene.errors import SceneError
from .proposers import Proposer

if TYPE_CHECKING:
    from ..kernels.planning.splines import Spline
    from ..model.layout import Layout
    from ..scene.schema import Scene
    from ..task.observed import ObservedState

KEY = "planner.postures"
MODES = ("position", "velocity", "acceleration")
"""Modes of a control, by how often the way is differentiated."""
DAMPING = 1e-3
"""Added to J Jᵀ; its squared lengths are in metres and radians."""
NEAR = 0.01
"""Largest error of a posture's pose [m and rad]."""
STRIDE = 0.5
"""Greatest change of a joint in a step of the search [m or rad]."""


class PostureSamples(Proposer):
    """Samples that go to postures which bring a frame to a pose of the task, each posture at several paces.

    Postures are searched for on the way, a little in every plan, and tried once they have found the pose: what their
    rows cost ranks them, and the worst of those that have had time to get there makes room for one begun at random.
    Where there is none, as for a pose out of reach, these rows ask for nothing.

    Args:
        scene: The scene, whose ``planner.postures`` says what is wanted.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
        cost: Costs of the samples ``[E, S]``.
        first: The sample that the first row is.
        seed: Seed of the postures that are begun.

    Raises:
        SceneError: If there is no such frame or pose, or no drive moves the frame.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        state: ObservedState,
        spline: Spline,
        null: wp.array,
        cost: wp.array,
        *,
        first: int,
        seed: int,
    ):
        wanted, device, envs = scene.planner.postures, cost.device, cost.shape[0]
        super().__init__(wanted.count * len(wanted.durations))
        self._state, self._null, self._cost, self._first, self._seed = state, null, cost, first, seed
        self._steps, self._min_age, self._time = wanted.steps, wanted.min_age, spline.time
        self._launch, postures = Launcher(device), envs * wanted.count
        self._reach = _reach(scene, layout, postures, str(device))
        self._duration = wp.array(wanted.durations, dtype=float, device=device)
        self.postures = wp.array(np.tile(layout.joint_q, (1, postures, 1)), dtype=float, device=device)
        """The postures as joint coordinates ``[1, E·M, nq]``."""
        self._body_q = wp.zeros((1, postures, layout.nb), dtype=wp.transform, device=device)
        self._jacobian = wp.zeros((postures, len(self._reach.control)), dtype=wp.spatial_vector, device=device)
        self._miss = wp.zeros((envs, wanted.count), dtype=float, device=device)
        self._age = wp.zeros((envs, wanted.count), dtype=int, device=device)
        self._counter = wp.zeros(envs, dtype=int, device=device)
        self.reset()

    def reset(self) -> None:
        """Forget all postures; capture-safe."""
        self._counter.zero_()
        self._age.fill_(-1)

    def before_plan(self) -> None:
        """Search on, and write the ways to what was found; capture-safe."""
        state, reach, observed = self._state, self._reach, self._state.observed
        envs, count = self._age.shape
        self._launch(advance_counter_kernel, envs, [observed], [self._counter])
        replaced = [observed, self._cost, self._first, len(self._duration), self._min_age, NEAR, self._miss]
        self._launch(replace_posture_kernel, envs, replaced, [self._age])
        inputs = [observed, state.joint_q, state.pose, reach, self._age, self._counter, self._seed]
        self._launch(
            search_posture_kernel,
            envs * count,
            [*inputs, self._steps, DAMPING, STRIDE],
            [self.postures, self._miss, self._body_q, self._jacobian],
        )
        found = [reach, self.postures, NEAR, self._miss, self._duration, self._time]
        inputs = [state.joint_q, state.joint_qd, self._null, *found]
        self._launch(posture_rows_kernel, (self.count, envs), inputs, [self.knots])


def _reach(scene: Scene, layout: Layout, worlds: int, device: str) -> Reach:
    """Frame, pose and joints of a search."""
    wanted = scene.planner.postures
    of, to = (layout.frame(getattr(wanted, key), key=f"{KEY}.{key}") for key in ("of", "to"))
    body, target = int(layout.frame_body[of]), int(layout.frame_body[to])
    if target > GOAL:
        raise SceneError("is neither the goal nor a target", key=f"{KEY}.to", file=scene.path, found=wanted.to)
    try:
        axes = chain_axes(layout, body)[::-1]
    except ValueError as error:
        message = "a ball joint moves this frame, whose turns are not about axes of its own"
        raise SceneError(message, key=f"{KEY}.of", file=scene.path, found=str(error)) from None
    controls = np.array([driving(layout, np.array(axes, dtype=int), mode) for mode in MODES])
    driven = np.flatnonzero(controls.max(axis=0) >= 0)
    if not len(driven):
        raise SceneError("no drive moves this frame", key=f"{KEY}.of", file=scene.path, found=wanted.of)
    columns = [axes[i] for i in driven]
    lower, upper = (limit[columns].astype(np.float64) for limit in (layout.dof_lower, layout.dof_upper))
    # a joint without limits turns once around, or slides a metre, from where it starts
    start = layout.joint_q[layout.dof_coord[columns]]
    free = upper - lower > 1e3
    lower, upper = np.where(free, start - np.pi, lower), np.where(free, start + np.pi, upper)
    inset = 0.5 * wanted.margin * (upper - lower)

    def array(values: object, dtype: type) -> wp.array:
        return wp.array(np.asarray(values), dtype=dtype, device=device)

    r = Reach()
    r.table, r.chain = joint_table(layout, device, worlds=worlds), chain(layout, body, columns, device)
    r.joint, r.tip = array(_path(layout, body), int), body
    r.frame, r.target = wp.transform(*layout.frame_pose[of]), wp.transform(*layout.frame_pose[to])
    r.pose = GOAL - target
    r.lower, r.upper = array(lower + inset, float), array(upper - inset, float)
    r.control, r.order = array(controls.max(axis=0)[driven], int), array(controls.argmax(axis=0)[driven], int)
    r.dof = array(columns, int)
    return r


def _path(layout: Layout, body: int) -> list[int]:
    """Joints from the root to a body."""
    joint_of = {int(child): joint for joint, child in enumerate(layout.joint_child)}
    joints: list[int] = []
    while body >= 0:
        joints.append(joint_of[body])
        body = int(layout.joint_parent[joints[-1]])
    return joints[::-1]
