# SPDX-License-Identifier: Apache-2.0
"""Paths of rollouts as markers, over real ROS 2 in this process."""

import os
import time

import numpy as np
import pytest
from needs import needs
from small_scenes import compiled, make_scene

from warpmpc.extras.ros2.settings import Ros2Settings
from warpmpc.planner.controller.rollout_paths import BEST_COLOR, RolloutPaths

pytestmark = needs("rclpy")

SCENE = make_scene()
KIND = "visualization_msgs/MarkerArray"


@pytest.fixture
def ends():
    """A driver of the scene, and what hears its markers."""
    from warpmpc.extras.ros2.connection import Connection, Inbox
    from warpmpc.extras.ros2.driver import Ros2Robot

    namespace = f"rollouts_{os.getpid()}"
    settings = Ros2Settings(namespace=namespace, diagnostics="diagnostics", world="odom")
    driver, other = Ros2Robot(SCENE, compiled=compiled(SCENE), settings=settings), Connection("viewer", namespace)
    yield driver, lambda: Inbox(other, KIND, "rollouts")
    other.close()
    driver.close()


def paths(seed: int) -> RolloutPaths:
    """Paths of two frames over forty steps: the cheapest rollout, and twenty others."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(21, 2, 41, 3)).astype(np.float32)
    return RolloutPaths(ways[0], ways[1:], rng.integers(0, 256, size=(20, 3)).astype(np.uint8))


def test_paths_are_sent_while_somebody_listens(ends):
    driver, listen = ends
    asked = []

    def source():
        asked.append(time.monotonic())
        return None if len(asked) == 1 else paths(1)  # a planner has none before it was asked

    driver.show_paths(source)
    time.sleep(0.6)
    assert not asked, "nobody listens"
    inbox = listen()
    end, message = time.monotonic() + 10.0, None
    while message is None and time.monotonic() < end:
        message = next((found for found, _ in inbox.take()), None)
        time.sleep(0.01)
    shown = {(marker.ns, marker.id): marker for marker in message.markers}
    assert len(shown) == len(message.markers), "a viewer takes those of one name and number for one"
    best = [marker for (space, _), marker in shown.items() if space == "best"]
    assert len(best) == 2
    for marker, way in zip(best, paths(1).best, strict=True):
        points = np.array([(p.x, p.y, p.z) for p in marker.points])
        np.testing.assert_allclose(points[[0, -1]], way[[0, -1]], atol=1e-6)
        assert all(np.abs(way - point).sum(axis=1).min() < 1e-5 for point in points)
        assert marker.header.frame_id == "odom"
        assert marker.type == marker.LINE_STRIP
        assert (marker.lifetime.sec, marker.pose.orientation.w) == (1, 1.0)
        color = marker.color
        np.testing.assert_allclose([color.r, color.g, color.b], np.array(BEST_COLOR) / 255.0, atol=1e-6)
        assert color.a == 1.0
    sampled = [marker for (space, _), marker in shown.items() if space == "sampled"]
    assert len(sampled) == 2 * 8
    colors = {(round(255 * m.color.r), round(255 * m.color.g), round(255 * m.color.b)) for m in sampled}
    assert colors <= {tuple(color) for color in paths(1).colors.tolist()}
    assert len(colors) == 8
