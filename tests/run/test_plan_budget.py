# SPDX-License-Identifier: Apache-2.0
"""Plans that would take minutes are refused before one begins, with the key that makes them long."""

import logging

import pytest
from small_scenes import make_scene

from warpmpc.run.plan_budget import require_short_plans
from warpmpc.scene.errors import SceneError


def scene(**planner):
    return make_scene(planner={"horizon": 10, **planner})


def machine(step: float, *, ahead: float = 0.0, rolled: list | None = None):
    """Times plans as one would that takes so long for a step of a rollout [s], and for what is before them."""

    def time(scene) -> float:
        planner = scene.planner
        steps = planner.samples * planner.horizon * planner.domains
        if rolled is not None:
            rolled.append(steps)
        return planner.iterations * (ahead + step * steps)

    return time


@pytest.mark.parametrize(
    ("planner", "key"),
    [
        ({"samples": 3_000_000}, "planner.samples"),
        ({"samples": 3000, "iterations": 900}, "planner.iterations"),
        ({"samples": 64, "domains": 50_000}, "planner.domains"),
        ({"samples": 64, "horizon": 500_000, "knots": 8}, "planner.horizon"),
    ],
)
def test_the_key_that_makes_a_plan_long_is_named(planner, key):
    rolled = []
    with pytest.raises(SceneError, match=r"a plan would take about [\d.]+ (min|hours|days) on this machine") as caught:
        require_short_plans(scene(**planner), machine(1e-5, rolled=rolled))
    assert (caught.value.key, caught.value.found) == (key, planner[key.partition(".")[2]])
    assert max(rolled) < 1e7  # what tells it takes no minutes itself


def test_what_a_plan_takes_ahead_of_its_rollouts_is_not_multiplied(caplog):
    caplog.set_level(logging.INFO, "warpmpc")
    require_short_plans(scene(samples=3_000_000), machine(1e-8, ahead=1e-3))
    assert not caplog.messages
    require_short_plans(scene(samples=3_000_000), machine(1e-7, ahead=1e-3))
    assert caplog.messages == ["a plan takes about 3.2 s on this machine"]


def test_plans_of_usual_size_are_not_measured():
    require_short_plans(scene(samples=8192), None)
