# SPDX-License-Identifier: Apache-2.0
"""From how many samples a GPU is cheaper: the crossing, what is kept, the table and the picture."""

import json

import pytest
from benches import crossover
from benches.crossover import GPU, Bench, Place, figures, opened, picture, predicted, shown

SIZES = (16, 64, 256, 1024, 4096)


def times(ms):
    return {str(n): {"p10": ms(n), "p50": ms(n), "p90": ms(n), "plans": 9} for n in SIZES}


def report():
    found = {"1 thread": times(lambda n: 0.01 * n), "16 threads": times(lambda n: 0.001 * n)}
    scenes = {"point_reach": found | {"GPU": times(lambda n: 2.0)}, "mobile_pick": found}
    here = {"cpu": "a processor", "cores": 16, "gpus": ["a GPU"]}
    return {"date": "2026-01-01", "command": "python", "machine": here, "scenes": scenes}


def test_the_crossing_of_power_laws_is_exact_and_bounds_are_told_where_there_is_none():
    linear, flat = {n: 0.01 * n for n in SIZES}, dict.fromkeys(SIZES, 2.0)
    assert crossover.crossover(linear, flat) == pytest.approx(200.0)
    assert crossover.crossover(linear, dict.fromkeys(SIZES, 0.1)) == "< 16"
    assert crossover.crossover(linear, dict.fromkeys(SIZES, 100.0)) == "> 4096"
    assert crossover.crossover({16: 1.0}, {64: 1.0}) is None
    noisy = {16: 3.0, 64: 1.0, 256: 4.0}  # the GPU is slower at 64: what holds from there on counts
    assert 64 < crossover.crossover(noisy, dict.fromkeys(noisy, 2.0)) < 256


def test_the_table_has_a_row_for_each_scene_and_the_picture_a_panel(tmp_path):
    table = figures(report())
    (point, pick) = table["groups"][0]["rows"]
    assert point[2:] == ["200", "2000"]
    assert pick[2:] == ["-", "-"]
    assert all(len(row) == len(table["columns"]) for row in (point, pick))
    picture(report(), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000
    assert [shown(v) for v in (None, "< 16", 1234.5)] == ["-", "< 16", "1200"]


def test_times_of_another_machine_are_not_mixed_in(tmp_path):
    path = tmp_path / "crossover.json"
    path.write_text(json.dumps(report()))
    assert opened(path, report()["machine"], "")["scenes"].keys() == {"point_reach", "mobile_pick"}
    with pytest.raises(ValueError, match="another machine"):
        opened(path, report()["machine"] | {"cores": 2}, "")


def test_a_plan_is_expected_to_take_longer_with_more_samples():
    assert predicted(times(lambda n: 0.01 * n), 8192) == pytest.approx(0.08192)
    assert predicted({}, 16) == 0.0


def test_plans_are_timed(device):
    found = Bench("point_reach").time(Place("cpu", 1) if device == "cpu" else Place(GPU, None), 16)
    assert 0.0 < found["p10"] <= found["p50"] <= found["p90"]
    assert found["plans"] >= 5


def test_a_second_command_goes_on_where_one_ended(tmp_path, monkeypatch, capsys):
    asked = []

    def time(self, place, samples):
        asked.append((self.scene, place.name, samples))
        return {"p10": 1.0, "p50": 1.0, "p90": 1.0, "plans": 5}

    monkeypatch.setattr(Bench, "time", time)
    monkeypatch.setattr(crossover, "compiled_all", lambda scenes, *_: {scene: {"cpu"} for scene in scenes})
    for _ in range(2):
        crossover.main(["--scenes", "point_reach", "--device", "cpu", "--out", str(tmp_path)])
    assert len(asked) == len(set(asked)) >= len(crossover.SAMPLES)
    assert "GPU cheaper from: 1 thread -" in capsys.readouterr().out
