# SPDX-License-Identifier: Apache-2.0
"""Which device is taken: asked for, or measured once for a scene, whatever its episodes draw."""

import numpy as np
import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, choose_engine, load_scene
from warpmpc.loop.run import fit_samples as module
from warpmpc.scene.draw import draw_task

TIMES = {"cpu": 0.004, "cuda:0": 0.002}


@pytest.fixture
def timed(monkeypatch, tmp_path):
    """A machine that seems to have a GPU on which nothing runs; what was timed is in the list."""
    asked = []

    def plan_time(scene, compiled, device, *, envs, terms):
        asked.append((device, envs))
        return TIMES[device]

    monkeypatch.setattr(module, "plan_time", plan_time)
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "scenes")
    monkeypatch.setattr(module, "_hardware", lambda device: "a GPU")
    monkeypatch.setattr(module, "resolve", lambda scene, engine, device: ("auto", "cuda:0"))
    return asked


def test_both_devices_are_timed_once_and_the_faster_one_is_taken(timed):
    scene = make_scene()
    for _ in range(3):
        assert choose_engine(scene, compiled=compiled(scene)) == ("auto", "cuda:0")
    assert sorted(device for device, _ in timed) == ["cpu", "cuda:0"]


def test_what_was_measured_belongs_to_the_scene_and_its_batch(timed):
    scene = make_scene()
    choose_engine(scene, compiled=compiled(scene))
    choose_engine(scene, envs=8, compiled=compiled(scene))
    more = make_scene(planner={"samples": 64, "horizon": 6})
    choose_engine(more, compiled=compiled(more))
    assert len(timed) == 6


def test_episodes_that_draw_their_scene_are_measured_once(timed):
    """The key is the scene's before its random draws; keyed by what was drawn, every episode timed both devices."""
    scene = load_scene("point_reach")
    drawn = [draw_task(scene, seed)[0] for seed in (0, 1)]
    assert drawn[0] != drawn[1]
    from warpmpc.loop.run.episode import Episode

    episodes = []
    original = module.plan_time
    try:
        for seed in (0, 1):
            TIMES.update(cpu=0.001)
            episodes.append(Episode(scene, seed=seed, engine="auto"))
    finally:
        TIMES.update(cpu=0.004)
    assert original is module.plan_time
    assert len(timed) == 2
    assert {episode.controller.engine.name for episode in episodes} == {"fused"}
    assert episodes[0].drawn != episodes[1].drawn


def test_a_damaged_record_is_measured_anew(timed, tmp_path):
    scene = make_scene()
    choose_engine(scene, compiled=compiled(scene))
    (file,) = (tmp_path / "engines").iterdir()
    for text in ("{", "[]", "{}", '{"cpu": "fast"}'):
        file.write_text(text)
        timed.clear()
        choose_engine(scene, compiled=compiled(scene))
        assert len(timed) == 2


def test_what_is_asked_for_is_not_measured(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("nothing is to be measured")

    monkeypatch.setattr(module, "plan_time", refuse)
    assert choose_engine(make_scene(), engine="mujoco") == ("mujoco", "cpu")
    assert choose_engine(make_scene(), device="cpu") == ("auto", "cpu")
    assert choose_engine(make_scene(), engine="mujoco_warp", device="cpu") == ("mujoco_warp", "cpu")


def test_a_plan_is_timed_with_a_controller_that_ends():
    scene = make_scene(planner={"samples": 8, "horizon": 3})
    took = module.plan_time(scene, compiled(scene), "cpu", envs=2, terms=())
    assert 0.0 < took < 5.0
    assert np.isfinite(took)


def test_a_controller_left_to_itself_measures_nothing(monkeypatch):
    monkeypatch.setattr(module, "plan_time", lambda *_, **__: 1 / 0)
    scene = make_scene(planner={"samples": 8, "horizon": 3})
    assert Controller(scene, compiled=compiled(scene), device="cpu").engine.name == "fused"


@pytest.mark.parametrize(
    ("engine", "device", "says"),
    [("bullet", "auto", "no engine 'bullet'"), ("auto", "tpu", "no device 'tpu'"), ("mujoco", "gpu", "no device")],
)
def test_what_is_not_there_is_named(engine, device, says):
    with pytest.raises(ValueError, match=says):
        choose_engine(make_scene(), engine=engine, device=device)
