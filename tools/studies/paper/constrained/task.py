# SPDX-License-Identifier: Apache-2.0
"""A drawn scene of Table I as chains of bodies and spheres, for the server."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from warpmpc import CompiledScene, Scene

SERVER = Path(__file__).with_name("server.py")
STEPS, DT = 9, 0.08
"""Steps and their length [s]: as far as the scenes' own planners look."""
MOST = {"enclosing": 1, "covering": 3}
"""Spheres of a link at most: one that encloses it, or more that cover it."""


def task_of(scene: Scene, compiled: CompiledScene, kind: str) -> dict:
    """A drawn scene for the server.

    Args:
        scene: A scene of a robot with velocity drives, and spheres.
        compiled: The scene, compiled.
        kind: What the robot consists of, a key of :data:`MOST`.
    """
    from warpmpc.scene.model.spheres import fit_spheres

    layout, model = compiled.layout, compiled.spec().compile()
    own, dofs = layout.entity(scene.robot[0].name, key="robot").bodies, list(layout.actuator_dof)
    if scene.robot[0].name == "base":
        dofs = dofs[:2]  # it need not turn
    hand = int(layout.frame_body[layout.frame(scene.goal.target)])
    # the chain of every body that has spheres or is the hand, parents first
    spheres = fit_spheres(layout, own, overhang=0.02, most=MOST[kind])
    wanted = {model.body(compiled.body_name[b]).id for b in (*spheres.body, hand)}
    for body in list(wanted):
        while (body := int(model.body_parentid[body])) > 0:
            wanted.add(body)
    order = sorted(wanted)
    ids = {body: i for i, body in enumerate(order)}

    def joints(body: int) -> list[dict]:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        moved = [j for j in range(first, first + count) if int(model.jnt_dofadr[j]) in dofs]
        return [
            {
                "q": dofs.index(int(model.jnt_dofadr[j])),
                "axis": model.jnt_axis[j].tolist(),
                "anchor": model.jnt_pos[j].tolist(),
                "slides": int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE),
            }
            for j in moved
        ]

    bodies = [
        {
            "parent": ids.get(int(model.body_parentid[b]), -1),
            "position": model.body_pos[b].tolist(),
            "quat": model.body_quat[b].tolist(),
            "joints": joints(b),
        }
        for b in order
    ]
    moving = {i for i, body in enumerate(bodies) if body["joints"]}
    moving |= {i for i, body in enumerate(bodies) if body["parent"] in moving}
    points = [
        [ids[model.body(compiled.body_name[b]).id], centre.tolist(), float(radius)]
        for b, centre, radius in zip(spheres.body, spheres.centre, spheres.radius, strict=True)
    ]
    limits = np.array([layout.dof_lower[dofs], layout.dof_upper[dofs]], dtype=float).T
    (drive,) = scene.robot[0].drive
    return {
        "bodies": bodies,
        "hand": ids[model.body(compiled.body_name[hand]).id],
        "points": [point for point in points if point[0] in moving],
        "spheres": [[list(ball.position), float(np.ravel(ball.size)[0])] for ball in scene.obstacle],
        "goal": [*scene.goal.position, 0.0][:3],
        "axes": [0, 1] if len(dofs) == 2 else [0, 1, 2],
        "ranges": np.clip(limits, -1e6, 1e6).tolist(),
        "speed": np.broadcast_to(drive.limit, len(drive.joints))[: len(dofs)].tolist(),
        "dt": DT,
        "steps": STEPS,
    }
