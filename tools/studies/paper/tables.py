# SPDX-License-Identifier: Apache-2.0
"""The tables of Pezzato et al., *Sampling-Based MPC Leveraging Parallelizable Physics Simulations* (RA-L 2025).

Beside them stand what Bhardwaj et al., *STORM* (CoRL 2021), show in figures, and the tasks of Howell et al.,
*Predictive Sampling* (2022).
Each table is a list of cells: scenes, changes to them, what is measured and what the paper reports. The paper's
figures are (mean,) or (mean, standard deviation) in the metric's unit, rates as fractions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One row of a table."""

    name: str
    title: str
    scenes: tuple[str, ...]
    """Scenes whose runs are put together."""
    overrides: tuple[str, ...] = ()
    """Changes ``KEY=VALUE``; a ``*`` stands for the entries that have the key."""
    paper: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Metric → the paper's figure."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table."""

    title: str
    metrics: tuple[str, ...]
    """Names in :data:`metrics.METRICS`, in the order of the columns."""
    runs: int
    """Seeds per scene when the command line does not say."""
    cells: tuple[Cell, ...]
    note: str = ""
    """What else the paper reports."""


def _cell(name: str, title: str, scene: str, **more: object) -> Cell:
    return Cell(name=name, title=title, scenes=(scene,), **more)


def _with_paper(*cells: Cell) -> tuple[Cell, ...]:
    """Cells, each followed by the paper's own terms, weights and planner: the variant ``paper`` of its scenes."""
    return tuple(twin for cell in cells for twin in (cell, _as_in_paper(cell)))


def _as_in_paper(cell: Cell) -> Cell:
    scenes = tuple(f"{scene}{'+' if ':' in scene else ':'}paper" for scene in cell.scenes)
    return replace(cell, name=f"{cell.name}_paper", title=f"{cell.title}, as in the paper", scenes=scenes)


def _pushes() -> tuple[Cell, ...]:
    """The five objects of Table III, each pushed to three goals."""
    success = {"A": 1.0, "B": 0.933, "C": 0.967, "D": 1.0, "E": 0.667}
    return tuple(
        Cell(
            name=name,
            title=f"object {name}",
            scenes=tuple(f"panda_push_objects:{name}_{goal}" for goal in ("left", "centre", "right")),
            paper={"success": (share,), "time": (3.0,)},
        )
        for name, share in success.items()
    )


PER_STEP = ("planner.knots=steps", "planner.spline=linear", "planner.noise.shape=identity")
"""A separate noise for every step of the horizon."""


def _paper_terms(metric: str) -> str:
    """The paper's cost of the omnidirectional push, weights too, in place of the scene's terms."""
    return (
        f'cost=[{{term="distance", between=["base/tip", "box"], weight=0.2, {metric}}}, '
        f'{{name="bring", term="distance", between=["box", "goal"], weight=2.0, {metric}}}, '
        '{term="yaw", of="box", to="goal", weight=3.0}, '
        f'{{term="push_alignment", pusher="base/tip", object="box", goal="goal", weight=0.6, {metric}}}, '
        '{name="base_contact", term="contact_force", between=["base", "obstacles"], weight=10.0}, '
        '{name="box_contact", term="contact_force", between=["box", "obstacles"], weight=10.0}]'
    )


STRAIGHT = 'metric="straight"'
GEODESIC = 'metric="geodesic", inflation=0.36'
"""Around the obstacles, grown for base and box alike."""


def _ablations() -> tuple[Cell, ...]:
    """The omnidirectional push with one thing less at a time, and with the paper's terms and planner."""
    less = {
        "full": ("as shipped", ()),
        "random": (
            "pseudo-random normals for every step: no Halton splines",
            ("planner.noise.source=random", *PER_STEP),
        ),
        "beta": ("β fixed", ("planner.temperature.eta=false",)),
        "worlds": ("every rollout in the nominal world: no randomization", ("planner.randomize=false",)),
        "redraw": ("the same samples at every plan", ("planner.noise.redraw=false",)),
        "geodesic": ("the paper's terms with geodesic distances", (_paper_terms(GEODESIC),)),
        "terms": ("the paper's terms", (_paper_terms(STRAIGHT),)),
    }
    return tuple(
        _cell(f"{variant}_{name}", f"start {variant}, {title}", f"omni_push_box:{variant}", overrides=overrides)
        for variant in "AB"
        for name, (title, overrides) in less.items()
    )


REDRAW = "randomize.*.redraw=true"
TWO_FRICTIONS = (
    *("object.block.friction=0.2", "randomize.block.friction.uniform=0.3"),
    "randomize.table={friction={uniform=0.9}, redraw=false}",
)
"""The paper's block and table, each with its own draw; they slide with the average."""


def _randomizations() -> tuple[Cell, ...]:
    """Pushes whose rollouts keep their worlds, and such that draw them anew in every plan."""
    scenes = {
        "A": ("omni_push_box:A", ()),
        "B": ("omni_push_box:B", ()),
        "arm": ("panda_push:pose_1", ()),
        "arm_two": ("panda_push:pose_1", TWO_FRICTIONS),
    }
    titles = {"A": "base, start A", "B": "base, start B", "arm": "arm", "arm_two": "arm, frictions of block and table"}
    changes = {"once": ("drawn once", ()), "redraw": ("drawn in every plan", (REDRAW,))}
    return tuple(
        _cell(f"{name}_{change}", f"{titles[name]}: {title}", scene, overrides=(*own, *more))
        for name, (scene, own) in scenes.items()
        for change, (title, more) in changes.items()
    )


SIMULATOR = ("engine.substeps=1", "plant.substeps=1")
"""One step of 0.04 s for a control, in rollouts and plant."""


def _paper_changes() -> tuple[Cell, ...]:
    """The paper's pushes of box, ball and blocks, and these with what its public code has and its text does not say."""
    inertia, friction = "object.box.inertia=[1.275, 0.675, 1.275]", "object.box.friction=0.65"
    contact = ("cost.base_contact.weight=0.01", "cost.box_contact.weight=0.01")
    box = {
        "paper": ("as in the paper", ()),
        "contact": ("contact weight 0.01 in place of 10", contact),
        "around": (
            "alignment measured around the walls, all else straight",
            ("cost.push_alignment.metric=geodesic", "cost.push_alignment.inflation=0.36"),
        ),
        "horizon": ("32 steps in place of 8", ("planner.horizon=32",)),
        "samples": ("3000 samples in place of 300", ("planner.samples=3000",)),
        "nominal": ("every rollout in the nominal world", ("planner.randomize=false",)),
        "inertia": ("inertia of a solid box of 45 kg", (inertia,)),
        "friction": ("friction 0.65: the mean of box and floor", (friction,)),
        "step": ("one physics step of 0.04 s", SIMULATOR),
        "simulator": ("inertia, friction and step", (inertia, friction, *SIMULATOR)),
        "both": ("inertia, friction, step, and contact weight 0.01", (inertia, friction, *SIMULATOR, *contact)),
    }
    inertia, align = "object.ball.inertia=[0.536, 0.536, 0.536]", "cost.push_alignment.weight=1.0"
    damping = "object.ball.angular_damping=0.5"
    ball = {
        "paper": ("as in the paper", ()),
        "align": ("align weight 1 in place of 0.1, as in its code", (align,)),
        "inertia": ("inertia of a solid ball of 34 kg", (inertia,)),
        "friction": ("align weight 1, friction 0.65: the mean of ball and floor", (align, "object.ball.friction=0.65")),
        "both": ("align weight 1, inertia of a solid ball of 34 kg", (align, inertia)),
        "damping": ("angular damping 0.5", (damping,)),
        "inertia_damping": ("inertia of a solid ball of 34 kg, angular damping 0.5", (inertia, damping)),
        "all": ("align weight 1, inertia and angular damping", (align, inertia, damping)),
    }
    block = {
        "paper": ("as in the paper", ()),
        "align": ("align weight 4.5 in place of 45", ("cost.push_alignment.weight=4.5",)),
        "inertia": ("inertia of a solid block of 0.8 kg", ("object.block.inertia=[0.00115, 0.00115, 0.00181]",)),
    }
    pushes = _pushes()[0].scenes  # object A
    starts = {"box": ("omni_push_box:A", "omni_push_box:B"), "ball": ("omni_push_sphere:A", "omni_push_sphere:B")}
    return tuple(
        Cell(
            name=f"{thing}_{name}",
            title=f"{thing}, {title}",
            scenes=tuple(f"{scene}+paper" for scene in scenes),
            overrides=overrides,
        )
        for thing, scenes, changes in (
            ("box", starts["box"], box),
            ("ball", starts["ball"], ball),
            ("block", pushes, block),
        )
        for name, (title, overrides) in changes.items()
    )


def _sampling() -> tuple[Cell, ...]:
    """The four ways to draw samples of STORM's Fig. 3."""
    shapes, sources = {"comb": "comb filter", "bspline": "B-spline"}, {"random": "pseudo-random", "halton": "Halton"}
    return tuple(
        _cell(
            f"{source}_{shape}",
            f"{points}, {how}",
            "holonomic_2d",
            overrides=(f"planner.noise.source={source}", f"planner.noise.shape={shape}"),
        )
        for shape, how in shapes.items()
        for source, points in sources.items()
    )


ILQG = tuple(
    _cell(
        f"{name}_ilqg",
        f"{robot}, iLQG: model, terms and horizon of the row of ours",
        f"{name}_reach",
        overrides=("planner.method=ilqg",),
        paper={"time": (time,), "solver": (solver,)},
    )
    for name, robot, time, solver in (("point", "point robot", 6.1, 2.5), ("panda", "Panda", 4.2, 51.0))
)
"""An optimization-based MPC with the same model: stands for the paper's ForcesPro, whose figures are beside it.

ForcesPro is commercial, and takes spheres as constraints where iLQG has the scene's costs. Optimization fabrics
play the same tasks in ``tools/study.py paths --fabrics``."""


TABLES = {
    "table1": Table(
        title="Table I: motion planning among five random spheres",
        metrics=("success", "free", "time", "solver", "path", "clearance"),
        runs=100,
        cells=(
            *_with_paper(
                _cell("point", "point robot", "point_reach", paper={"time": (2.7,), "solver": (55.0,)}),
                _cell("panda", "Panda", "panda_reach", paper={"time": (0.8,), "solver": (63.0,)}),
            ),
            *ILQG,
        ),
        note="The paper's other methods, point robot and Panda: optimization fabrics 7.4 and 9.6 s to the goal, "
        "1.0 and 1.4 ms a plan; ForcesPro MPC 6.1 and 4.2 s, 2.5 and 51 ms.",
    ),
    "table2": Table(
        title="Table II: the Panda pushes a block to two poses",
        metrics=("cost_then", "cost", "success", "time", "solver"),
        runs=10,
        cells=_with_paper(
            _cell("pose_1", "pose 1", "panda_push:pose_1", paper={"cost_then": (0.029, 0.09), "cost": (0.029, 0.09)}),
            _cell("pose_2", "pose 2", "panda_push:pose_2", paper={"cost_then": (0.03, 0.12), "cost": (0.03, 0.12)}),
        ),
        note="Cost: 1.5 (|ex| + |ey|) + 0.01 |eψ|, in metres and radians; a run ends where all is within 9 mm and "
        "0.1 rad, a limit of ours. The paper took about 8 s; its baseline, a learned model, about four minutes to .057 "
        "and .079.",
    ),
    "table3": Table(
        title="Table III: the Panda pushes five objects to three goals",
        metrics=("success", "time", "solver"),
        runs=10,
        cells=_with_paper(*_pushes()),
        note="The paper's baseline over objects A to E: 93.5, 90.9, 93.9, 91.6 and 89.5 %, 24 s a push.",
    ),
    "table4": Table(
        title="Table IV: non-prehensile pushing by mobile bases",
        metrics=("success", "time", "solver"),
        runs=5,
        cells=_with_paper(
            _cell("box_A", "omnidirectional base, box, start A", "omni_push_box:A", paper={"time": (9.66, 0.84)}),
            _cell("box_B", "omnidirectional base, box, start B", "omni_push_box:B", paper={"time": (12.84, 0.56)}),
            _cell("sphere_A", "omnidirectional base, sphere, A", "omni_push_sphere:A", paper={"time": (8.76, 0.38)}),
            _cell("sphere_B", "omnidirectional base, sphere, B", "omni_push_sphere:B", paper={"time": (7.45, 0.59)}),
            _cell("diff_drive", "differential drive, box", "diff_push_box", paper={"time": (18.31,)}),
        ),
    ),
    "pick": Table(
        title="Whole-body pick and place with a mobile manipulator",
        metrics=("success", "time", "solver"),
        runs=10,
        cells=(
            *_with_paper(_cell("pick", "mobile manipulator", "mobile_pick", paper={"time": (15.67, 7.21)})),
            _cell("knocked", "the cube knocked away", "mobile_pick:knocked"),
        ),
    ),
    "ablations": Table(
        title="What each part is worth: the omnidirectional push with one thing less",
        metrics=("success", "time", "solver"),
        runs=10,
        cells=_ablations(),
    ),
    "randomization": Table(
        title="Rollouts' worlds: drawn once, or anew in every plan",
        metrics=("success", "error", "time", "solver"),
        runs=20,
        cells=_randomizations(),
    ),
    "changes": Table(
        title="Tables III and IV as in the paper: what stops them, one change at a time",
        metrics=("success", "error", "time", "solver"),
        runs=5,
        cells=_paper_changes(),
        note="The paper: box 9.66 s from A, 12.84 s from B, ball 8.76 and 7.45 s.",
    ),
    "disturbances": Table(
        title="Disturbances: pushes by the base and by the arm, kicked, shoved and with noisy observations",
        metrics=("success", "time", "solver"),
        runs=10,
        cells=(
            _cell("kicked", "box kicked", "omni_push_box:kicked"),
            _cell("shoved", "base pushed away", "omni_push_box:shoved"),
            _cell("noisy", "noisy, late observations", "omni_push_box:noisy"),
            _cell("arm_kicked", "the block kicked away from the arm", "panda_push:kicked"),
            _cell("arm_shoved", "the arm shoved", "panda_push:shoved"),
        ),
    ),
    "sampling": Table(
        title="STORM, Fig. 3: four ways to draw samples",
        metrics=("success", "free", "time", "path", "jerk", "rate", "clearance"),
        runs=50,
        cells=_sampling(),
        note="Bhardwaj et al. (CoRL 2021) show one run of each, without figures.",
    ),
    "mjpc": Table(
        title="MuJoCo MPC: humanoid, quadruped and hand",
        metrics=("success", "time", "turns", "solver"),
        runs=10,
        cells=_with_paper(
            _cell("stand", "a humanoid keeps standing", "humanoid_stand"),
            _cell("get_up", "a humanoid gets up", "humanoid_get_up"),
            _cell("quadruped", "a quadruped walks to waypoints", "quadruped_walk"),
            _cell("terrain", "a quadruped climbs a slope", "quadruped_terrain"),
            _cell("hand", "a hand turns a cube", "hand_cube"),
        ),
        note="Howell et al. (2022) show these tasks without rates of success. Rows as in the paper plan every 1 or 2 "
        "ms of simulated time, as its planner does on a clock that is slowed down.",
    ),
}
"""Tables by name."""

GROUPS = {"pezzato": ("table1", "table2", "table3", "table4", "pick")}
GROUPS["papers"] = (*GROUPS["pezzato"], "disturbances", "sampling", "mjpc")
"""Tables by the name of several."""
