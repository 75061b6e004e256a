# SPDX-License-Identifier: Apache-2.0
"""The engine ``kinematic``: its rollouts against the plain kernels, on arms, a mobile base and other trees.

Slow ones by hand: pytest -m slow tests/engine/test_kinematic.py
"""

import numpy as np
import pytest
import trimesh
import warp as wp
from needs import CUDA, need
from small_scenes import BOX, make_scene

import warpmpc
from warpmpc import Controller, SceneError, State
from warpmpc.cost.stack import CostEvaluator
from warpmpc.scene.model.trajectory import BatchSize

ROBOTS = {
    "panda": ("package://example-robot-data/robots/panda_description/urdf/panda.urdf", "panda_hand_tcp", None),
    "ur10": ("package://example-robot-data/robots/ur_description/urdf/ur10_robot.urdf", "tool0", None),
    "kinova": ("package://example-robot-data/robots/kinova_description/robots/kinova.urdf", "j2s6s200_link_6", None),
    "mobile_panda": ("mobile_panda.xml", "panda_hand", None),
}
SOME = ["panda", "mobile_panda", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ur10", "kinova"))]
GROWING = {"first": 0.02, "last": 0.2, "constant": 4}
NATIVE = [
    {"term": "distance", "between": ["arm/tool", "goal"], "weight": 2.0},
    {"term": "distance", "name": "coasting", "between": ["arm/tool", "goal"], "lead": 0.1},
    {"term": "distance", "name": "pull", "between": ["arm/tool", "goal"], "near": 0.3},
    {"term": "height", "of": "arm/tool", "target": 0.4},
    {"term": "orientation", "of": "arm/tool", "to": "goal"},
    {"term": "orientation", "name": "tilt", "of": "arm/tool", "to": "goal", "tilt": True},
    {"term": "orientation", "name": "up", "of": "arm/tool", "axis": (1.0, 0.0, 0.2)},
    {"term": "joint_limit", "margin": 0.3},
    {"term": "joint_velocity", "weight": 0.01},
    {"term": "posture", "weight": 0.1},
    {"term": "control_effort", "weight": 0.02},
    {"term": "control_rate", "weight": 0.03},
    {"term": "yaw", "of": "arm/tool", "to": "goal", "near": 0.5, "weight": 3.0},
    {"term": "approach", "hand": "arm/tool", "object": "box", "width": 0.5, "rise": 0.3},
    {"term": "finger_alignment", "hand": "arm/tool", "object": "box"},
]
FEW = [cost for cost in NATIVE if cost["term"] in ("distance", "posture", "joint_velocity", "control_rate")]
ARM = [
    {"term": "pose", "of": "arm/tool", "position": (3.0, 2.0, 1.0), "rotation": (0.5, 0.0, 0.2)},
    {"term": "stop", "acceleration": 0.4},
    {"term": "manipulability", "of": "arm/tool", "least": 0.2},
    {"term": "manipulability", "name": "step", "of": "arm/tool", "least": 0.1, "form": "step"},
    {"term": "joint_bounds", "margin": 0.3, "velocity": 0.4, "acceleration": 1.0, "jerk": 10.0},
    {"term": "null_posture", "of": "arm/tool"},
    {"term": "path_deviation", "of": "arm/tool", "start": "arm"},
    {"term": "path_deviation", "name": "straight", "of": "arm/tool"},
    {"term": "speed", "of": "arm/tool", "linear": 0.1, "angular": 0.2},
    {"term": "smoothness", "acceleration": 0.01, "jerk": 1e-4},
]
TURN = (0.2, 0.0, 0.4, 0.9)
OBSTACLES = [
    {"name": "block", "shape": "box", "size": (0.1, 0.2, 0.4), "position": (0.4, 0.1, 0.3), "movable": True},
    {"name": "turned", "shape": "box", "size": (0.1, 0.2, 0.4), "position": (-0.3, 0.3, 0.4), "rotation": TURN},
    {"name": "ball", "shape": "sphere", "size": (0.1,), "position": (0.2, -0.3, 0.6)},
    {"name": "pillar", "shape": "cylinder", "size": (0.06, 0.8), "position": (0.4, -0.4, 0.4)},
    {"name": "rail", "shape": "capsule", "size": (0.04, 0.5), "position": (0.5, 0.3, 0.6), "rotation": TURN},
]
COM = {"centre_of_mass": "arm"}
RESIDUALS = [
    {"term": "position_residual", "of": [COM, "arm/tool"], "lead": 0.2, "relative_to": "goal", "norm": "quadratic"},
    {"term": "velocity_residual", "of": COM, "axes": "xy", "norm": {"kind": "smooth_abs", "p": 0.1}, "terminal": 5.0},
    {"term": "angular_velocity_residual", "of": "arm/tool", "target": 0.1},
    {"term": "angular_momentum_residual", "of": "arm", "norm": {"kind": "l2", "p": 0.1}},
    {"term": "rotation_residual", "of": "arm/tool", "axes": "z"},
    {"term": "posture_residual", "norm": {"kind": "power", "p": 1.5}},
    {"term": "joint_velocity_residual"},
    {"term": "control_residual", "norm": {"kind": "cosh", "p": 2.0}},
]
COLLISION = [
    {"term": "self_collision", "margin": 0.15},
    {"term": "world_collision", "margin": 0.2, "against": ["obstacles", "objects", "ground"]},
    {"term": "world_collision", "name": "hit", "form": "binary", "margin": 0.02},
]
WARP = [{"term": "low", "frame": "arm/tool", "weight": 3.0}]


@wp.struct
class LowParams:
    frame: int


@warpmpc.cost_term("low")
def low(s: warpmpc.StepView, p: LowParams) -> float:
    return warpmpc.frame_position(s, p.frame)[2] ** 2.0


@warpmpc.cost_term("quick")
def quick(s: warpmpc.StepView, p: LowParams) -> float:
    angular = warpmpc.frame_angular_acceleration(s, p.frame)
    return wp.length(warpmpc.frame_acceleration(s, p.frame)) + 0.1 * wp.length_sq(angular)


def scene_of(robot: str, mode: str = "acceleration", cost: list = NATIVE, obstacles: list = (), **planner):
    asset, link, joints = ROBOTS[robot]
    drive = {"mode": mode, "damping": 100.0, "stiffness": 100.0 if mode == "position" else 0.0, "limit": 3.0}
    return make_scene(
        robot=[
            {
                "name": "arm",
                "asset": asset,
                "gravity_compensation": True,
                "frames": {"tool": {"link": link, "offset": (0.02, 0.0, 0.05), "rotation": (0.0, 0.6, 0.0, 0.8)}},
                "drive": drive | ({"joints": joints} if joints else {}),
            }
        ],
        object=[BOX],
        obstacle=obstacles,
        goal={"frame": "arm/tool", "position": (0.5, 0.3, 0.4), "rotation": (1.0, 0.0, 0.0, 0.0)},
        cost=cost,
        planner={"samples": 37, "horizon": 11, "dt": GROWING, "noise": {"sigma": 0.8, "redraw": True}, **planner},
    )


def planned(scene, *, envs: int = 1, terms=(), seed: int = 0, device: str = "cpu"):
    """A controller after two plans from a moving start, and what the plain kernels say about its last samples."""
    mpc = Controller(scene, engine="kinematic", device=device, envs=envs, seed=seed, terms=terms)
    rng, layout = np.random.default_rng(seed), mpc.layout
    q = np.tile(layout.joint_q, (envs, 1))
    driven = layout.dof_coord[layout.actuator_dof]
    q[:, driven] += rng.normal(0.0, 0.3, (envs, len(driven)))
    qd = np.zeros((envs, layout.nv))
    qd[:, layout.actuator_dof] = rng.normal(0.0, 0.3, (envs, len(driven)))
    state = State(q, qd) if envs > 1 else State(q[0], qd[0])
    mpc.step(state)
    mpc.step(state)
    engine, shape = mpc.engine, mpc.shape
    trajectory = engine.rollouts(range(shape.worlds))
    whole = BatchSize(envs, shape.samples, 1, shape.horizon)
    evaluator = CostEvaluator(mpc.costs, trajectory, trajectory.control, engine.state, whole, mpc.plan_step.grid.t)
    evaluator.launch()
    expected = (evaluator.cost.numpy() * mpc.plan_step.grid.discount[None, :, None]).sum(axis=1)
    return mpc, expected


def check(mpc, expected, rtol: float = 2e-5):
    found = mpc.engine.total.numpy()
    scale = 1.0 + np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, atol=rtol)
    np.testing.assert_allclose(mpc.engine.cost.numpy().ravel(), found.sum(axis=0), rtol=1e-5)


@pytest.mark.parametrize("robot", SOME)
def test_baked_rollouts_cost_what_the_plain_kernels_say(robot):
    for seed in range(2):
        mpc, expected = planned(scene_of(robot), seed=seed)
        assert not mpc.engine.records
        assert (expected.max(axis=1) > 0.0).sum() >= len(NATIVE) - 1  # not every arm has limits within reach
        check(mpc, expected)


@pytest.mark.parametrize(("robot", "mode"), [("panda", "acceleration"), ("mobile_panda", "velocity")])
def test_terms_of_an_arm_cost_what_the_plain_kernels_say(robot, mode):
    for seed in range(2):
        mpc, expected = planned(scene_of(robot, mode, ARM), seed=seed)
        assert not mpc.engine.records
        assert (expected.max(axis=1) > 0.0).sum() >= len(ARM) - 1  # the wide reach of a mobile arm
        check(mpc, expected, 2e-4)  # manipulability and null space lose digits in single precision


def test_residuals_cost_what_the_plain_kernels_say():
    mpc, expected = planned(scene_of("panda", cost=RESIDUALS), envs=2)
    assert not mpc.engine.records
    assert (np.ptp(expected, axis=1) > 1e-3).all()
    check(mpc, expected, 5e-5)


@pytest.mark.parametrize("robot", SOME)
def test_collisions_cost_what_the_plain_kernels_say(robot):
    for seed in range(2):
        mpc, expected = planned(scene_of(robot, cost=COLLISION, obstacles=OBSTACLES), envs=2, seed=seed)
        assert not mpc.engine.records
        assert (expected.max(axis=1) > 0.0).sum() >= 2
        check(mpc, expected)


@pytest.mark.parametrize("robot", ["panda", pytest.param("mobile_panda", marks=pytest.mark.slow)])
def test_swept_collisions_cost_what_the_plain_kernels_say_but_for_an_eighth_of_a_radius(robot):
    wall = {"name": "wall", "shape": "box", "size": (0.01, 1.0, 1.0), "position": (0.45, 0.0, 0.5)}
    swept = {"term": "world_collision", "margin": 0.1, "swept": True, "against": ["obstacles", "ground"]}
    hit = {**swept, "name": "hit", "form": "binary", "margin": 0.0}
    for seed in range(2):
        scene = scene_of(robot, cost=[swept, hit], obstacles=[wall, *OBSTACLES[1:]], noise={"sigma": 2.0})
        mpc, expected = planned(scene, envs=2, seed=seed)
        assert not mpc.engine.records
        found, steps = mpc.engine.total.numpy(), mpc.plan_step.grid.discount.sum()
        assert expected[0].max() > 0.05
        np.testing.assert_allclose(found[0], expected[0], atol=0.125 * 0.12 * steps)  # no sphere is larger
        assert np.abs(found[0] - expected[0]).mean() < 1e-3 * steps
        differ = np.abs(found[1] - expected[1]) > 1e-4
        assert differ.mean() < 0.05  # those that graze


def test_meshes_cost_what_the_plain_kernels_say(tmp_path):
    trimesh.creation.icosphere(2, radius=0.15).export(tmp_path / "rock.stl")
    trimesh.creation.box((0.2, 0.3, 0.1)).export(tmp_path / "block.stl")
    obstacles = [
        {"name": "rock", "shape": "mesh", "mesh": str(tmp_path / "rock.stl"), "position": (0.4, 0.1, 0.4)},
        {"name": "block", "shape": "mesh", "mesh": str(tmp_path / "block.stl"), "position": (-0.3, 0.3, 0.4)},
    ]
    obstacles[1] |= {"rotation": TURN, "movable": True}
    still = {"term": "world_collision", "margin": 0.1}
    for seed in range(2):
        cost = [still, {**still, "name": "swept", "swept": True}]
        scene = scene_of("panda", cost=cost, obstacles=[*obstacles, OBSTACLES[2]], noise={"sigma": 2.0})
        mpc, expected = planned(scene, envs=2, seed=seed)
        assert not mpc.engine.records
        assert (expected > 0.05).any(axis=1).all()
        found = mpc.engine.total.numpy()
        np.testing.assert_allclose(found[0], expected[0], atol=2e-5 * (1.0 + expected[0].max()))
        # a sphere is moved on by separate steps in each of the two
        differ = np.abs(found[1] - expected[1]) / mpc.plan_step.grid.discount.sum()
        assert differ.max() < 0.125 * 0.12
        assert differ.mean() < 1e-3


@pytest.mark.parametrize(
    ("mode", "spline"),
    [
        *(("acceleration", spline) for spline in ("zero", "linear", "cubic", "bspline")),
        ("velocity", "zero"),
        ("velocity", "bspline"),
        ("position", "linear"),
    ],
)
def test_every_drive_and_spline_moves_the_joints_alike(mode, spline):
    mpc, expected = planned(scene_of("panda", mode, FEW, spline=spline, knots=5), envs=2)
    check(mpc, expected)


@pytest.mark.parametrize("robot", ["panda", pytest.param("mobile_panda", marks=pytest.mark.slow)])
def test_terms_without_baked_source_are_judged_on_the_record_of_the_same_launch(robot):
    mpc, expected = planned(scene_of(robot, cost=FEW + WARP), envs=2, terms=[low])
    assert mpc.engine.records
    check(mpc, expected)
    plain = mpc.engine.rollouts(range(mpc.shape.worlds))
    recorded = mpc.engine.recorded
    for name in ("joint_q", "body_q", "body_qd"):
        a, b = getattr(plain, name).numpy()[1:], getattr(recorded, name).numpy()[1:]
        if name == "body_q":  # both signs of a quaternion are one rotation
            b = b.copy()
            b[..., 3:] *= np.sign((a[..., 3:] * b[..., 3:]).sum(axis=-1, keepdims=True))
        np.testing.assert_allclose(a, b, atol=1e-5, err_msg=name)


def test_users_terms_of_both_kinds_are_judged():
    @warpmpc.array_cost("still")
    def still(batch):
        return (batch["joint_qd"][1:] ** 2).sum(axis=-1)

    cost = [*FEW, *WARP, {"term": "still"}]
    mpc, expected = planned(scene_of("panda", cost=cost), terms=(low, still))
    speed = mpc.engine.recorded.joint_qd.numpy()[1:] ** 2
    expected[-1] = (speed.sum(axis=-1) * mpc.plan_step.grid.discount[:, None]).sum(axis=0)
    check(mpc, expected)


@pytest.mark.parametrize("mode", ["acceleration", "velocity"])
def test_accelerations_of_frames_are_part_of_the_launch(mode):
    mpc, expected = planned(scene_of("panda", mode, cost=QUICK), envs=2, terms=(quick,))
    assert not mpc.engine.records
    check(mpc, expected)


def test_the_plan_is_the_same_for_any_number_of_threads():
    plans = []
    for threads in (1, 2, 3):
        scene = scene_of("panda")
        scene = scene.model_copy(update={"engine": scene.engine.model_copy(update={"threads": threads})})
        mpc, _ = planned(scene, envs=3)
        plans.append(mpc.plan_step.command.numpy())
    np.testing.assert_array_equal(plans[0], plans[1])
    np.testing.assert_array_equal(plans[0], plans[2])


def test_weights_and_goals_change_between_plans():
    mpc, _ = planned(scene_of("panda"))
    state = State.start(mpc.layout)
    mpc.step(state)
    far = mpc.info.terms["distance"]
    mpc.task["goal"] = [0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 1.0]
    mpc.step(state)
    assert mpc.info.terms["distance"] > far + 10.0
    mpc.task["distance"] = 0.0
    mpc.step(state)
    assert mpc.info.terms["distance"] == 0.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drive": {"mode": "effort", "limit": 1.0}}, "no forces"),
        ({"cost": [{"term": "contact_force", "between": ["arm", "box"]}]}, "contact forces"),
        ({"planner": {"domains": 2, "samples": 8, "horizon": 4}}, "domains = 1"),
    ],
)
def test_what_needs_physics_is_refused(changes, said):
    scene = scene_of("panda")
    if "drive" in changes:
        drive = scene.robot[0].drive[0].model_validate(changes.pop("drive"))
        changes["robot"] = [scene.robot[0].model_copy(update={"drive": (drive,)}).model_dump()]
    data = {**scene.model_dump(exclude={"path"}), **changes}
    with pytest.raises(SceneError, match=said):
        Controller(type(scene).model_validate(data), engine="kinematic", device="cpu")


QUICK = [*FEW, {"term": "quick", "frame": "arm/tool"}]
GPU_COSTS = {"in launch": NATIVE, "recorded": [*NATIVE, *WARP], "arm": ARM, "collision": COLLISION, "quick": QUICK}


@pytest.mark.gpu
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("cost", GPU_COSTS)
def test_gpu_rollouts_cost_what_the_plain_kernels_say(robot, cost):
    need(CUDA)
    modes = ("acceleration", "velocity", "position") if cost in ("in launch", "recorded") else ("acceleration",)
    for mode in modes:
        scene = scene_of(robot, mode, GPU_COSTS[cost], OBSTACLES, horizon=40)
        mpc, expected = planned(scene, envs=2, terms=[low, quick], device="cuda")
        assert mpc.graph.captured is not None
        check(mpc, expected, 2e-4 if cost in ("arm", "quick") else 2e-5)


@pytest.mark.gpu
def test_swept_collisions_on_a_gpu_are_those_of_the_cpu():
    need(CUDA)
    swept = {"term": "world_collision", "margin": 0.1, "swept": True, "against": ["obstacles", "ground"]}
    scene = scene_of("panda", cost=[swept], obstacles=OBSTACLES, noise={"sigma": 2.0}, horizon=40)
    costs = [planned(scene, envs=2, device=device)[0].engine.cost.numpy() for device in ("cpu", "cuda")]
    assert costs[0].max() > 0.05
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-3, atol=1e-3)
