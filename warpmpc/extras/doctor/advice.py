# SPDX-License-Identifier: Apache-2.0
"""Advice on what a scene may have but probably does not mean, in one sentence each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...planner.covariance import control_sigma
from ...scene.errors import some
from .joints import wrong_ranges

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...scene.model.compiled import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema import Scene

WIDE, NARROW = 1.0, 2e-3
"""Standard deviations of the noise beyond these shares of a control's range are likely mistakes."""
LONG = 0.5
"""Longest control that is not asked about [s]."""
LARGE, SMALL = 100.0, 1e-4
"""Sizes of shapes that are not asked about [m]."""


def advise(scene: Scene, compiled: CompiledScene) -> list[str]:
    """Sentences about a scene, none for one that looks as it should.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
    """
    return [
        *_times(scene),
        *_angles(scene, compiled.layout),
        *([] if any(wrong_ranges(compiled)) else _noise(scene, compiled.layout)),  # of controls within those ranges
        *_shapes(compiled.layout),
    ]


def _times(scene: Scene) -> Iterator[str]:
    if scene.timing.control_dt > LONG:
        yield f"timing.control_dt = {scene.timing.control_dt:g} s is long for a control: is it in milliseconds?"
    hold, timeout, planner = scene.success.hold if scene.success else 0.0, scene.timing.timeout, scene.planner
    if hold > timeout:
        yield f"success.hold = {hold:g} s is longer than timing.timeout = {timeout:g} s: no run can succeed"
    if planner.knot_count and planner.knot_count > planner.horizon:
        yield (
            f"planner.knots = {planner.knots} are more than the {planner.horizon} steps of planner.horizon: what lies "
            "between steps changes nothing"
        )


def _angles(scene: Scene, layout: Layout) -> Iterator[str]:
    poses = [("goal", scene.goal), *((f"target.{target.name}", target) for target in scene.target)]
    poses += [(f"phase.{phase.name}.goal", phase.goal) for phase in scene.phase]
    given = {f"{key}.yaw": pose.yaw for key, pose in poses if pose is not None and pose.yaw is not None}
    for dof in np.flatnonzero(layout.dof_name):
        joint = int(np.searchsorted(layout.joint_qd_start, dof, side="right")) - 1
        angle, hinge = layout.joint_q[layout.dof_coord[dof]], dof - layout.joint_qd_start[joint]
        if hinge >= layout.joint_dof_dim[joint, 0] and layout.dof_lower[dof] <= angle <= layout.dof_upper[dof]:
            given[f"robot.{layout.dof_name[dof].replace('/', '.joint_q.', 1)}"] = float(angle)
    for key, angle in given.items():
        if abs(angle) > 2.0 * np.pi:
            yield f"{key} = {angle:g} rad is {abs(angle) / (2.0 * np.pi):.3g} turns: is it in degrees?"


def _noise(scene: Scene, layout: Layout) -> Iterator[str]:
    lower, upper = layout.control_lower.astype(float), layout.control_upper.astype(float)
    bounded = np.isfinite(upper - lower) & (upper > lower)
    share = control_sigma(scene, layout) / np.where(bounded, upper - lower, 1.0)
    low, high = scene.planner.noise.spread
    for what, wrong, effect in (
        ("wider than", bounded & (share * np.sqrt(low * high) > WIDE), "nearly every sample lies at a limit"),
        ("tiny beside", bounded & (share * high < NARROW), "samples hardly differ"),
    ):
        if np.any(wrong):
            names = [name for name, bad in zip(layout.control_name, wrong, strict=True) if bad]
            i = int(np.argmax(wrong))
            yield (
                f"planner.noise.sigma is {what} the range of {some(names)} ({lower[i]:g} to {upper[i]:g}): {effect}; "
                "sigma = { range = 0.25 } is a quarter of each control's range"
            )


def _shapes(layout: Layout) -> Iterator[str]:
    for shape in layout.shapes:
        if shape.kind == "plane":
            continue
        extent = 2.0 * float(np.max(np.abs(shape.scale)))
        if shape.mesh is not None:
            points = np.asarray(layout.meshes[shape.mesh][0]) * np.asarray(shape.scale)
            extent = float(np.ptp(points, axis=0).max())
        if not SMALL < extent < LARGE:
            yield _unit(f"the shape {shape.name} of {extent:.3g} m", "millimetres")


def _unit(what: str, unit: str) -> str:
    return f"{what} is implausible, lengths are in metres and masses in kilograms: is it in {unit}?"
