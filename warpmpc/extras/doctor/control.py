# SPDX-License-Identifier: Apache-2.0
"""Findings about cost terms: those that no control can change, and samples that all cost the same."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...scene.errors import some
from .contacts import collides
from .finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...planner.controller.controller import Controller
    from ...scene.model.at_start import Subject

PROBES, COMPARED = 24, 512
"""Most samples of a plan whose rollouts are looked at, and whose terms are compared: what a term is about may happen in
few of them."""
SAME = 1e-6
"""Share of a term's cost by which samples must differ, or it counts as the same in all: float32 has seven digits."""
SHORT = 0.1
"""Look-ahead below which plans see little of what follows from a control [s]."""
LEADS = 0.01
"""Share of what tells samples apart below which the terms that lead to the goal decide nothing."""


def controlled(subject: Subject) -> np.ndarray:
    """Bodies that a control can move ``[nbody]``: by actuators, constraints and tendons between trees, contacts."""
    model = subject.world.model
    trees = model.ntree
    links = [(a, b) for a, b in _coupled(model) if a >= 0 and b >= 0]
    solid = [g for g in range(model.ngeom) if model.body_treeid[model.geom_bodyid[g]] >= 0]
    kinds = {}  # one geom of each tree and pair of bits stands for all
    for g in solid:
        key = int(model.body_treeid[model.geom_bodyid[g]]), int(model.geom_contype[g]), int(model.geom_conaffinity[g])
        kinds.setdefault(key, g)
    some_geoms = list(kinds.values())
    for i, g in enumerate(some_geoms):
        for h in some_geoms[:i]:
            if collides(model, g, h):
                links.append(tuple(int(model.body_treeid[model.geom_bodyid[x]]) for x in (g, h)))
    links += [
        tuple(int(model.body_treeid[model.geom_bodyid[g]]) for g in pair)
        for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    links = [(a, b) for a, b in links if a >= 0 and b >= 0]
    graph = coo_matrix((np.ones(len(links)), tuple(np.array(links).T) if links else ([], [])), shape=(trees, trees))
    _, group = connected_components(graph, directed=False)
    groups = {int(group[tree]) for tree in driven(model) if tree >= 0}
    return np.array([tree >= 0 and int(group[tree]) in groups for tree in model.body_treeid])


def driven(model: mujoco.MjModel) -> set[int]:
    """Kinematic trees with an actuator."""
    kinds, found = mujoco.mjtTrn, set()
    for a in range(model.nu):
        kind, target = int(model.actuator_trntype[a]), int(model.actuator_trnid[a, 0])
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            bodies = [int(model.jnt_bodyid[target])]
        elif kind == kinds.mjTRN_TENDON:
            bodies = _tendon_bodies(model, target)
        elif kind in (kinds.mjTRN_SITE, kinds.mjTRN_SLIDERCRANK):
            bodies = [int(model.site_bodyid[target])]
        else:
            bodies = [target]
        found |= {int(model.body_treeid[body]) for body in bodies}
    return found


def _tendon_bodies(model: mujoco.MjModel, tendon: int) -> list[int]:
    first = int(model.tendon_adr[tendon])
    bodies = []
    for w in range(first, first + int(model.tendon_num[tendon])):
        kind, target = int(model.wrap_type[w]), int(model.wrap_objid[w])
        if kind == mujoco.mjtWrap.mjWRAP_JOINT:
            bodies.append(int(model.jnt_bodyid[target]))
        elif kind == mujoco.mjtWrap.mjWRAP_SITE:
            bodies.append(int(model.site_bodyid[target]))
    return bodies


def _coupled(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of trees that a tendon or an equality constraint couples, -1 for the world."""
    tree = model.body_treeid
    for t in range(model.ntendon):
        bodies = _tendon_bodies(model, t)
        yield from ((int(tree[a]), int(tree[b])) for a, b in pairwise(bodies))
    kinds = mujoco.mjtEq
    for e in range(model.neq):
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if int(model.eq_type[e]) in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            of = model.site_bodyid if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE else np.arange(model.nbody)
            yield int(tree[of[first]]), int(tree[of[second]])
        elif model.eq_type[e] == kinds.mjEQ_JOINT and second >= 0:
            yield int(tree[model.jnt_bodyid[first]]), int(tree[model.jnt_bodyid[second]])


def names_in(value: object) -> set[str]:
    """All text in the keys of a term."""
    if isinstance(value, str):
        return {value}
    if isinstance(value, dict):
        return set().union(*map(names_in, value.values()), set())
    return set().union(*map(names_in, value), set()) if isinstance(value, list | tuple) else set()


def reach_findings(subject: Subject) -> Iterator[Finding]:
    """Terms, goals and conditions about bodies that no control can move."""
    layout, model = subject.compiled.layout, subject.world.model
    moved = controlled(subject)
    robots = {robot.name for robot in subject.scene.robot}
    frames = {}  # frame → whether a control can move it; frames that no physics moves are left out
    for name, body in zip(layout.frame_name, layout.frame_body, strict=True):
        if body >= 0 and name not in robots:  # the name of a robot stands for all of it in terms of contacts
            there = model.body(subject.compiled.body_name[body]).id
            if model.body_treeid[there] >= 0 or model.body_mocapid[model.body_rootid[there]] >= 0:
                frames[name] = bool(moved[there])
    asked = [(f"cost.{cost.name or cost.term}", names_in(cost.params)) for cost in subject.scene.cost]
    goal = subject.scene.goal
    if goal is not None and goal.target in frames:
        asked.append(("goal", {goal.target}))
    elif goal is not None and goal.target not in robots:
        yield Finding(
            "goal",
            f"{goal.target} is fixed to the world: nothing can bring it to its goal",
            "name a frame of a body with a joint between it and the world (warpmpc check lists frames)",
        )
    wanted = subject.scene.success.conditions if subject.scene.success else ()
    asked += [("success.conditions", {condition.frame, condition.to}) for condition in wanted if condition.frame]
    mocap = [subject.compiled.body_name[b] for b in layout.mocap_body.tolist()]
    for key, names in asked:
        about = [name for name in sorted(names) if name in frames]
        if about and not any(frames[name] for name in about):
            hint = ": a mocap body leads it, and plans move no mocap bodies" if mocap else ""
            cure = (
                "drive the joints that carry it (robot.NAME.drive, or actuators in MJCF), or let something that is "
                "driven touch it"
            )
            if mocap:
                robot, _, body = mocap[0].partition("/")
                cure = f'drive the mocap body: robot.{robot}.drive = {{ mode = "mocap", body = "{body}", limit = 0.5 }}'
            yield Finding(key, f"no control can move {some(about)}{hint}", cure)


def driven_frames(subject: Subject) -> set[str]:
    """Frames of bodies of kinematic trees that an actuator acts on."""
    layout, model = subject.compiled.layout, subject.world.model
    trees, names = driven(model), subject.compiled.body_name
    bodies = zip(layout.frame_name, layout.frame_body, strict=True)
    return {name for name, b in bodies if b >= 0 and int(model.body_treeid[model.body(names[b]).id]) in trees}


def told_apart(costs: np.ndarray) -> np.ndarray:
    """Mean distance of samples' costs ``[n, terms]`` from the median, by term; the few that collide count little."""
    return np.abs(costs - np.median(costs, axis=0)).mean(axis=0) if len(costs) else np.zeros(costs.shape[1])


def plan_findings(subject: Subject, controller: Controller) -> Iterator[Finding]:
    """Samples that all cost the same, weights that are wrong, and plans that look ahead too short.

    Args:
        subject: The scene.
        controller: It has made a plan.
    """
    ahead = float(controller.plan_step.grid.t[-1])
    if ahead < SHORT:
        yield Finding(
            "planner.lookahead",
            f"plans look {ahead:.3g} s ahead: little of what follows from a control is seen",
            "leave planner.horizon and dt out and set planner.lookahead: about 1 s suits most robots",
        )
    planner, grid = controller.scene.planner, controller.plan_step.grid
    counted = float(np.sum(planner.discount ** np.arange(grid.steps) * grid.dt))
    if planner.terminal == 1.0 and counted < SHORT <= ahead:
        yield Finding(
            "planner.discount",
            f"with a discount of {planner.discount:g} a step, {counted:.2g} s of the {ahead:.3g} s ahead count",
            "set planner.discount = 1",
        )
    costs = term_costs(controller)
    if not len(costs):
        yield Finding(
            "engine.substeps",
            "all samples that were compared diverged: plans have nothing to choose from",
            "raise engine.substeps, lower gains, or give drives an effort_limit",
        )
    if len(costs) < 2:
        return
    spread = np.ptp(costs, axis=0)
    weights = np.array([float(np.ravel(controller.task[label])[0]) for label in controller.costs.labels])
    counts = (weights != 0.0) & (spread > SAME * np.abs(costs).max(axis=0))
    if not counts.any():
        yield Finding(
            "cost",
            f"all {len(costs)} samples that were compared cost the same: plans have nothing to choose by",
            "raise planner.noise.sigma, look further ahead, or add a term that leads to the goal",
        )
        return
    yield from _outweighed(subject, controller, np.where(weights > 0.0, told_apart(costs), 0.0))


def _outweighed(subject: Subject, controller: Controller, spread: np.ndarray) -> Iterator[Finding]:
    """Terms that lead a robot to what success asks for, and decide nothing beside the others.

    Objects, and what else is not driven, are left out: as long as nothing touches them, no sample moves them.

    Args:
        subject: The scene.
        controller: It has made a plan.
        spread: Difference between samples in each term's cost.
    """
    scene, labels = controller.scene, controller.costs.labels
    pairs = [{c.frame, c.to} for c in (scene.success.conditions if scene.success else ()) if c.frame and c.distance]
    if scene.goal is not None and scene.goal.object is None:
        pairs.append({scene.goal.target, "goal"})
    objects, moved = {item.name for item in scene.object}, driven_frames(subject)
    leading = [
        i
        for i, cost in enumerate(scene.cost)
        if cost.term == "distance"
        and any(pair <= names_in(cost.params) and pair & moved and not pair & objects for pair in pairs)
    ]
    if leading and 0.0 < spread[leading].sum() < LEADS * spread.sum():
        label, heaviest = labels[leading[0]], labels[int(np.argmax(spread))]
        yield Finding(
            f"cost.{label}.weight",
            f"{label} decides {spread[leading].sum() / spread.sum():.2%} of what tells samples apart, {heaviest} "
            f"{spread.max() / spread.sum():.0%}: plans do not go where success is",
            f"raise its weight, or lower that of {heaviest}",
        )


def term_costs(controller: Controller) -> np.ndarray:
    """Cost that each term added to samples of the last plan ``[n, terms]``, the best among them; none diverged."""
    engine, costs = controller.engine, controller.engine.cost.numpy()[0]
    chosen = np.unique([*np.linspace(0, len(costs) - 1, COMPARED).astype(int), np.argmin(costs)])
    rows = []
    for k in chosen[np.isfinite(costs[chosen])].tolist():
        engine.explain(wp.array(np.full(controller.envs, k), dtype=wp.int32, device=engine.device))
        rows.append(engine.term_cost.numpy()[0].copy())
    return np.array(rows, dtype=float).reshape(len(rows), len(controller.costs.labels))
