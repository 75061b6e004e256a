# SPDX-License-Identifier: Apache-2.0
"""Each public class of rollouts, used by several threads at once: each thread's own object, and one of all."""

import contextlib
import itertools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import warp as wp

from warpmpc.physics.world_view import WorldView, joint_position

MODEL = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body pos="0 0 1">
      <joint name="j" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .4 0 0"/><site name="s" pos=".4 0 0"/>
    </body>
    <body pos="1 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <actuator><motor joint="j"/></actuator>
  <sensor><jointpos joint="j"/><framelinvel objtype="site" objname="s"/></sensor>
</mujoco>
"""
WORKERS, CALLS, WORLDS, STEPS = 3, 6, 96, 10


@wp.func
def observe(s: WorldView, o: wp.array[float]):
    o[0] = joint_position(s, 0)


@wp.func
def zero(s: WorldView) -> float:
    return 0.0


def model() -> mujoco.MjModel:
    """A pendulum, and a box on the floor."""
    return mujoco.MjModel.from_xml_string(MODEL)


def use(own: list[Callable[[], object]], shared: Callable[[], object]) -> None:
    """Let each thread call its own object, then all of them the one they share, which may refuse.

    Raises:
        AssertionError: If every call of the shared object is refused.
    """
    done = []

    def call(one: Callable[[], object]) -> None:
        for _ in range(CALLS):
            one()
        for _ in range(CALLS):
            with contextlib.suppress(RuntimeError):  # another thread uses it
                shared()
                done.append(one)

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(call, own))
    assert done


def _rollout(ours) -> Callable[[], object]:
    m = model()
    state = np.tile(np.concatenate([[0.0], m.qpos0, np.zeros(m.nv)]), (WORLDS, 1))
    return lambda: ours.rollout(m, [mujoco.MjData(m) for _ in range(2)], state, np.ones((WORLDS, STEPS, 1)))


def function() -> None:
    """``rollout.rollout``, whose pool is shut down meanwhile."""
    from warpmpc.physics import rollout

    over = threading.Event()

    def shut_down() -> None:
        while not over.wait(0.1):
            rollout.shutdown_persistent_pool()

    other = threading.Thread(target=shut_down)
    other.start()
    try:
        use([_rollout(rollout) for _ in range(WORKERS)], _rollout(rollout))
    finally:
        over.set()
        other.join()


def rollouts() -> None:
    """``Rollout``, one of them closed during a call."""
    from warpmpc.physics.rollout import Rollout

    with contextlib.ExitStack() as stack:
        objects = [stack.enter_context(Rollout(nthread=2, fall_back=False)) for _ in range(WORKERS + 1)]
        use([_rollout(one) for one in objects[1:]], _rollout(objects[0]))
        last = _rollout(objects[0])
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(last)
            objects[0].close()
            with contextlib.suppress(RuntimeError):  # the pool has been shut down
                running.result()


def simulator() -> None:
    """``BatchSimulator``."""
    from warpmpc.physics import BatchSimulator

    objects = [BatchSimulator(model(), WORLDS, threads=2) for _ in range(WORKERS + 1)]
    calls = [lambda one=one: (one.step(np.ones((WORLDS, 1)), n=STEPS), one.forward()) for one in objects]
    use(calls[1:], calls[0])


def batch() -> None:
    """``Batch``."""
    from warpmpc.physics import Batch

    objects = [Batch(model(), WORLDS, 2, fall_back=False) for _ in range(WORKERS + 1)]
    outputs = [one.bind("qpos") for one in objects]
    calls = [lambda one=one: (one.step(nstep=STEPS), one.rollout(nstep=STEPS)) for one in objects]
    use(calls[1:], calls[0])
    assert np.isfinite(outputs).all()


def environments() -> None:
    """``BatchVectorEnv``."""
    from warpmpc.physics import BatchSimulator
    from warpmpc.physics.vector_env import BatchVectorEnv

    keys = {"observe": observe, "size": 1, "rewards": {zero: 1.0}, "substeps": 5}
    objects = [BatchVectorEnv(BatchSimulator(model(), WORLDS, threads=2), **keys) for _ in range(WORKERS + 1)]
    for one in objects:
        one.reset(seed=0)
    counts = itertools.count()
    action = np.ones((WORLDS, 1), np.float32)
    calls = [lambda one=one: one.reset() if next(counts) % 4 == 3 else one.step(action) for one in objects]
    use(calls[1:], calls[0])


def controllers() -> None:
    """``Controller``."""
    from small_scenes import compiled, make_scene

    from warpmpc import Controller, State

    scene = make_scene(planner={"samples": 64, "horizon": 6}, engine={"threads": 2})
    parts = compiled(scene)
    objects = [Controller(scene, engine="fused", device="cpu", compiled=parts) for _ in range(WORKERS + 1)]
    state = State.start(objects[0].layout)
    calls = [lambda one=one: one.step(state) for one in objects]
    use(calls[1:], calls[0])


USES = {
    "rollout": function,
    "Rollout": rollouts,
    "BatchSimulator": simulator,
    "Batch": batch,
    "BatchVectorEnv": environments,
    "Controller": controllers,
}
"""What the threads do with each."""
