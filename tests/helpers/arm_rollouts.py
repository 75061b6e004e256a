# SPDX-License-Identifier: Apache-2.0
"""Random rollouts of arms on uneven steps, in two environments, judged by cost terms."""

from __future__ import annotations

import numpy as np
import warp as wp
from evaluating import Evaluating
from jacobians import mujoco_jacobians
from scipy.spatial.transform import Rotation
from small_scenes import layout_of, make_scene

from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(2, 3, 2, 6)
DT = np.array([0.02, 0.02, 0.02, 0.04, 0.08, 0.2])
"""Steps of growing length [s]."""
ARM = {
    "name": "arm",
    "asset": "assets/panda.urdf",
    "joint_q": (0.1, -0.4, 0.2, -1.9, 0.3, 1.6, 0.5),
    "frames": {"tip": {"link": "panda_link7", "offset": (0.02, -0.05, 0.15), "rotation": (0.3, 0.1, -0.2, 0.9)}},
    "drive": {"damping": 50.0, "limit": (2.0, 2.0, 1.5, 1.5, 1.0, 1.0, 1.0)},
}
MOBILE = {
    "name": "arm",
    "asset": "assets/mobile_panda.xml",
    "frames": {"tip": {"link": "panda_hand", "offset": (0.0, 0.0, 0.103), "rotation": (1.0, 0.0, 0.0, 0.0)}},
    "drive": {"damping": 50.0, "limit": 1.0},
}
"""An arm on a base of two slides and a hinge, with two fingers that slide."""
ROBOTS = {"arm": ARM, "mobile": MOBILE}


class ArmRollouts(Evaluating):
    """Random rollouts of a robot whose frame ``arm/tip`` is to come to a goal past a target ``gate``."""

    def __init__(
        self,
        robot: dict,
        *costs: dict,
        seed: int = 0,
        device: str = "cpu",
        accelerations: bool = False,
        flat: bool = False,
    ):
        planner = {"samples": 3, "horizon": SHAPE.horizon, "dt": tuple(DT)}
        goal = {"frame": "arm/tip", "position": (0.5, 0.3) if flat else (0.5, 0.3, 0.4)}
        target = [{"name": "gate", "position": (0.4, -0.2, 0.6), "rotation": (0.1, 0.2, 0.3, 0.9)}]
        scene = make_scene(robot=[robot], ground=None, goal=goal, target=target, cost=costs, planner=planner)
        layout = layout_of(scene)
        if accelerations:  # what a drive of accelerations would say of itself
            layout = layout.replace(actuator_mode=("acceleration",) * len(layout.actuator_mode))
        super().__init__(scene, SHAPE, device=device, layout=layout)
        rng = np.random.default_rng(seed)
        self.t, self.w = SHAPE.horizon, SHAPE.worlds
        shape = (self.t + 1, self.w)
        self.q = rng.normal(size=(*shape, self.layout.nq)).astype(np.float32)
        self.qd = rng.normal(size=(*shape, self.layout.nv)).astype(np.float32)
        self.move()
        self.control.assign(rng.normal(size=(self.t, self.w, self.layout.nu)).astype(np.float32))
        self.goal = np.concatenate([0.5 * rng.normal(size=(2, 3)), Rotation.random(2, rng=rng).as_quat()], axis=1)
        self.set_goal(self.goal)
        self.state.last_control.assign(rng.normal(size=(2, self.layout.nu)).astype(np.float32))

    def move(self) -> None:
        """Put the bodies where the joints say."""
        out = self.trajectory
        out.joint_q.assign(self.q)
        out.joint_qd.assign(self.qd)
        inputs = [joint_table(self.layout, self.device), out.joint_q, out.joint_qd]
        launch = [forward_kinematics_kernel, self.q.shape[:2], inputs, [out.body_q, out.body_qd]]
        wp.launch(*launch, device=self.device)

    def value(self) -> np.ndarray:
        """Weighted cost of the first term ``[T, W]``."""
        return self.cost()[0]

    def pose(self, frame: str, *, first: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Position ``[T, W, 3]`` and rotation matrix ``[T, W, 3, 3]`` of a frame after every control, or at first."""
        index = self.layout.frame(frame)
        body = int(self.layout.frame_body[index])
        steps = slice(0, 1) if first else slice(1, None)
        if body == -2:
            base = np.repeat(self.goal, SHAPE.rollouts, axis=0)[None]
        elif body < -2:
            base = np.array([[self.task["gate"]]], dtype=np.float64).reshape(-1, 7)[None, :1]
        else:
            base = self.trajectory.body_q.numpy()[steps, :, body].astype(np.float64)
        base = np.broadcast_to(base, (1 if first else self.t, self.w, 7))
        local = self.layout.frame_pose[index].astype(np.float64)
        turn = Rotation.from_quat(base[..., 3:].reshape(-1, 4))
        position = base[..., :3] + turn.apply(local[:3]).reshape(base.shape[:2] + (3,))
        matrix = (turn * Rotation.from_quat(local[3:])).as_matrix()
        return position, matrix.reshape(base.shape[:2] + (3, 3))

    def jacobian(self) -> np.ndarray:
        """Jacobians ``[T, W, 6, nv]`` of the tip after every control, by MuJoCo."""
        return mujoco_jacobians(self.scene, "arm/tip", self.q[1:].astype(np.float64))
