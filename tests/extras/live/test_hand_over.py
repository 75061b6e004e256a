# SPDX-License-Identifier: Apache-2.0
"""The page moves at once with code that is not optimized, and goes on with optimized code when that is compiled."""

import logging
import time

import numpy as np
import pytest

import warpmpc
from warpmpc.extras.live.session import Session
from warpmpc.physics.runtime import compiling

FAST = ["engine.threads=1", "planner.samples=16", "planner.horizon=20"]
SCENE = "cylinder_push"


@pytest.fixture
def unknown(monkeypatch):
    """No kernel of rollouts counts as one that is on disk."""
    ready = compiling.ready
    monkeypatch.setattr(compiling, "ready", lambda module, *rest: "launch" not in module.name and ready(module, *rest))


def level(controller) -> int | None:
    return controller.engine._kernel.module.options["optimization_level"]


def await_code(session) -> None:
    session._later.join()
    assert session._later.ready


def test_commands_go_on_where_code_is_handed_over(unknown, caplog):
    with caplog.at_level(logging.INFO, logger="warpmpc"):
        session = Session(SCENE, overrides=FAST, device="cpu", lock_step=True)
        assert level(session.controller) == 0
        sent = []
        for _ in range(12):
            session._step()
            sent.append(session._control.copy())
        plant, plan, before = session.plant, session._plan, session.snapshot
        await_code(session)
        session._hand_over()
        session._step()
    assert level(session.controller) is None
    assert session.plant is plant
    after = session.snapshot
    assert (after.build, after.episode, after.steps) == (before.build, before.episode, before.steps + 1)
    assert after.time == pytest.approx(before.time + plant.scene.timing.control_dt)
    # no further from the plan that was followed than plans are from each other
    lower, upper = session.controller.limits
    jumps = np.abs(np.diff(sent[4:], axis=0)).max(axis=0)
    assert (np.abs(session._control - plan.at(before.time)) <= np.maximum(2.0 * jumps, 0.05 * (upper - lower))).all()
    told = [record.message for record in caplog.records]
    assert f"{SCENE}: planning with code that is not optimized while that is compiled" in told
    assert f"{SCENE}: planning with optimized code from t = {before.time:.2f} s on" in told


def test_the_running_page_takes_the_code_over_by_itself(unknown):
    session = Session(SCENE, overrides=FAST, device="cpu", pace=4.0)
    assert level(session.controller) == 0
    session.start()
    try:
        end = time.monotonic() + 60.0
        while level(session.controller) == 0:
            assert time.monotonic() < end
            time.sleep(0.01)
        steps = session.snapshot.steps
        while session.snapshot.steps < steps + 3:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert session.message == ""
        assert session.snapshot.build == session.snapshot.episode == 1
    finally:
        session.stop()
        session.join(20.0)


def test_code_on_disk_is_used_from_the_start():
    Session(SCENE, overrides=FAST, device="cpu")._later.join()
    session = Session(SCENE, overrides=FAST, device="cpu")
    assert level(session.controller) is None
    assert session._later.modules == []


def test_episodes_run_optimized_from_the_start_so_that_seeds_repeat(unknown):
    scene = warpmpc.load_scene(SCENE, overrides=[*FAST, "timing.timeout=0.2"])
    levels = set()
    warpmpc.run_episode(scene, device="cpu", on_step=lambda controller, *_: levels.add(level(controller)))
    assert levels == {None}
