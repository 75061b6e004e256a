# SPDX-License-Identifier: Apache-2.0
"""Runs in real time are made again bit for bit from what was noted; what was changed, or is missing, is found."""

import errno
from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from run_logs import changed
from small_scenes import DISC, compiled, make_scene

import warpmpc
from warpmpc.extras.record.replay import logged_observation
from warpmpc.extras.record.tick_recording import record_ticks
from warpmpc.loop.log.run_log import read_planners
from warpmpc.loop.realtime.plan_logger import PlanLogger
from warpmpc.loop.realtime.planning import Planning

SCENE = make_scene(
    robot=[DISC],
    cost=[
        {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
        {"term": "control_effort", "name": "thrift", "weight": 0.1},
    ],
    planner={"samples": 16, "horizon": 4, "spline": "cubic"},
    plant={"noise": {"position": 0.01}, "delay": 0.004, "randomize": False},
    agent={"rate": 250.0, "slew": [4.0]},
)
EVERY = 5
"""Ticks between plans."""
DEAD = 9
"""Plan after which the planner dies and another one follows."""


class InStep:
    """A planner that plans at every fifth tick, at once, and dies in between."""

    def __init__(self, log):
        self.log, self.task = log, warpmpc.Task(SCENE)
        self.ticks, self._timed, self._life = 0, None, 0
        self._start()

    def _start(self):
        controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu", seed=5)
        logger = PlanLogger(controller, self.log, self._life)
        number = 0 if self._timed is None else self._timed.number + 1
        self._life += 1
        self._planning = Planning(controller, latency=0.02, number=number, logger=logger)

    def observe(self, observation):
        if self.ticks % EVERY == 0:
            if self._timed is not None and self._timed.number == DEAD:
                self._start()
            if self.ticks == 30:
                self.task["thrift"] = 0.7
            self._timed = self._planning.plan(replace(observation, task=self.task.block[0].copy()))
        self.ticks += 1

    def newest(self):
        return self._timed


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of 90 ticks and 18 plans of two planners, and its robot."""
    path = tmp_path_factory.mktemp("run") / "a.runlog"
    planner = InStep(path)
    robot = warpmpc.simulated_robot(SCENE, seed=3, task=planner.task, compiled=compiled(SCENE))
    recorder = warpmpc.RunRecorder(robot, path=path)
    loop = warpmpc.RobotLoop(SCENE, robot, planner, simulated=True, recorder=recorder)
    for _ in range(90):
        loop.tick()
        loop.pace._tick += 1  # the next tick, without waiting for it
    recorder.close()
    return warpmpc.RunLog.load(path), robot


def test_plans_of_both_planners_and_all_commands_come_out_again(run, tmp_path):
    run[0].save(tmp_path / "run.npz")
    log = warpmpc.RunLog.load(tmp_path / "run.npz")
    assert log.plans.life.tolist() == [0] * 10 + [1] * 8
    assert log.plans.reach == pytest.approx(0.02)
    found = warpmpc.replay(log)
    assert (len(found.plans.agree), len(found.commands.agree)) == (18, 90)
    assert found.same
    assert (found.plans.first, found.commands.first, found.unknown) == (None, None, 0)
    assert log.controls.following.sum() > 80
    assert (log.controls.control[0] == 0.0).all()  # the safe command: there was no plan yet


@pytest.mark.parametrize("what", ["seed", "observation", "task", "reach", "command"])
def test_what_the_plans_were_made_from_matters(run, what):
    made = run[0].plans
    origin, columns = dict(run[0].origin), {}
    match what:
        case "seed":
            origin["seed"] += 1
        case "observation":
            columns["joint_q"] = made.joint_q + np.float32(1e-3)
        case "task":
            columns["task"] = np.tile(made.task[0], (len(made), 1))
        case "reach":
            columns["reach"] = np.where(np.arange(len(made)) > 3, 0.0, made.reach)
        case "command":  # what acts until the plan is there, where no plan was followed
            columns["following"], columns["sent"] = made.following & False, made.sent + np.float32(0.2)
    found = warpmpc.replay(replace(run[0], plans=changed(made, **columns), origin=origin))
    first = {"seed": 0, "observation": 0, "task": 6, "reach": 4, "command": 0}[what]
    assert int(np.argmin(found.plans.agree)) == first
    assert found.plans.first.startswith(f"plan {first} at t = {made.time[first]:.3f} s: ")
    assert not found.commands.same


def test_what_the_agent_saw_matters(run):
    controls = run[0].controls
    later = changed(controls, clock=controls.clock + np.where(np.arange(90) >= 40, 1e-3, 0.0))
    found = warpmpc.replay(replace(run[0], controls=later))
    assert found.plans.same
    assert int(np.argmin(found.commands.agree)) == 40
    assert found.commands.first.startswith("command 40 at t = ")


def test_costs_of_plans_are_in_the_log_and_in_the_recording(run, tmp_path):
    log, robot = run
    made, cost, terms = log.plans, log.of_plans("cost"), log.of_plans("terms")
    assert log.names["terms"] == ["distance", "thrift"]
    row = {int(n): i for i, n in enumerate(made.number)}
    rows = [row[n] for n in log.controls.plan[1:].tolist()]
    np.testing.assert_array_equal(cost[1:], made.cost[rows])
    np.testing.assert_allclose(terms[1:].sum(axis=1), cost[1:], rtol=1e-4)
    assert (terms[1:20, 1] > 0.0).all()
    assert np.isnan(cost[0])
    record_ticks(tmp_path / "run.rrd", log, robot)
    chunks = [chunk for chunk in RrdReader(tmp_path / "run.rrd").stream() if chunk.entity_path == "/cost/thrift"]
    batch = chunks[0].to_record_batch()
    said = [values[0] for values in batch.column("Scalars:scalars").to_pylist()]
    np.testing.assert_array_equal(said, made.terms[:, 1])
    moments = batch.column("time").cast("int64").to_numpy()
    np.testing.assert_allclose(1e-9 * moments, made.time, atol=1e-8)


def test_a_plan_that_is_not_in_the_log_is_told(run):
    found = warpmpc.replay(replace(run[0], plans=run[0].plans[:12]))
    assert found.plans.same
    assert found.unknown == 29  # a plan is seen a tick after it was made
    assert not found.same


def test_a_row_that_was_half_written_is_left_out_and_the_next_planner_writes_on(run, tmp_path):
    controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu")
    start, path = logged_observation(run[0], 0), tmp_path / "a.runlog"
    for life in range(2):
        logger = PlanLogger(controller, path, life)
        planning = Planning(controller, number=5 * life, logger=logger)
        for _ in range(3):
            planning.plan(start)
        logger.close()
    first = tmp_path / "a.runlog.0"
    first.write_bytes(first.read_bytes()[:-11])  # killed while it wrote
    (tmp_path / "a.runlog.2").write_bytes(b'{"origin"')  # killed before the first plan
    plans = read_planners(path).plans
    assert plans.number.tolist() == [0, 1, 5, 6, 7]
    assert plans.life.tolist() == [0, 0, 1, 1, 1]
    controls = run[0].controls[:3].copy()
    controls.plan = [1, 2, 7]
    assert replace(run[0], plans=plans, controls=controls).plan_rows().tolist() == [1, -1, 4]


def test_plans_go_on_where_nothing_can_be_written(run, tmp_path):
    class Full:
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            pass

    controller = warpmpc.Controller(SCENE, compiled=compiled(SCENE), engine="mujoco", device="cpu")
    start, path = logged_observation(run[0], 0), tmp_path / "a.runlog"
    logger = PlanLogger(controller, path)
    planning = Planning(controller, logger=logger)
    logger._writer._file.close()
    logger._writer._file = Full()
    assert [planning.plan(start).number for _ in range(2)] == [0, 1]
    assert len(read_planners(path).plans) == 0
    nowhere = Planning(controller, logger=PlanLogger(controller, tmp_path / "none" / "a.runlog"))
    assert nowhere.plan(start) is not None


def test_a_log_without_plans_is_refused(run):
    with pytest.raises(ValueError, match="no log of what its plans were made from"):
        warpmpc.replay(replace(run[0], plans=np.zeros(0, []).view(np.recarray)))
