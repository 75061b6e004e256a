# SPDX-License-Identifier: Apache-2.0
"""A scene that leaves the number of samples open gets as many as fit into a control, measured once."""

import logging
import time

import pytest
from small_scenes import compiled, make_scene

import warpmpc
from warpmpc import SceneError, fit_samples, load_scene
from warpmpc.engine.protocol import TimeGrid
from warpmpc.loop.run import fit_samples as module
from warpmpc.loop.run.episode import Episode
from warpmpc.loop.run.fit_samples import FEWEST, MOST, SHARE, most_samples
from warpmpc.scene.schema import SampleCount

OPEN = {"samples": "auto", "horizon": 6}


@pytest.mark.parametrize("each", [1e-7, 1e-5, 3.3e-5, 1e-4, 1e-3])
def test_the_most_that_fit_are_found_to_a_fifth(each):
    asked = []

    def time(count: int) -> float:
        asked.append(count)
        return 0.001 + each * count

    budget = 0.024
    count, seconds = most_samples(time, budget)
    fits = (budget - 0.001) / each
    assert seconds == time(count)
    assert count == (MOST if fits > MOST else pytest.approx(fits, rel=0.25) if fits > FEWEST else FEWEST)
    assert max(asked) <= max(2.1 * fits, FEWEST)  # a plan that takes minutes is never tried
    assert len(asked) < 15


@pytest.fixture
def timed(monkeypatch, tmp_path):
    """Plans that seem to take 40 µs a sample; what was timed is in the list."""
    asked = []

    def plan_time(scene, compiled, device, *, envs, terms, engine):
        asked.append(scene.planner.samples)
        return 4e-5 * scene.planner.samples * envs

    monkeypatch.setattr(module, "plan_time", plan_time)
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "scenes")
    return asked


def test_what_fits_is_measured_once_and_kept(timed):
    scene = make_scene(planner=OPEN)
    found = fit_samples(scene, compiled=compiled(scene)).planner.samples
    assert 0.75 * SHARE < 4e-5 * found / scene.timing.control_dt <= SHARE
    first = len(timed)
    assert fit_samples(scene, compiled=compiled(scene)).planner.samples == found
    assert len(timed) == first
    assert fit_samples(scene, envs=4, compiled=compiled(scene)).planner.samples < found / 2
    assert len(timed) > first


def test_what_was_measured_is_told_also_when_it_was_kept(timed, caplog):
    scene = make_scene(planner=OPEN)
    with caplog.at_level(logging.INFO, logger="warpmpc"):
        found = fit_samples(scene, compiled=compiled(scene)).planner.samples
        fit_samples(scene, compiled=compiled(scene))
        first = len(timed)
        fit_samples(scene, compiled=compiled(scene), measure=True)
    assert len(timed) == 2 * first
    now, kept, again = (record.message for record in caplog.records if "planner.samples" in record.message)
    assert now == again
    assert now.startswith(
        f"planner.samples = {found}: their plan takes {0.04 * found:.1f} ms of the control's 40 ms, m"
    )
    assert kept.startswith(now.removesuffix("now"))
    assert kept.endswith(f"on {time.strftime('%Y-%m-%d')} (warpmpc check --measure does it again)")


def test_a_number_that_is_given_is_taken(timed):
    scene = make_scene()
    assert fit_samples(scene) is scene
    assert not timed


def test_an_episode_plans_with_what_fits(timed):
    scene = make_scene(planner=OPEN, engine={"threads": 1})
    episode = Episode(scene, engine="mujoco", compiled=compiled(scene))
    assert episode.controller.shape.samples == fit_samples(scene, engine="mujoco", device="cpu").planner.samples


def test_a_controller_does_not_measure():
    scene = make_scene(planner=OPEN)
    with pytest.raises(SceneError, match=r"planner\.samples: a controller does not measure: warpmpc\.fit_samples"):
        warpmpc.Controller(scene, compiled=compiled(scene))


@pytest.mark.parametrize(
    ("overrides", "steps"),
    [([], 15), (["timing.control_dt=0.03"], 14), (["planner.dt=0.3"], 4), (["planner.dt=[0.1,0.2,0.2]"], 3)],
)
def test_a_horizon_that_is_left_open_looks_about_a_second_ahead(overrides, steps):
    scene = load_scene("panda_reach_pose", overrides=["planner.horizon=auto", *overrides])
    assert scene.planner.horizon == steps
    assert TimeGrid.of(scene).steps == steps


def test_a_horizon_and_samples_may_be_open_together(timed):
    scene = make_scene(planner={"samples": "auto", "horizon": "auto"})
    found = fit_samples(scene, compiled=compiled(scene))
    assert (found.planner.horizon, type(found.planner.samples)) == (15, int)


def test_an_open_horizon_of_steps_that_grow_is_refused():
    with pytest.raises(SceneError, match=r'planner: horizon = "auto" does not go with steps that grow'):
        load_scene("storm_reach", overrides=["planner.horizon=auto"])
    with pytest.raises(SceneError, match=r"planner\.horizon: no such choice; found 'far'; allowed: auto"):
        load_scene("storm_reach", overrides=["planner.horizon=far"])


def test_a_file_may_leave_it_open():
    scene = load_scene("cylinder_push", overrides=["planner.samples=auto"])
    assert scene.planner.samples is SampleCount.AUTO
    with pytest.raises(SceneError, match=r"planner\.samples: no such choice; found 'many'; allowed: auto"):
        load_scene("cylinder_push", overrides=["planner.samples=many"])


def test_a_plan_that_may_take_minutes_is_warned_of_with_the_key_that_makes_it_long(caplog):
    scene, usual = make_scene(planner={"samples": 500_000, "horizon": 10}), make_scene()
    for large in (scene, usual):
        options = {"engine": "mujoco", "device": "cpu", "terms": (), "compiled": None}
        assert module.fit_to_machine(large, **options) == (large.planner.samples, "mujoco", "cpu")
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "planner.samples = 500000: a plan has 5e+06 steps of rollouts and may take minutes: lower this, or take a GPU"
    ]
