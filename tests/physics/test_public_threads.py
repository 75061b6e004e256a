# SPDX-License-Identifier: Apache-2.0
"""Rollouts, simulators and environments from several threads: each result is its caller's, or there is an error."""

import copy
import multiprocessing
import os
import time
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
import warp as wp
from gymnasium.error import ClosedEnvironmentError

from warpmpc.physics import BatchSimulator, rollout
from warpmpc.physics.vector_env import BatchVectorEnv
from warpmpc.physics.world_view import WorldView, joint_position

PENDULUM = """
<mujoco>
  <option OPTION/>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body pos="0 0 1">
      <joint name="j" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .4 0 0"/>
    </body>
  </worldbody>
  <actuator><motor joint="j"/></actuator>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(PENDULUM.replace("OPTION", ""))
FALLS_BACK = mujoco.MjModel.from_xml_string(PENDULUM.replace("OPTION", 'noslip_iterations="1"'))
CALLS, WORKERS, LONG = 32, 8, 200_000
rng = np.random.default_rng(0)
STARTS, CONTROLS = rng.normal(size=(CALLS, 8, 3)), rng.uniform(-1, 1, (CALLS, 8, 20, 1))
HEAVY = [copy.copy(MODEL) for _ in range(8)]
for number, one in enumerate(HEAVY):
    one.body_mass[1] *= 1.0 + 0.1 * number
    mujoco.mj_setConst(one, mujoco.MjData(one))


def call(roll, n, model=MODEL, threads=1):
    """The states that call number n rolls out, of fewer worlds and steps in some of them."""
    model = HEAVY if n % 4 == 3 and model is MODEL else model
    worlds, steps = (8, 20) if isinstance(model, list) else (8 - n % 2, 20)
    data = [mujoco.MjData(MODEL) for _ in range(threads)]
    return roll(model, data, STARTS[n, :worlds], CONTROLS[n, :worlds, :steps])[0]


def check_calls(roll, **options):
    """Many calls at once give what they give one after the other."""
    alone = [call(roll, n, **options) for n in range(CALLS)]
    with ThreadPoolExecutor(WORKERS) as pool:
        for _ in range(3):
            for n, found in enumerate(pool.map(lambda n: call(roll, n, **options), range(CALLS))):
                np.testing.assert_array_equal(found, alone[n], err_msg=f"call {n}")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("model", [MODEL, FALLS_BACK], ids=["own", "falls back"])
def test_threads_may_call_the_function(model, threads):
    check_calls(rollout.rollout, model=model, threads=threads)
    rollout.shutdown_persistent_pool()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("model", [MODEL, FALLS_BACK], ids=["own", "falls back"])
def test_threads_may_share_an_object(model, threads):
    with rollout.Rollout(nthread=threads) as shared:
        check_calls(shared.rollout, model=model, threads=threads)


def test_the_pool_may_be_shut_down_during_calls():
    alone = [call(rollout.rollout, n) for n in range(CALLS)]
    with ThreadPoolExecutor(WORKERS) as pool:
        running = [pool.submit(call, rollout.rollout, n) for n in range(CALLS)]
        while not all(one.done() for one in running):
            rollout.shutdown_persistent_pool()
            time.sleep(0.05)
        for one, expected in zip(running, alone, strict=True):
            np.testing.assert_array_equal(one.result(), expected)


def long_one(ours):
    """A rollout that takes a while in a thread, and what it is to give."""
    arguments = MODEL, mujoco.MjData(MODEL), STARTS[0]
    expected = ours.rollout(*arguments, nstep=LONG)[0]
    pool = ThreadPoolExecutor(1)
    running = pool.submit(lambda: ours.rollout(*arguments, nstep=LONG)[0])
    time.sleep(0.02)
    return running, expected


def test_different_objects_run_side_by_side():
    with rollout.Rollout() as one, rollout.Rollout() as other:
        expected = call(other.rollout, 0)
        for _ in range(5):  # a loaded machine may let the long one end before the short one begins
            running, states = long_one(one)
            found = call(other.rollout, 0)
            beside = not running.done()
            np.testing.assert_array_equal(found, expected)
            np.testing.assert_array_equal(running.result(), states)
            if beside:
                break
        assert beside


def test_closing_waits_for_the_rollout_and_refuses_the_next():
    ours = rollout.Rollout()
    running, states = long_one(ours)
    ours.close()
    assert running.done() or running.result(1.0) is not None
    np.testing.assert_array_equal(running.result(), states)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="shutdown"):
            call(ours.rollout, 0)
        ours.close()


@wp.func
def observe(s: WorldView, o: wp.array[float]):
    o[0] = joint_position(s, 0)


@wp.func
def zero(s: WorldView) -> float:
    return 0.0


def environments():
    """Environments of a simulator with two threads."""
    simulator = BatchSimulator(MODEL, 64, threads=2)
    made = BatchVectorEnv(simulator, observe=observe, size=1, rewards={zero: 1.0}, substeps=5)
    made.reset(seed=0)
    return made


def check_refused(method, calls):
    """While a thread is in ``method`` every call is an error that says so."""
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(method)
        time.sleep(0.05)
        for one in calls:
            with pytest.raises(RuntimeError, match="another thread uses this"):
                one()
        assert not running.done()
        running.result()


def test_a_simulator_refuses_a_second_thread():
    simulator, alone = BatchSimulator(MODEL, 64, threads=2), BatchSimulator(MODEL, 64, threads=2)
    control = np.zeros((64, 1))
    check_refused(
        lambda: simulator.step(control, n=10 * LONG),
        [lambda: simulator.step(control), simulator.reset, simulator.forward, simulator.set_numbers],
    )
    alone.step(control, n=10 * LONG)
    np.testing.assert_array_equal(simulator.qpos, alone.qpos)


def test_environments_refuse_a_second_thread_and_what_comes_after_their_end():
    made = environments()
    action = np.zeros((64, 1), np.float32)
    made._substeps = 10 * LONG
    check_refused(
        lambda: made.step(action),
        [lambda: made.step(action), made.reset, lambda: made.set_weights(zero=2.0), made.close],
    )
    made.close()
    for method in (made.reset, lambda: made.step(action)):
        with pytest.raises(ClosedEnvironmentError, match="closed"):
            method()


def test_a_fork_goes_on_with_threads_of_its_own():
    ours, made, action = rollout.Rollout(nthread=2), environments(), np.zeros((64, 1), np.float32)

    def results():
        yield from (call(ours.rollout, n, threads=2) for n in (0, 3))
        yield from (call(roll, n, FALLS_BACK, threads=2) for n, roll in ((1, ours.rollout), (2, rollout.rollout)))
        made.reset(seed=0)
        yield from (made.step(action)[0] for _ in range(3))

    expected = list(results())
    here, there = multiprocessing.Pipe()
    if not (child := os.fork()):
        try:
            there.send([a.tobytes() for a in results()])
        finally:
            os._exit(0)
    there.close()
    try:
        assert here.poll(60), "the child hangs"
        assert here.recv() == [a.tobytes() for a in expected]
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)
    for found, own in zip(results(), expected, strict=True):
        np.testing.assert_array_equal(found, own)
