# SPDX-License-Identifier: Apache-2.0
"""Several controllers in one process: beside each other in threads, and one after the other."""

import threading
import weakref

import numpy as np
import pytest
from small_scenes import BOX, compiled, make_scene

from warpmpc import Controller, State


def planning(method: str) -> tuple[Controller, State]:
    """A controller of a small scene on two threads, warmed up, and the state it plans from."""
    planner = {"method": method, "samples": 32, "horizon": 6, "noise": {"sigma": (0.5,), "redraw": True}}
    scene = make_scene(object=[BOX], planner=planner, engine={"threads": 2})
    controller = Controller(scene, engine="mujoco", compiled=compiled(scene), seed=3)
    state = State.start(controller.layout)
    for _ in range(3):
        controller.step(state)
    return controller, state


def commands(controller: Controller, state: State, out: list) -> None:
    """Make plans one after the other."""
    out.extend(controller.step(state) for _ in range(80))


@pytest.mark.parametrize("method", ["mppi", "cem"])
def test_controllers_in_threads_command_what_each_commands_alone(method):
    alone: list[np.ndarray] = []
    commands(*planning(method), alone)
    together = [planning(method) for _ in range(2)]
    found: list[list[np.ndarray]] = [[], []]
    threads = [threading.Thread(target=commands, args=(*pair, out)) for pair, out in zip(together, found, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for out in found:
        np.testing.assert_array_equal(out, alone)


def test_a_dropped_controller_leaves_no_threads_behind():
    before = set(threading.enumerate())
    dropped = []
    for _ in range(5):
        controller, _ = planning("mppi")
        dropped.append(weakref.ref(controller.engine))
        del controller
    assert [engine() for engine in dropped] == [None] * 5  # without waiting for the garbage collector
    left = set(threading.enumerate()) - before
    for thread in left:
        thread.join(timeout=5.0)
    assert [thread for thread in left if thread.is_alive()] == []
