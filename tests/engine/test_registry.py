# SPDX-License-Identifier: Apache-2.0
"""What an engine's entry says it can do is what scenes and plans are held to."""

import logging
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, SceneError, State
from warpmpc.engine import launched
from warpmpc.engine.protocol import TimeGrid
from warpmpc.engine.registry import ENGINES, PhysicsSteps, physics_steps, register
from warpmpc.physics import unsupported

UNEVEN = (0.04, 0.05, 0.06)


@pytest.fixture
def enter():
    """Registers variations of a shipped engine under their own names; tells what physics steps they were given."""
    given: list[PhysicsSteps] = []
    names = []

    def enter(name: str, like: str = "mujoco", **claims) -> list[PhysicsSteps]:
        even = PhysicsSteps((2,) * len(UNEVEN), (0.02,) * len(UNEVEN))

        def make(request, steps):
            given.append(steps)
            return ENGINES[like].make(request, even)

        register(replace(ENGINES[like], name=name, make=make, **claims))
        names.append(name)
        return given

    yield enter
    for name in names:
        del ENGINES[name]


def scene_of(dt, **engine):
    return make_scene(planner={"samples": 4, "horizon": 3, "dt": dt}, engine=engine)


def test_an_engine_that_says_so_gets_physics_steps_of_any_length(enter):
    given = enter("stretchy", any_dt=True)
    scene = scene_of(UNEVEN, substeps=4)
    controller = Controller(scene, engine="stretchy", compiled=compiled(scene))
    controller.step(State.start(controller.layout))
    assert given[0].count == (4, 4, 4)
    np.testing.assert_allclose(given[0].length, np.array(UNEVEN) / 4)


def test_an_engine_that_does_not_is_never_made_for_such_steps(enter):
    given = enter("stiff", any_dt=False)
    scene = scene_of(UNEVEN)
    with pytest.raises(SceneError, match="engine stiff takes steps of one length") as caught:
        Controller(scene, engine="stiff", compiled=compiled(scene))
    assert caught.value.key == "planner.dt"
    assert given == []


@pytest.mark.parametrize("any_dt", [False, True])
def test_steps_of_one_length_are_divided_alike_by_both_kinds(enter, any_dt):
    enter("either", any_dt=any_dt)
    scene = scene_of((0.06,), substeps=3)
    steps = physics_steps("either", scene, compiled(scene), TimeGrid.of(scene))
    assert steps.count == (3, 3, 3)
    np.testing.assert_allclose(steps.length, 0.02)


def test_an_engine_runs_on_the_devices_of_its_entry_alone(enter):
    enter("gpu_only", cuda=True, cpu=False)
    scene = scene_of((0.04,))
    with pytest.raises(ValueError, match="gpu_only runs on device cuda, not 'cpu'"):
        Controller(scene, engine="gpu_only", device="cpu", compiled=compiled(scene))


@pytest.mark.parametrize("capturable", [True, False])
def test_a_plan_is_captured_where_device_terms_and_entry_allow_it(enter, capturable, device):
    like = "mujoco_warp" if device.startswith("cuda") else "mujoco"
    enter("maybe", like, capturable=capturable)
    scene = scene_of((0.04,))
    controller = Controller(scene, engine="maybe", device=device, compiled=compiled(scene))
    controller.step(State.start(controller.layout))
    assert (controller.graph.captured is not None) is (capturable and device.startswith("cuda"))


def test_a_name_is_given_once():
    with pytest.raises(ValueError, match="engine 'mujoco' already"):
        register(ENGINES["mujoco"])


def test_auto_takes_the_fused_engine_where_it_can_do_what_the_scene_asks_for(monkeypatch):
    scene = make_scene(planner={"samples": 4, "horizon": 2})
    controller = Controller(scene, device="cpu", compiled=compiled(scene))
    assert controller.engine.name == "fused"
    controller.step(State.start(controller.layout))
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    monkeypatch.setitem(unsupported._CHECKS, "integrators of order four", lambda p: p.mj.opt.integrator == rk4)
    fourth = make_scene(planner={"samples": 4, "horizon": 2}, engine={"integrator": "rk4"})
    assert Controller(fourth, device="cpu", compiled=compiled(fourth)).engine.name == "mujoco"
    with pytest.raises(SceneError, match="engine fused has no integrators") as caught:
        Controller(fourth, engine="fused", device="cpu", compiled=compiled(fourth))
    assert caught.value.key == "engine.name"


@pytest.fixture
def broken(monkeypatch):
    """Rollouts of the engine `fused` are no C."""
    make = launched.make_kernel
    monkeypatch.setattr(
        launched, "make_kernel", lambda text, *rest, **more: make("int broken = nowhere;\n" + text, *rest, **more)
    )


@pytest.mark.usefixtures("broken")
def test_auto_takes_the_next_engine_where_a_kernel_does_not_compile(caplog, capfd):
    scene = make_scene(planner={"samples": 8, "horizon": 3})
    with caplog.at_level(logging.INFO, logger="warpmpc"):
        controller = Controller(scene, device="cpu", compiled=compiled(scene))
    (record,) = [record for record in caplog.records if record.levelno >= logging.INFO]
    assert record.levelno == logging.WARNING
    assert "undeclared identifier 'nowhere'; allowed: " in record.message
    assert record.message.endswith("taking the next engine")
    assert capfd.readouterr().err == ""
    assert controller.engine.name == "mujoco"
    other = Controller(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    for _ in range(3):
        commands = [one.step(State.start(one.layout)) for one in (controller, other)]
        np.testing.assert_array_equal(*commands)


@pytest.mark.usefixtures("broken")
def test_an_engine_by_name_whose_kernel_does_not_compile_is_an_error_of_its_key(capfd):
    scene = make_scene(planner={"samples": 8, "horizon": 3})
    with pytest.raises(
        SceneError, match=r"the engine fused cannot be had: the rollouts of .* cannot be compiled"
    ) as caught:
        Controller(scene, engine="fused", device="cpu", compiled=compiled(scene))
    assert caught.value.key == "engine.name"
    assert "mujoco" in caught.value.allowed
    assert capfd.readouterr().err == ""
