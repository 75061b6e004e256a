# SPDX-License-Identifier: Apache-2.0
"""What the page reads out and the norms it changes, without a browser."""

import time

import mujoco
import numpy as np
import pytest
from swinging import SCENE, write_swinging

from warpmpc import load_scene
from warpmpc.extras.live.readouts import Reading, bars, joints, model_facts, sensors
from warpmpc.extras.live.session import Session
from warpmpc.extras.live.snapshot import WINDOW, PlanCounter


@pytest.fixture
def session(tmp_path):
    session = Session(write_swinging(tmp_path), device="cpu", lock_step=True)
    yield session
    session._end_planner()


def norm_of_lift(session, p):
    """Weighted cost of the term after every step of the best rollout, from the wheel's height, by hand."""
    bodies = session.controller.rollout().body_q
    height = bodies[1:, session.controller.layout.body_name.index("arm/wheel"), 2].astype(float)
    return 5.0 * (np.sqrt(height**2 + p**2) - p)


def test_a_norm_changes_the_terms_cost_and_outlives_a_reset_and_the_way_back(session):
    session._step()
    np.testing.assert_allclose(session.snapshot.forecast.cost[0], norm_of_lift(session, 0.1), rtol=1e-4)
    session.controller.task["still"] = 0.5
    for p in (0.4, 0.1):
        session._set_keys({"cost.lift.norm.p": str(p)})
        assert session.snapshot.values["cost.lift.norm.p"] == p
        assert session.snapshot.steps == 1, "the episode goes on"
        session._reset(None)
        session._step()
        np.testing.assert_allclose(session.snapshot.forecast.cost[0], norm_of_lift(session, p), rtol=1e-4)
    assert session.controller.task["still"] == 0.5, "weights stay"


def test_a_norm_that_cannot_be_is_refused_and_nothing_changes(session):
    controller = session.controller
    session._guarded(lambda: session._set_keys({"cost.still.norm.p": "0.5"}))
    assert "the norm power takes p of 1 or more" in session.message
    assert session.controller is controller
    assert session.snapshot.values["cost.still.norm.p"] == 1.5


def test_a_norm_of_a_term_that_success_asks_for_is_the_plants_too(tmp_path):
    path = write_swinging(tmp_path)
    (tmp_path / "swinging.toml").write_text(SCENE + '[success]\nconditions = { term = "lift", below = 0.1 }\n')
    session = Session(path, device="cpu", lock_step=True)
    plant = session.plant
    session._set_keys({"cost.still.norm.p": "2.0"})
    assert session.plant is plant
    session._set_keys({"cost.lift.norm.p": "0.4"})
    session._step()
    height = float(session.plant.body_q[session.plant.layout.body_name.index("arm/wheel"), 2])
    assert session.plant.terms["lift"] == pytest.approx(np.sqrt(height**2 + 0.4**2) - 0.4, rel=1e-4)


def test_facts_are_those_of_both_models(session):
    rows = {name: cells for name, *cells in model_facts(session.controller, session.plant)}
    option = session.plant.model.opt
    assert rows["engine"] == ["mujoco", "mujoco"]
    assert rows["threads"] == ["1", "1"]
    assert rows["timestep"][1] == f"{1e3 * option.timestep:g} ms"
    assert rows["iterations"] == ["5", str(option.iterations)]
    assert rows["integrator"] == ["implicitfast", "implicitfast"]
    assert rows["solver"][1] == mujoco.mjtSolver(option.solver).name.removeprefix("mjSOL_").lower()
    assert [rows[name][0] for name in ("nq", "nv", "nu", "bodies", "sensors", "worlds")] == list("22224") + ["16"]
    assert rows["mass"] == ["2 kg", "2 kg"]
    assert rows["control"] == ["", "20 ms"]
    assert rows["lookahead"] == ["0.4 s in 10 steps", ""]


def test_facts_of_rollouts_without_physics_are_left_out():
    session = Session("storm_reach", overrides=["engine.name=kinematic", "planner.samples=50"], device="cpu")
    rows = {name: cells for name, *cells in model_facts(session.controller, session.plant)}
    assert rows["engine"] == ["kinematic", "mujoco"]
    assert rows["integrator"][0] == ""


def test_joints_and_sensors_are_those_of_the_plant(session):
    for _ in range(2):
        session._step()
    layout, data = session.plant.layout, mujoco.MjData(session.plant.model)
    session.plant.show(data)
    hinges, shown = joints(layout, session.snapshot), sensors(layout, session.snapshot)
    assert [hinge.name for hinge in hinges] == ["arm/swing", "arm/turn"]
    np.testing.assert_allclose([hinge.value for hinge in hinges], data.qpos, atol=1e-6)
    assert (hinges[0].limits, hinges[1].limits) == ((-1.5, 2.0), None)
    assert [sensor.name for sensor in shown] == ["arm/angle", *(f"arm/spin[{i}]" for i in range(3))]
    values = np.array([sensor.value for sensor in shown])
    step = 2.0 * session.plant.model.opt.timestep  # sensors show the state before the last physics step
    assert values[0] == pytest.approx(hinges[0].value, abs=step * abs(data.qvel[0]) + 1e-6)
    assert values[2] == pytest.approx(data.qvel.sum(), rel=0.3)
    assert values[[1, 3]] == pytest.approx(0.0, abs=1e-6)


def test_names_of_a_file_cannot_be_html():
    text = bars("joints", [Reading("a/<script>", 0.5, (0.0, 1.0))], [0.5])
    assert "<script>" not in text
    assert 'min="0" max="1" value="0.5"' in text


def test_plans_are_counted_by_wall_time():
    counter = PlanCounter()
    assert counter.now().rate == 0.0
    for plan_ms in range(1, 101):
        counter.note(float(plan_ms))
    found = counter.now()
    assert found.rate == 100 / WINDOW
    assert (found.p50, found.p99) == pytest.approx((50.5, 99.01))


def test_the_age_of_the_plan_in_use_grows_without_new_ones(session):
    session._step()
    assert session.snapshot.age == 0.0
    session.planning = False
    for _ in range(3):
        session._step()
    assert session.snapshot.age == pytest.approx(0.06)


def test_a_late_plan_is_older_than_the_observation_it_is_followed_from(session):
    session.lock_step = False
    session._step()
    time.sleep(0.3)
    session._step()
    time.sleep(0.3)
    session._step()
    assert session.snapshot.age == pytest.approx(0.02)


def test_norms_are_saved(session, tmp_path):
    from warpmpc.extras.live.saving import save

    save(session.scene.path, None, ["cost.lift.norm.p=0.25"], to=tmp_path / "saved.toml")
    assert load_scene(tmp_path / "saved.toml").cost[0].params["norm"] == {"kind": "smooth_abs", "p": 0.25}
