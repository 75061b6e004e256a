# SPDX-License-Identifier: Apache-2.0
"""``warpmpc bench``: plan times of several settings, paired plan by plan."""

import json

import numpy as np
import pytest

from warpmpc.cli.bench import median_interval

FAST = ["--plans", "12", "--set", "planner.samples=16", "--set", "planner.horizon=4"]


def test_settings_are_timed_at_the_same_states(command):
    done = command(
        "bench", "point_reach", "--engine", "fused", "--engine", "mujoco", "--json", *FAST,
        "--against", "planner.samples=4096 planner.horizon=8", "--set", "timing.timeout=0.4",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    first, other, larger = report["settings"]
    assert (first["engine"], other["engine"], larger["engine"]) == ("fused", "mujoco", "fused")
    assert (larger["samples"], larger["horizon"]) == (4096, 8)
    for row in report["settings"]:
        ms = row["plan_ms"]
        assert 0.0 < ms["p50"] <= ms["p90"] <= ms["p99"] <= ms["max"]
    assert "ratio" not in first
    assert larger["ratio"]["p50"] > 1.5  # 512 times the work; at 32 times the time of a launch still counted for most
    assert larger["ratio"]["low"] <= larger["ratio"]["p50"] <= larger["ratio"]["high"]
    assert report["plans"] == 12
    assert len(report["machine"]["load"]) == 2


def test_the_table_tells_the_machine_and_its_load(command):
    done = command("bench", "point_reach", "--samples", "16", "--samples", "32", "--plans", "5")
    assert done.returncode == 0, done.stderr
    assert "planner.samples=32" in done.stdout
    assert "16 × " in done.stdout
    assert "5 plans each after 10" in done.stdout
    assert "load " in done.stdout


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--against", "planner.sampels=3"], "Did you mean 'samples'?"),
        (["--against", "robot.base.floating=true"], "other robots, objects or drives"),
        (["--engine", "nothing"], "no engine 'nothing'"),
    ],
)
def test_a_setting_that_cannot_be_compared_is_one_message(args, says, command):
    done = command("bench", "point_reach", *args)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert done.stderr.count("error: ") == 1


def test_the_median_has_an_interval_by_order():
    values = np.random.default_rng(0).permutation(np.arange(101.0))
    assert median_interval(values) == (50.0, 40.0, 60.0)
