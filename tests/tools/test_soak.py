# SPDX-License-Identifier: Apache-2.0
"""Planning for long: what the tool finds, and that there is nothing to find.

Slow ones by hand: pytest -m slow tests/tools/test_soak.py
"""

from dataclasses import replace

import pytest
from benches import soak, soak_wire
from small_scenes import make_scene

TENTHS = [soak.Tenth(plans=k, memory=500.0, p50=2.0, p99=3.0, worst=9.0, faults=0) for k in range(1, 11)]


def test_memory_that_grows_and_plans_that_slow_down_are_found():
    assert soak.complaints(TENTHS, growth=20.0, slower=1.2) == []
    leak = [replace(tenth, memory=500.0 + 3.0 * tenth.plans) for tenth in TENTHS]
    assert soak.complaints(leak, growth=20.0, slower=1.2) == ["memory grew by 27.0 MB"]
    slow = [replace(tenth, p50=2.0 + 0.1 * tenth.plans) for tenth in TENTHS]
    assert soak.complaints(slow, growth=20.0, slower=1.2) == ["plans took 1.43 times as long at the end"]


@pytest.mark.slow
def test_thousands_of_plans_leave_memory_as_it_is():
    scene = make_scene(engine={"threads": 1}, timing={"control_dt": 0.04, "timeout": 2.0})
    tenths = list(soak.soak(scene, 3000))
    assert [tenth.plans for tenth in tenths] == list(range(300, 3001, 300))
    assert all(0.0 < tenth.p50 <= tenth.p99 <= tenth.worst for tenth in tenths)
    assert soak.complaints(tenths, growth=5.0, slower=float("inf")) == []  # cores are shared: times are not judged
    assert tenths[-1].faults == 0


def test_a_robot_whose_memory_grows_is_found():
    def tenths(growth: float) -> list[soak_wire.Tenth]:
        return [
            soak_wire.Tenth(360.0 * k, 500.0 + growth * k, 400.0, 300.0, 72_000 * k, 18_000 * k, 0)
            for k in range(1, 11)
        ]

    robot = {"received": 720_000, "refused": {"stale": 0}, "unsafe": 0}
    assert soak_wire.complaints(tenths(0.1), robot, growth=5.0) == []
    (grown,) = soak_wire.complaints(tenths(1.0), robot, growth=5.0)
    assert grown == "memory of the robot's process grew by 9.0 MB"
    assert "500.1 after 6 min, 501.0 at the end" in soak_wire.row("cart", tenths(0.1), 0.2, robot)[5]
    bad = soak_wire.complaints(tenths(0.1), robot | {"refused": {"stale": 2}, "unsafe": 1}, growth=5.0)
    assert bad == ["the robot refused commands: {'stale': 2}", "1 unsafe commands"]
