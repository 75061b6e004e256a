# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics against Newton's own, for every kind of joint and for real robots."""

from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from small_scenes import chain_scene, make_scene, random_state

from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.builder import build_world
from warpmpc.scene.model.joints import joint_table

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"


def robot_world(asset: str, *, floating: bool = False):
    """One Newton world with one robot, away from the origin and turned."""
    robot = {
        "name": "robot",
        "asset": asset,
        "floating": floating,
        "position": (0.3, -0.2, 0.9),
        "rotation": (0.2, 0.4, -0.1, 0.7),
        "drive": {"damping": 1.0, "limit": 1.0},
    }
    return build_world(make_scene(robot=[robot])).builder


def rotation(*q: float) -> wp.quat:
    return wp.normalize(wp.quat(*q))


def tree() -> newton.ModelBuilder:
    """Every kind of joint, with anchors turned and moved on both sides and centres of mass off the origins."""
    builder = newton.ModelBuilder()
    axis = newton.ModelBuilder.JointDofConfig
    rng = np.random.default_rng(7)

    def link() -> int:
        return builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), com=wp.vec3(*rng.normal(size=3)))

    def anchors() -> dict:
        return {
            f"{side}_xform": wp.transform(wp.vec3(*rng.normal(size=3)), rotation(*rng.normal(size=4)))
            for side in ("parent", "child")
        }

    def unit() -> wp.vec3:
        return wp.normalize(wp.vec3(*rng.normal(size=3)))

    root, *links = (link() for _ in range(8))
    first, second = unit(), unit()
    second = wp.normalize(wp.cross(first, second))  # Newton takes the axes of a D6 joint as orthogonal
    joints = [
        builder.add_joint_free(root, **anchors()),
        builder.add_joint_ball(root, links[0], **anchors()),
        builder.add_joint_d6(links[0], links[1], angular_axes=[axis(axis=a) for a in (first, second)], **anchors()),
        builder.add_joint_d6(
            links[1],
            links[2],
            linear_axes=[axis(axis=(1.0, 0.0, 0.0)), axis(axis=(0.0, 0.0, 1.0))],
            angular_axes=[axis(axis=(0.0, 0.0, 1.0)), axis(axis=(0.0, 1.0, 0.0)), axis(axis=(1.0, 0.0, 0.0))],
            **anchors(),
        ),
        builder.add_joint_prismatic(links[2], links[3], axis=unit(), **anchors()),
        builder.add_joint_fixed(links[3], links[4], **anchors()),
        builder.add_joint_revolute(links[4], links[5], axis=unit(), **anchors()),
        # a second branch
        builder.add_joint_ball(root, links[6], **anchors()),
    ]
    builder.add_articulation(joints)
    return builder


def joints_of(builder: newton.ModelBuilder) -> SimpleNamespace:
    """The joints of a builder as a layout holds them."""
    return SimpleNamespace(
        joint_type=np.array(builder.joint_type),
        joint_parent=np.array(builder.joint_parent),
        joint_child=np.array(builder.joint_child),
        joint_q_start=np.array(builder.joint_q_start),
        joint_qd_start=np.array(builder.joint_qd_start),
        joint_dof_dim=np.array(builder.joint_dof_dim).reshape(-1, 2),
        joint_pose_parent=np.array(builder.joint_X_p, dtype=np.float32),
        joint_pose_child=np.array(builder.joint_X_c, dtype=np.float32),
        dof_axis=np.array(builder.joint_axis, dtype=np.float32),
        body_com=np.array(builder.body_com, dtype=np.float32),
        mocap_body=np.zeros(0, dtype=np.int32),
        mocap=np.zeros((0, 7), dtype=np.float32),
        nm=0,
        nq=builder.joint_coord_count,
        nv=builder.joint_dof_count,
    )


MODELS = {
    "tree": lambda folder: tree(),
    "chain": lambda folder: build_world(chain_scene(folder)).builder,
    "omni": lambda folder: robot_world("omni_base.urdf"),
    "panda": lambda folder: robot_world(PANDA),
    "humanoid": lambda folder: robot_world("nv_humanoid.xml", floating=True),
}


@pytest.fixture(scope="module", params=MODELS)
def builder(request, tmp_path_factory):
    return MODELS[request.param](tmp_path_factory.mktemp("model"))


def test_poses_and_twists_are_newtons(builder):
    layout = joints_of(builder)
    model = builder.finalize(device="cpu")
    state = model.state()
    worlds = 4
    states = [random_state(layout, seed) for seed in range(worlds)]
    # the two slices must not be mixed up: the second holds the states of the first in another order
    q, qd = (np.stack([np.stack(a), np.stack(a[::-1])]) for a in zip(*states, strict=True))
    body_q = wp.zeros((2, worlds, model.body_count), dtype=wp.transform, device="cpu")
    body_qd = wp.zeros((2, worlds, model.body_count), dtype=wp.spatial_vector, device="cpu")
    wp.launch(
        forward_kinematics_kernel,
        dim=(2, worlds),
        inputs=[joint_table(layout, "cpu"), *(wp.array(a, dtype=float, device="cpu") for a in (q, qd))],
        outputs=[body_q, body_qd],
        device="cpu",
    )
    for t in range(2):
        for w in range(worlds):
            inputs = (wp.array(a[t, w], dtype=float, device="cpu") for a in (q, qd))
            newton.eval_fk(model, *inputs, state)
            for ours, theirs in ((body_q, state.body_q), (body_qd, state.body_qd)):
                expected = theirs.numpy()
                scale = max(1.0, np.abs(expected).max())
                np.testing.assert_allclose(ours.numpy()[t, w], expected, atol=2e-5 * scale)
