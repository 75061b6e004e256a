# SPDX-License-Identifier: Apache-2.0
"""Plants that differ from the planner's model: what is changed, what the table says, and that the command goes on."""

import numpy as np
import pytest
from studies import wrong_model
from studies.equal_time.cells import drive
from studies.wrong_model import NOMINAL, Episode, lines, run, settings

import warpmpc
from warpmpc.run.records import Records


def test_every_setting_changes_the_plant_and_nothing_else():
    for task in wrong_model.SCENES:
        nominal = Episode(task=task, strategy=NOMINAL, overrides=(), seed=0).scene
        assert not nominal.plant.factor
        for wrong, overrides in settings(task).items():
            scene = warpmpc.load_scene(task, overrides=("plant.randomize=false", "engine.threads=1", *overrides))
            assert (scene.plant != nominal.plant) == (wrong != NOMINAL), (task, wrong)
            others = {"plant": nominal.plant, **({"object": nominal.object} if "size" in wrong else {})}
            assert scene.model_copy(update=others) == nominal, (task, wrong)


def test_objects_are_wrong_where_there_are_any_else_robots_and_the_ground():
    box = settings("omni_push_box")
    assert box["mass +30 %"] == ("plant.factor.box.mass=1.3",)
    assert box["size -10 %"][0] == "plant.factor.box.size=0.9"
    assert "delay 20 ms" not in box  # half a control
    assert box["delay 80 ms"] == ("plant.delay=0.08",)
    dog = settings("quadruped_walk")
    assert dog["mass -30 %"] == ("plant.factor.dog.mass=0.7",)
    assert dog["friction -30 %"] == ("plant.factor.dog.friction=0.7", "plant.factor.ground.friction=0.7")
    assert not [wrong for wrong in dog if wrong.startswith("size")]


@pytest.mark.parametrize("wrong", ["size +10 %", "size -10 %"])
def test_objects_of_another_size_start_on_the_floor(wrong):
    task = "omni_push_box"
    plant = warpmpc.Plant(Episode(task=task, strategy=wrong, overrides=settings(task)[wrong], seed=0).scene)
    box = plant.model.body("box")
    half = plant.model.geom_size[int(box.geomadr[0]), 2]
    assert half == pytest.approx(0.15 * (1.1 if "+" in wrong else 0.9))
    assert plant.state.joint_q[5] == pytest.approx(half, abs=1e-6)


@pytest.mark.parametrize("task", wrong_model.SCENES)
def test_the_friction_that_acts_is_what_the_setting_says(task):
    def acting(wrong):
        model = warpmpc.Plant(Episode(task=task, strategy=wrong, overrides=settings(task)[wrong], seed=0).scene).model
        floor, touching = model.geom_friction[model.geom_bodyid == 0, 0], model.geom_friction[-1, 0]
        return touching if settings(task).get("size +10 %") else max(floor.max(), touching)

    assert acting("friction -30 %") == pytest.approx(0.7 * acting(NOMINAL))


def test_an_episode_ends_when_it_is_over():
    def episode(*overrides):
        return Episode(task="pendulum", strategy=NOMINAL, overrides=overrides, seed=3)

    easy = episode("planner.samples=24")
    costs, _, reached = drive(easy, to_the_end=False)
    assert run(easy) == {"reached": reached, "cost": pytest.approx(np.mean(costs))}
    assert 0.0 < reached < easy.seconds
    assert len(costs) == round(reached / easy.scene.timing.control_dt)
    assert run(episode("timing.timeout=0.2"))["reached"] is None


def test_a_line_has_what_is_done(tmp_path):
    records, episodes = Records(tmp_path / "wrong_model.jsonl"), []
    for seed, (reached, cost) in enumerate([(2.0, 1.0), (4.0, 3.0), (None, None), (None, 2.0)]):
        episodes.append(Episode(task="pendulum", strategy="mass +30 %", overrides=(), seed=seed))
        records.add(episodes[-1].key("run"), {"reached": reached, "cost": cost})
    episodes.append(Episode(task="pendulum", strategy="mass +30 %", overrides=(), seed=4))  # not made yet
    assert lines(episodes, records)[2:] == ["| `pendulum` | mass +30 % | 2 of 4 | 3.00 | 2 |"]


@pytest.mark.slow
def test_the_command_keeps_what_is_done_and_goes_on(tmp_path, capfd):
    command = ["--scenes", "pendulum", "--runs", "2", "--set", "timing.timeout=0.2", "--out", str(tmp_path)]
    assert wrong_model.main([*command, "--limit", "0.1"]) == 1
    assert wrong_model.main(command) == 0
    done = (tmp_path / "wrong_model.jsonl").read_text()
    assert wrong_model.main(command) == 0
    assert (tmp_path / "wrong_model.jsonl").read_text() == done  # nothing was run again
    out = capfd.readouterr().out
    assert "| `pendulum` | mass +30 % | 0 of 2 | - |" in out
