# SPDX-License-Identifier: Apache-2.0
"""An episode: its result as JSON, the throw-away plan that changes nothing, drawn tasks, Ctrl-C."""

import json
import math

import numpy as np
import pytest

from warpmpc import Controller, Plant, load_scene, run_episode
from warpmpc.loop.run.episode import Episode, EpisodeInterrupted, compile_shared
from warpmpc.loop.run.result import EpisodeResult
from warpmpc.scene.draw import draw_task
from warpmpc.scene.model.compiled import compile_scene

TINY = ["planner.samples=16", "planner.horizon=4", "timing.timeout=0.4"]
NOISY = [*TINY, "planner.noise.redraw=true", "plant.noise.position=0.05", "plant.noise.velocity=0.02"]


@pytest.fixture(scope="module")
def compiled():
    return compile_scene(load_scene("omni_push_box"))


class Log:
    """Keeps every control, and whether it was closed."""

    def __init__(self):
        self.controls, self.closed = [], 0

    def log(self, control):
        self.controls.append(control.copy())

    def close(self):
        self.closed += 1


def test_the_throw_away_plan_changes_no_bit(compiled):
    scene = load_scene("omni_push_box", overrides=NOISY)
    mpc, plant = Controller(scene, seed=5, compiled=compiled), Plant(scene, seed=5, compiled=compiled)
    plain = []
    while not plant.done:
        plain.append(mpc.step(plant.observe()))
        plant.apply(plain[-1])

    log = Log()
    episode = Episode(scene, seed=5, compiled=compiled)
    result = episode.run(recorder=log)
    np.testing.assert_array_equal(log.controls, plain)
    np.testing.assert_array_equal(episode.plant.state.joint_q, plant.state.joint_q)
    assert result.cost == mpc.info.cost
    assert (result.steps, log.closed) == (10, 1)


def test_another_seed_is_another_episode(compiled):
    scene = load_scene("omni_push_box", overrides=TINY)
    first, second = (run_episode(scene, seed=seed, compiled=compiled) for seed in (0, 1))
    assert first.cost != second.cost


def test_every_step_is_reported(compiled):
    seen = []
    scene = load_scene("omni_push_box", overrides=TINY)
    log = Log()
    run_episode(
        scene,
        compiled=compiled,
        recorder=lambda controller, plant: log,
        on_step=lambda controller, plant, control: seen.append((plant.steps, controller.info.time)),
    )
    assert [steps for steps, _ in seen] == list(range(1, 11))
    assert [time for _, time in seen] == pytest.approx([0.04 * i for i in range(10)])
    assert len(log.controls) == 10


def test_an_interrupted_episode_tells_how_far_it_came(compiled):
    def stop(controller, plant, control):
        if plant.steps == 3:
            raise KeyboardInterrupt

    log = Log()
    with pytest.raises(EpisodeInterrupted) as caught:
        Episode(load_scene("omni_push_box", overrides=TINY), compiled=compiled).run(recorder=log, on_step=stop)
    result = caught.value.result
    assert (result.reason, result.success, result.steps, log.closed) == ("interrupted", False, 3, 1)


def test_drawn_scenes_share_nothing_that_is_drawn():
    scene = load_scene("point_reach", overrides=TINY)
    assert compile_shared(scene) is None
    _, drawn = draw_task(scene, 4)
    result = run_episode(scene, seed=4)
    assert result.drawn == drawn
    assert json.loads(json.dumps(result.to_json()))["drawn"]["goal.position"] == list(drawn["goal.position"])


def test_scenes_that_draw_goals_alone_share_their_compiled_form():
    draw = 'randomize_task.draw."goal.position"={ low = [0.0, 0.0], high = [1.0, 1.0] }'
    scene = load_scene("omni_push_box", overrides=[*TINY, draw])
    shared = compile_shared(scene)
    episode = Episode(scene, seed=2, compiled=shared)
    assert episode.controller.compiled is shared
    assert tuple(episode.plant.goal[:2]) == pytest.approx(episode.drawn["goal.position"])


def make_result(**changes) -> EpisodeResult:
    """A result with some fields changed."""
    values = {
        "scene": "s",
        "variant": None,
        "seed": 0,
        "engine": "mujoco",
        "device": "cpu",
        "success": True,
        "reason": "goal reached",
        "sim_time": 1.0,
        "steps": 25,
        "position_error": 0.1,
        "yaw_error": None,
        "cost": 2.0,
        "max_force": 0.0,
        "time_in_contact": 0.0,
        "plan_ms": {"p50": 1.0},
        "stages_ms": {"begin": 0.1},
        "diverged_worlds": 0,
        "samples": 16,
        "horizon": 4,
        "fallbacks": 0,
    }
    return EpisodeResult(**{**values, **changes})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_json_lacks_become_null(value):
    data = make_result(cost=value, position_error=value, plan_ms={"p50": value}, drawn={"a": (1.0, value)}).to_json()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["final"] == {"position_error_m": None, "yaw_error_rad": None, "cost": None}
    assert data["plan_ms"] == {"p50": None}
    assert data["drawn"] == {"a": [1.0, None]}


def test_only_success_has_a_time_to_goal():
    assert make_result().to_json()["time_to_goal_s"] == 1.0
    assert make_result(success=False).to_json()["time_to_goal_s"] is None
    assert "drawn" not in make_result().to_json()
