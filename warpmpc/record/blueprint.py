# SPDX-License-Identifier: Apache-2.0
"""Layout of a recording: the scene on the left, what the planner thinks on the right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb


def blueprint(
    centre: np.ndarray, radius: float, *, ground: float | None, contacts: bool, clouds: bool
) -> rrb.Blueprint:
    """The views of a recording.

    Args:
        centre: Centre of the scene ``[3]`` [m].
        radius: Its radius [m].
        ground: Height of the floor [m].
        contacts: Whether there are contact forces to show.
        clouds: Whether there are point clouds to show.
    """
    more = ("rollouts", "contact", *(["cloud"] if clouds else []))
    scene = scene_view(centre, radius, ground=ground, more=more)
    last = [series("plan [ms]", "plan_ms"), series("diverged worlds", "diverged_worlds")]
    if contacts:
        last.insert(1, series("contact force [N]", "contact_force"))
    right = rrb.Vertical(
        series("cost of the best rollout", "cost"),
        series("goal error [m, rad]", "goal_error"),
        rrb.Tabs(
            series("control", "control"),
            rrb.Spatial2DView(name="predicted controls", origin="/prediction"),
            active_tab=0,
        ),
        rrb.Horizontal(series("effective samples η", "temperature/eta"), series("temperature β", "temperature/beta")),
        rrb.Tabs(*last, active_tab=0),
    )
    return side_by_side(scene, right)


def side_by_side(scene: rrb.Spatial3DView, right: rrb.Vertical) -> rrb.Blueprint:
    """The scene on the left and curves on the right."""
    return rrb.Blueprint(
        rrb.Horizontal(scene, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def scene_view(
    centre: np.ndarray, radius: float, *, ground: float | None, more: Sequence[str] = ()
) -> rrb.Spatial3DView:
    """The view of bodies and goal.

    Args:
        centre: Centre of the scene ``[3]`` [m].
        radius: Its radius [m].
        ground: Height of the floor [m].
        more: What else is shown, names of entities.
    """
    floor = rr.encodings.Plane3D((0.0, 0.0, 1.0), ground or 0.0)
    return rrb.Spatial3DView(
        name="scene",
        origin="/",
        contents=[f"+ /{name}/**" for name in ("scene", "goal", *more)],
        line_grid=rrb.LineGrid3D(visible=ground is not None, plane=floor),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + 1.7 * radius * np.array([-0.35, -0.9, 0.85]),
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def series(name: str, origin: str) -> rrb.TimeSeriesView:
    """A plot of all scalars below an entity path."""
    return rrb.TimeSeriesView(name=name, origin=f"/{origin}")
