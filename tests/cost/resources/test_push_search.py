# SPDX-License-Identifier: Apache-2.0
"""Push values that follow a goal: searched for beside the planning, which goes on with the old ones until they come."""

import time

import numpy as np
import pytest
from push_scenes import block
from small_scenes import BOX, compiled, layout_of, make_scene

from warpmpc import Controller, State, Task
from warpmpc.cost.resources import push_value as module
from warpmpc.cost.resources.push_value import PushValues, Search, push_value
from warpmpc.cost.stack import CostStack

COST = {"term": "push_path", "pusher": "base/centre", "object": "box", "width": 0.2, "length": 0.3}
BLOCKING = 0.02  # [s] a refresh takes less than that while a search runs


def goal(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return np.array([x, y, 0.1, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])


class Pushing:
    """The push values of a scene with one term, and the task they follow."""

    def __init__(self, envs: int = 1):
        self.scene = make_scene(
            object=[{**BOX, "position": (0.8, 0.0, 0.1)}],
            obstacle=[block(size=(0.3, 0.6, 0.4), position=(0.0, 0.6))],
            goal={"object": "box", "position": (0.0, 0.0), "yaw": 0.0},
            cost=[COST],
            planner={"samples": 8, "horizon": 3},
        )
        self.task = Task(self.scene, envs=envs)
        self.stack = CostStack(self.scene, layout_of(self.scene), self.task)
        self.resource = self.stack.resources.get(PushValues)
        self.stack.refresh()

    @property
    def values(self) -> np.ndarray:
        """Values in use ``[E, 16, rows, columns]``, a copy."""
        return np.moveaxis(self.stack.terms[0][1].value.numpy(), -1, 1).copy()

    @property
    def origins(self) -> np.ndarray:
        return self.stack.terms[0][1].origin.numpy().copy()

    def directly(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Value and origin for a goal, computed here and now."""
        (job,) = self.resource._jobs(np.asarray(pose, dtype=np.float32))
        return push_value(*job)

    def wait(self, seconds: float = 60.0) -> float:
        """Refresh until every goal has its value; returns the longest call [s]."""
        longest, end = 0.0, time.perf_counter() + seconds
        while time.perf_counter() < end:
            start = time.perf_counter()
            self.stack.refresh()
            longest = max(longest, time.perf_counter() - start)
            if (self.resource._shown == self.resource._wanted).all():
                return longest
            time.sleep(0.01)
        raise AssertionError("the new value never came")


def test_the_first_value_is_there_before_the_first_plan():
    pushing = Pushing()
    value, origin = pushing.directly(goal(0.0, 0.0))
    np.testing.assert_array_equal(pushing.values[0], value.astype(np.float32))
    np.testing.assert_allclose(pushing.origins[0], origin, rtol=1e-6)


def test_a_goal_that_moves_does_not_block_and_its_value_comes_later():
    pushing = Pushing()
    old = pushing.values
    pushing.task["goal"] = goal(-0.4, 0.2)
    pushing.stack.refresh()  # starts the process
    pushing.wait()
    for n, place in enumerate([(0.3, -0.5, 0.4), (-0.5, -0.2, 2.0)]):
        before = pushing.values
        pushing.task["goal"] = goal(*place)
        start = time.perf_counter()
        pushing.stack.refresh()
        assert time.perf_counter() - start < BLOCKING, n
        np.testing.assert_array_equal(pushing.values, before)  # nothing came of it yet
        assert pushing.wait() < BLOCKING
        value, origin = pushing.directly(goal(*place))
        np.testing.assert_array_equal(pushing.values[0], value.astype(np.float32))
        np.testing.assert_allclose(pushing.origins[0], origin, rtol=1e-6)
        assert not np.array_equal(pushing.values, old)


def test_a_goal_that_moves_on_meanwhile_gets_the_value_of_where_it_is_in_the_end():
    pushing = Pushing()
    for x in (0.1, 0.2, 0.3, 0.4):
        pushing.task["goal"] = goal(x, -0.3)
        pushing.stack.refresh()
    pushing.wait()
    np.testing.assert_array_equal(pushing.values[0], pushing.directly(goal(0.4, -0.3))[0].astype(np.float32))


def test_only_the_environment_whose_goal_moved_gets_a_new_value():
    pushing = Pushing(envs=3)
    before = pushing.values
    goals = pushing.task["goal"]
    goals[1] = goal(0.3, 0.2, 0.5)
    pushing.task["goal"] = goals
    pushing.wait()
    np.testing.assert_array_equal(pushing.values[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(pushing.values[1], pushing.directly(goals[1])[0].astype(np.float32))


def test_settle_waits_and_gives_up_older_searches():
    pushing = Pushing()
    pushing.task["goal"] = goal(0.3, 0.2)
    pushing.stack.refresh()
    pushing.task["goal"] = goal(-0.2, -0.2)
    pushing.resource.settle()
    expected = pushing.directly(goal(-0.2, -0.2))[0].astype(np.float32)
    np.testing.assert_array_equal(pushing.values[0], expected)
    time.sleep(0.5)
    pushing.stack.refresh()
    np.testing.assert_array_equal(pushing.values[0], expected)


def test_a_change_that_is_none_of_its_goals_starts_no_search(monkeypatch):
    pushing = Pushing()

    def refuse(*_) -> None:
        raise AssertionError("nothing is to be searched for")

    monkeypatch.setattr(Search, "begin", refuse)
    monkeypatch.setattr(module, "push_value", refuse)
    pushing.task["push_path"] = 3.0
    pushing.task["goal"] = pushing.task["goal"]
    pushing.stack.refresh()


def test_the_process_of_a_search_ends_with_it():
    search, pushing = Search(), Pushing()
    jobs = pushing.resource._jobs(goal(0.1, 0.1).astype(np.float32))
    search.begin(5, jobs)
    end, found = time.perf_counter() + 60.0, []
    while not found and time.perf_counter() < end:
        found = search.finished()
        time.sleep(0.01)
    assert [e for e, _ in found] == [5]
    process = search._process
    search.stop()
    assert process.poll() is not None
    search.stop()


@pytest.mark.parametrize("envs", [1, 2])
def test_plans_go_on_while_a_value_is_searched_for(envs):
    pushing = Pushing()
    scene = pushing.scene
    controller = Controller(scene, envs=envs, compiled=compiled(scene))
    layout = controller.layout
    state = State(np.tile(layout.joint_q, (envs, 1)), np.tile(layout.joint_qd, (envs, 1)))
    controller.step(state)
    controller.task["goal"] = goal(-0.4, 0.3)
    slow = []
    for _ in range(4):
        start = time.perf_counter()
        assert np.isfinite(controller.step(state)).all()
        slow.append(time.perf_counter() - start)
    assert min(slow) < 0.1
    assert not any(info.fallback for info in controller.info)
