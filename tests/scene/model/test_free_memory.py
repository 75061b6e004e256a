# SPDX-License-Identifier: Apache-2.0
"""What does not fit into memory is refused before it is allocated."""

import pytest
from small_scenes import compiled, make_scene

import warpmpc
from warpmpc import SceneError
from warpmpc.scene.model import trajectory
from warpmpc.scene.model.trajectory import BatchSize, Trajectory


def test_a_trajectory_takes_what_it_says():
    scene = make_scene()
    layout, shape = compiled(scene).layout, BatchSize(2, 5, 3, 7)
    out = Trajectory.allocate(shape, layout, 4, "cpu")
    assert sum(array.capacity for array in vars(out).values()) == Trajectory.bytes(shape, layout, 4)


def test_a_container_has_what_it_may_use(tmp_path, monkeypatch):
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("1000000\n")
    monkeypatch.setattr(trajectory, "CGROUP", tmp_path)
    assert trajectory.free_memory("cpu") == 2000000
    (tmp_path / "memory.stat").write_text("anon 250000\ninactive_anon 0\ninactive_file 600000\nactive_file 70000\n")
    assert trajectory.free_memory("cpu") == 2600000  # files that were read make room
    (tmp_path / "memory.max").write_text("max\n")
    assert trajectory.free_memory("cpu") > 2000000


@pytest.mark.parametrize(
    ("planner", "key", "says"),
    [
        (
            {"samples": 400_000, "horizon": 60},
            "planner.samples",
            r"400000 samples need .* MB of memory, 50 MB are free",
        ),
        ({"samples": 2, "horizon": 60_000}, "planner.knots", r"60000 knots need .*GB of memory"),
        ({"samples": 40_000, "horizon": 60, "knots": 4}, "planner.samples", r"records of 40000 worlds × 60 steps need"),
    ],
    ids=["knots", "splines", "records"],
)
def test_rollouts_that_do_not_fit_are_refused(monkeypatch, planner, key, says):
    monkeypatch.setattr(trajectory, "free_memory", lambda device: 50_000_000)
    scene = make_scene(planner=planner, engine={"name": "mujoco", "threads": 1})
    with pytest.raises(SceneError, match=rf"{key}: .*{says}"):
        warpmpc.Controller(scene, compiled=compiled(scene))
