# SPDX-License-Identifier: Apache-2.0
"""Random rollouts among obstacles of every shape, judged by cost terms."""

import numpy as np
from evaluating import Evaluating
from scipy.spatial.transform import Rotation
from small_scenes import BOX, DISC, WALL, make_scene

from warpmpc.scene.model.trajectory import BatchSize

TURN = (0.2, -0.4, 0.1, 0.9)
OBSTACLES = [
    {**WALL, "rotation": TURN},
    {"name": "ball", "shape": "sphere", "size": (0.3,), "position": (-1.0, 0.5, 0.1)},
    {"name": "can", "shape": "cylinder", "size": (0.2, 0.6), "position": (0.0, -1.0, 0.3), "rotation": TURN},
    {"name": "pill", "shape": "capsule", "size": (0.1, 0.5), "position": (0.5, 1.0, 0.2), "rotation": (0, 0.6, 0, 0.8)},
    {"name": "slope", "shape": "plane", "position": (0.0, 0.0, -2.0), "rotation": TURN},
]
SHAPE = BatchSize(2, 3, 2, 5)


class Rollouts(Evaluating):
    """Random rollouts of a small scene, judged by its cost terms."""

    def __init__(
        self,
        *costs: dict,
        seed: int = 0,
        terms=(),
        scale: float = 1.0,
        obstacles=OBSTACLES,
        objects=(BOX,),
        shape=SHAPE,
        **sections,
    ):
        robot = {**DISC, "joint_q": (0.3, -0.2, 0.5), "drive": {**DISC["drive"], "limit": (1.0, 2.0, 0.5)}}
        scene = make_scene(
            robot=[robot],
            object=list(objects),
            obstacle=obstacles,
            cost=costs,
            goal={"object": "box", "position": (1, 2, 0.5)},
            **sections,
        )
        super().__init__(scene, shape, terms=terms)
        self.t, self.w = shape.horizon, shape.worlds
        rng = np.random.default_rng(seed)
        for array in vars(self.trajectory).values():
            if array.dtype is not int and array.size:
                array.assign(scale * rng.normal(size=array.numpy().shape).astype(np.float32))
        turns = Rotation.random(self.trajectory.body_q.size, rng=rng).as_quat()
        body_q = self.trajectory.body_q.numpy()
        body_q[..., 3:] = turns.reshape(*body_q.shape[:-1], 4)
        self.control.assign(rng.normal(size=(self.t, self.w, 3)).astype(np.float32))
        self.goal = np.concatenate([rng.normal(size=(2, 3)), Rotation.random(2, rng=rng).as_quat()], axis=1)
        self.set_goal(self.goal)
        self.state.last_control.assign(rng.normal(size=(2, 3)).astype(np.float32))

    def cost(self, term: int = 0) -> np.ndarray:
        """Weighted cost of every step and world, ``[T, W]``."""
        return super().cost()[term]

    def pose(self, frame: str) -> tuple[np.ndarray, Rotation]:
        """Position ``[T, W, 3]`` and rotation of a frame after every control, in float64."""
        index = self.layout.frame(frame)
        body = self.layout.frame_body[index]
        local = self.layout.frame_pose[index].astype(np.float64)
        if body == -2:
            base = np.broadcast_to(np.repeat(self.goal, self.shape.rollouts, axis=0), (self.t, self.w, 7))
        elif body == -1:
            base = np.broadcast_to([0, 0, 0, 0, 0, 0, 1.0], (self.t, self.w, 7))
        else:
            base = self.trajectory.body_q.numpy()[1:, :, body].astype(np.float64)
        turn = Rotation.from_quat(base[..., 3:].reshape(-1, 4))
        position = base[..., :3] + turn.apply(local[:3]).reshape(self.t, self.w, 3)
        return position, turn * Rotation.from_quat(local[3:])

    def each(self, values: np.ndarray) -> np.ndarray:
        """Values of flattened steps and worlds as ``[T, W]``."""
        return np.asarray(values).reshape(self.t, self.w)


def heading(r: Rotation) -> np.ndarray:
    x = r.apply([1.0, 0.0, 0.0])
    return np.arctan2(x[:, 1], x[:, 0])
