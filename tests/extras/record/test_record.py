# SPDX-License-Identifier: Apache-2.0
"""Recordings read back with rerun's own reader: they hold what plant and controller had, even after a kill."""

import resource
import signal
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from small_scenes import DISC, layout_of, make_scene

from warpmpc import Controller, Plant, RecordingSwitch, State, load_scene
from warpmpc.extras.record.recorder import ROWS, RerunRecorder
from warpmpc.extras.record.scene_drawing import draw_shape
from warpmpc.extras.record.shapes import FORCE_LENGTH, ContactPoints
from warpmpc.planner.controller.rollout_paths import COLORS
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.layout import ShapeInfo, rotate
from warpmpc.scene.schema_bodies import Cloud

pytestmark = pytest.mark.filterwarnings(f"error::{RerunWarning.__module__}.{RerunWarning.__name__}")

SMALL = ["planner.samples=32", "planner.horizon=6", "timing.timeout=1"]
FAN = 5


class Recording:
    """All chunks of a file by entity."""

    def __init__(self, path):
        self.reader = RrdReader(path)
        self.chunks = {}
        for chunk in self.reader.stream().to_chunks():
            self.chunks.setdefault(chunk.entity_path, []).append(chunk)

    def static(self, entity):
        """Components logged once, and how many times they were."""
        rows = [c for c in self.chunks.get(entity, []) if c.is_static]
        return {name for c in rows for name in c.to_record_batch().schema.names[1:]}, sum(c.num_rows for c in rows)

    def over_time(self, entity, component):
        """Steps ``[n]``, times [s] ``[n]`` and values of a component, in the order of time."""
        rows = []
        for chunk in self.chunks.get(entity, []):
            batch = chunk.to_record_batch()
            if not chunk.is_static and component in batch.schema.names:
                columns = (batch["step"].to_pylist(), batch["time"].cast("int64").to_pylist())
                rows += zip(*columns, batch[component].to_pylist(), strict=True)
        rows.sort(key=lambda row: row[0])
        return [r[0] for r in rows], [1e-9 * r[1] for r in rows], [r[2] for r in rows]

    def curve(self, entity):
        """Steps and values of a curve."""
        steps, _, values = self.over_time(entity, "Scalars:scalars")
        return steps, [v[0] for v in values]


@dataclass
class Loop:
    """A closed loop and what it held at every step."""

    controller: Controller
    plant: Plant
    infos: list = field(default_factory=list)
    controls: list = field(default_factory=list)
    bodies: list = field(default_factory=list)
    errors: list = field(default_factory=list)
    costs: list = field(default_factory=list)

    def step(self, recorder):
        control = self.controller.step(self.plant.observe())
        self.plant.apply(control)
        recorder.log(control)
        self.infos.append(self.controller.info)
        self.controls.append(control)
        self.bodies.append(self.plant.body_q)
        self.errors.append(self.plant.error.position)
        self.costs.append(self.controller.engine.cost.numpy()[0].copy())


@pytest.fixture(scope="module")
def compiled():
    scene = load_scene("omni_push_box", overrides=SMALL)
    return scene, compile_scene(scene)


@pytest.fixture
def loop(compiled):
    scene, built = compiled
    controller = Controller(scene, compiled=built)
    return Loop(controller, Plant(scene, compiled=built, task=controller.task))


@pytest.fixture(scope="module")
def run(compiled, tmp_path_factory):
    """One second of pushing, recorded."""
    scene, built = compiled
    loop = Loop(Controller(scene, compiled=built), Plant(scene, compiled=built))
    path = tmp_path_factory.mktemp("record") / "run.rrd"
    loop.bodies.append(loop.plant.body_q)
    loop.errors.append(loop.plant.error.position)
    with RerunRecorder(path, loop.controller, loop.plant, fan=FAN) as recorder:
        while not loop.plant.done:
            loop.step(recorder)
    return loop, Recording(path)


def test_every_body_moves_as_the_plant_s(run):
    loop, recording = run
    for body, entity in [(3, "/scene/base/base_link"), (4, "/scene/box")]:
        steps, times, at = recording.over_time(entity, "Transform3D:translation")
        _, _, turned = recording.over_time(entity, "Transform3D:quaternion")
        assert steps == list(range(loop.plant.steps + 1))
        np.testing.assert_allclose(times, 0.04 * np.arange(26), atol=1e-9)
        expected = np.array(loop.bodies)[:, body]
        np.testing.assert_array_equal(np.array(at)[:, 0], expected[:, :3])
        np.testing.assert_array_equal(np.array(turned)[:, 0], expected[:, 3:])
    np.testing.assert_array_equal(np.array(at)[-1, 0], loop.plant.body_q[4, :3])


def test_curves_are_the_infos(run):
    loop, recording = run
    decided = list(range(len(loop.infos)))
    expected = {f"/cost/{label}": [i.terms[label] for i in loop.infos] for label in loop.infos[0].terms}
    expected |= {"/cost/total": [i.cost for i in loop.infos]}
    expected |= {f"/temperature/{name}": [getattr(i, name) for i in loop.infos] for name in ("beta", "eta")}
    expected |= {
        f"/control/{name}": [float(u[k]) for u in loop.controls]
        for k, name in enumerate(("base/x", "base/y", "base/yaw"))
    }
    expected |= {"/plan_ms/total": [i.plan_ms for i in loop.infos], "/plan_ms/budget": [40.0] * len(loop.infos)}
    expected |= {f"/plan_ms/{stage}": [i.stages_ms[stage] for i in loop.infos] for stage in loop.infos[0].stages_ms}
    expected |= {"/diverged_worlds": [i.diverged_worlds for i in loop.infos]}
    for entity, values in expected.items():
        assert recording.curve(entity) == (decided, values), entity
    assert recording.curve("/goal_error/position") == (list(range(len(loop.infos) + 1)), loop.errors)


def test_predicted_controls_are_those_of_the_best_rollout_between_their_limits(run):
    loop, recording = run
    steps, _, lanes = recording.over_time("/prediction", "LineStrips2D:strips")
    assert steps == list(range(len(loop.infos)))
    rollout = loop.controller.rollout()  # of the last plan
    lower, upper = loop.controller.limits
    last = np.array(lanes[-1])  # [nu, T, 2]
    assert last.shape == (3, len(rollout.control), 2)
    for i in range(3):
        share = (2.5 * i - last[i, :, 1] + 1.0) / 2.0  # lanes are below each other
        np.testing.assert_allclose(lower[i] + share * (upper[i] - lower[i]), rollout.control[:, i], atol=1e-5)
    assert (np.diff(last[0, :, 0]) > 0.0).all()


def test_a_recording_may_be_started_and_stopped_while_the_loop_runs(loop, tmp_path):
    switch = RecordingSwitch()
    for step in range(9):
        if step == 3:
            switch.start(tmp_path / "a.rrd", loop.controller, loop.plant)
        if step == 5:
            assert switch.path == tmp_path / "a.rrd"
            assert switch.stop() == tmp_path / "a.rrd"
        if step == 7:
            switch.start(tmp_path / "b.rrd", loop.controller, loop.plant)
        loop.step(switch)
    switch.start(tmp_path / "c.rrd", loop.controller, loop.plant)  # finishes the one before
    switch.stop()
    assert (switch.path, switch.stop()) == (None, None)
    for name, steps in {"a": [3, 4, 5], "b": [7, 8, 9], "c": [9]}.items():
        found, _, _ = Recording(tmp_path / f"{name}.rrd").over_time("/scene/box", "Transform3D:translation")
        assert found == steps


def test_shapes_are_logged_once(run):
    loop, recording = run
    for entity, geometry in [
        ("/scene/base/base_link/shape_0", "Boxes3D:half_sizes"),
        ("/scene/box/box", "Boxes3D:half_sizes"),
        ("/scene/wall_1/wall_1", "Boxes3D:half_sizes"),
        ("/scene/ground/ground", "Mesh3D:vertex_positions"),
        ("/goal/box", "Boxes3D:half_sizes"),
    ]:
        components, rows = recording.static(entity)
        assert geometry in components
        assert rows == 1
        assert all(chunk.is_static for chunk in recording.chunks[entity])
    assert "/scene/base/base_link/shape_1" not in recording.chunks  # a collision shape behind a visual
    size = recording.chunks["/scene/box/box"][0].to_record_batch()["Boxes3D:half_sizes"].to_pylist()[0][0]
    nominal = np.array(loop.plant.layout.shapes[2].scale)
    np.testing.assert_allclose(size, nominal + 0.5 * loop.plant.properties.size[0, 0], rtol=1e-6)


def test_rollouts_start_where_the_plant_is_and_the_fan_is_coloured_by_cost(run):
    loop, recording = run
    steps, _, best = recording.over_time("/rollouts/best", "LineStrips3D:strips")
    _, _, fan = recording.over_time("/rollouts/samples", "LineStrips3D:strips")
    _, _, colors = recording.over_time("/rollouts/samples", "LineStrips3D:colors")
    assert steps == list(range(len(loop.infos)))
    for k in steps:
        box, tip = np.array(best[k])
        assert box.shape == (7, 3)
        base = loop.bodies[k][3]
        np.testing.assert_allclose(box[0], loop.bodies[k][4, :3], atol=1e-5)
        np.testing.assert_allclose(tip[0], base[:3] + rotate(base[3:], np.array([0.31, 0.0, 0.0])), atol=1e-5)
        assert np.array(fan[k]).shape == (2 * FAN, 7, 3)
        rank = [int(np.flatnonzero(c == COLORS)[0]) for c in colors[k]]
        assert rank == sorted(rank, reverse=True)  # from the cheapest on
    # the last plan is still in the controller
    poses = loop.controller.engine.record([loop.infos[-1].best]).body_q[:, 0, 4, :3]
    np.testing.assert_array_equal(np.array(best[-1][0], dtype=np.float32), poses)
    np.testing.assert_array_equal(fan[-1][:2], best[-1])  # the cheapest of the fan


def test_the_file_opens_with_views_of_its_own(run):
    _, recording = run
    (stored,) = recording.reader.blueprints()
    names = [chunk.entity_path for chunk in recording.reader.stream(store=stored).to_chunks()]
    assert sum(name.endswith("/ViewContents") for name in names) == 10
    assert any(name.endswith("/EyeControls3D") for name in names)
    (recorded,) = recording.reader.recordings()
    assert recorded.application_id == stored.application_id == "warpmpc_omni_push_box"


def test_a_moved_goal_moves_its_ghost(loop, tmp_path):
    with RerunRecorder(tmp_path / "goal.rrd", loop.controller, loop.plant) as recorder:
        loop.step(recorder)
        loop.controller.task["goal"] = np.array([1.0, 2.0, 0.15, 0.0, 0.0, 0.0, 1.0])
        loop.step(recorder)
        loop.step(recorder)
    steps, _, at = Recording(tmp_path / "goal.rrd").over_time("/goal", "Transform3D:translation")
    assert steps == [0, 1]
    np.testing.assert_allclose(at[1][0], [1.0, 2.0, 0.15], rtol=1e-6)


def test_a_cloud_is_drawn_when_its_points_are_new(compiled, tmp_path):
    voxel, path = 0.1, tmp_path / "cloud.rrd"
    cloud = {"name": "seen", "low": (0.0, 0.0, 0.0), "high": (2.0, 1.0, 1.0), "voxel": voxel}
    scene = compiled[0].model_copy(update={"cloud": (Cloud(**cloud),)})
    loop = Loop(Controller(scene, compiled=compiled[1]), None)
    loop.plant = Plant(scene, compiled=compiled[1], task=loop.controller.task)
    points = np.random.default_rng(0).uniform(-0.5, 2.5, (3000, 3)).astype(np.float32)
    with RerunRecorder(path, loop.controller, loop.plant) as recorder:
        for shown in (None, points, None, points[:20], np.zeros((0, 3))):
            if shown is not None:
                loop.controller.task["seen"] = shown
            loop.step(recorder)
    recording = Recording(path)
    steps, _, drawn = recording.over_time("/cloud/seen", "Points3D:positions")
    assert steps == [1, 3, 4]
    inside = points[((points >= 0.0) & (points < (2.0, 1.0, 1.0))).all(axis=1)]
    found = np.array(drawn[0], dtype=np.float32)
    voxels = {tuple(at) for at in np.floor(inside / voxel).astype(int)}
    assert len(found) == len(voxels)  # one of each
    assert {tuple(at) for at in np.floor(found / voxel).astype(int)} == voxels
    assert {tuple(p) for p in found} <= {tuple(p) for p in inside}
    assert not drawn[2]
    assert recording.static("/cloud/seen")[1] == 1
    (stored,) = recording.reader.blueprints()
    text = b"".join(chunk.to_record_batch().serialize() for chunk in recording.reader.stream(store=stored).to_chunks())
    assert b"/cloud/**" in text


def test_forces_are_arrows_at_the_touched_obstacle(loop, tmp_path):
    with RerunRecorder(tmp_path / "force.rrd", loop.controller, loop.plant) as recorder:
        control = loop.controller.step(loop.plant.observe())
        loop.plant.apply(control)
        loop.plant._engine.sensor[0, -1, :] = 0.0
        touched = [(p.first, p.second) for p in loop.plant.pairs].index(("base", "wall_2"))
        loop.plant._engine.sensor[0, -1, 3 * touched : 3 * touched + 3] = (-3.0, 4.0, 0.0)  # on the wall
        recorder.log(control)
    recording = Recording(tmp_path / "force.rrd")
    _, _, vectors = recording.over_time("/contact", "Arrows3D:vectors")
    _, _, labels = recording.over_time("/contact", "Arrows3D:labels")
    _, _, origins = recording.over_time("/contact", "Arrows3D:origins")
    assert not vectors[0]
    np.testing.assert_allclose(vectors[1], [[3.0 * FORCE_LENGTH, -4.0 * FORCE_LENGTH, 0.0]], rtol=1e-6)
    assert labels[1] == ["5.0 N"]
    # the base stands at (0, 2) beyond the wall's face y = 1.4
    np.testing.assert_allclose(origins[1][0][1:], [1.4, 0.085], atol=0.03)
    assert recording.curve("/contact_force/base-wall_2")[1] == pytest.approx([0.0, 5.0])


def test_a_contact_point_lies_on_the_face_next_to_the_robot(loop):
    layout = loop.plant.layout
    point = ContactPoints(layout, "base", "wall_1")
    body_q = loop.plant.body_q
    body_q[3, :3] = (0.2, 1.1, 0.085)  # left of the wall, whose left face is x = 0.7
    np.testing.assert_allclose(point(body_q), [0.7, 1.1, 0.085], atol=1e-6)


def test_a_contact_point_of_two_robots_moves_with_the_second():
    robots = [{**DISC, "name": name, "position": (x, 0.0, 0.0)} for name, x in (("left", 0.0), ("right", 1.0))]
    scene = make_scene(robot=robots, goal={"frame": "left/centre", "position": (0.0, 0.0)})
    layout = layout_of(scene)
    point, body_q = ContactPoints(layout, "left", "right"), np.zeros((layout.nb, 7))
    body_q[:, 6] = 1.0
    right = layout.entity("right").bodies[-1]
    body_q[right] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(point(body_q)[:2], [0.8, 0.0], atol=1e-6)
    body_q[right] = (0.0, 3.0, 0.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    np.testing.assert_allclose(point(body_q)[:2], [0.0, 2.8], atol=1e-6)


def test_rollouts_that_mean_nothing_are_not_drawn(loop, tmp_path, caplog):
    """A fallback leaves no lines and no infinite cost; a diverged sample is not in the fan."""
    controller, plant = loop.controller, loop.plant
    with RerunRecorder(tmp_path / "nan.rrd", controller, plant, fan=100) as recorder:
        control = controller.step(plant.observe())
        cost = controller.engine.cost.numpy()
        cost[0, 7] = np.inf
        plant.apply(control)
        recorder.log(control)
        seen = plant.observe()
        control = controller.step(State(np.full_like(seen.joint_q, np.nan), seen.joint_qd, seen.time))
        assert controller.info.fallback
        plant.apply(control)
        recorder.log(control)
    recording = Recording(tmp_path / "nan.rrd")
    _, _, best = recording.over_time("/rollouts/best", "LineStrips3D:strips")
    _, _, fan = recording.over_time("/rollouts/samples", "LineStrips3D:strips")
    assert [len(row or []) for row in best] == [2, 0]
    assert [len(row or []) for row in fan] == [2 * 31, 0]
    assert recording.curve("/cost/total")[0] == [0]
    assert recording.curve("/temperature/eta")[0] == [0, 1]


@pytest.mark.parametrize("kind", ["box", "sphere", "ellipsoid", "cylinder", "capsule", "cone", "plane", "mesh"])
def test_every_shape_can_be_drawn(loop, tmp_path, kind):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    layout = replace(loop.plant.layout, meshes=((points, triangles),))
    pose = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    shape = ShapeInfo("s", "thing", -1, kind, pose, (0.1, 0.2, 0.3), mesh=0 if kind == "mesh" else None)
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "shape.rrd")
    for opacity in (1.0, 0.5):
        draw_shape(recording, f"/s{opacity}", shape, layout, reach=3.0, opacity=opacity)
    recording.disconnect()
    chunks = Recording(tmp_path / "shape.rrd").chunks
    for entity in ("/s1.0", "/s0.5"):
        names = chunks[entity][0].to_record_batch().schema.names
        assert "Transform3D:translation" in names
        assert any(name.split(":")[1] in ("half_sizes", "lengths", "vertex_positions") for name in names if ":" in name)


KILLED = f"""
import sys
from warpmpc.planner.controller.controller import Controller
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.loop.plant.plant import Plant
from warpmpc.extras.record.recorder import RerunRecorder
from warpmpc.scene.load import load_scene

scene = load_scene("omni_push_box", overrides={[*SMALL[:2], "engine.name='mujoco'", "timing.timeout=1000"]!r})
compiled = compile_scene(scene)
controller, plant = Controller(scene, compiled=compiled), Plant(scene, compiled=compiled)
recorder = RerunRecorder(sys.argv[1], controller, plant)
while True:
    control = controller.step(plant.observe())
    plant.apply(control)
    recorder.log(control)
    print("step", plant.steps, flush=True)
"""


def test_a_killed_run_leaves_all_but_its_last_steps(tmp_path):
    path, until = tmp_path / "killed.rrd", 2 * ROWS + 5
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        reached = any(line == f"step {until}\n" for line in process.stdout)
        process.send_signal(signal.SIGKILL)
    assert reached
    assert process.returncode == -signal.SIGKILL
    with pytest.warns(RerunWarning, match="no footer"):
        recording = Recording(path)
    steps, values = recording.curve("/cost/total")
    assert steps == list(range(len(steps)))
    assert len(steps) >= 2 * ROWS
    assert np.isfinite(values).all()
    assert recording.over_time("/scene/box", "Transform3D:translation")[0] == list(range(len(steps) + 1))
    assert len(recording.reader.blueprints()) == 1

    # a write that the kill tore apart
    path.write_bytes(path.read_bytes()[:-100])
    whole = tmp_path / "whole.rrd"
    with whole.open("wb") as out:
        subprocess.run([sys.executable, "-m", "rerun", "rrd", "filter", "--continue-on-error", path], stdout=out)
    assert len(Recording(whole).curve("/cost/total")[0]) >= ROWS


def test_a_file_that_cannot_be_written_is_told_before_the_run(loop, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.rrd").mkdir()
    for path, why in [
        (tmp_path / "missing" / "a.rrd", "No such file or directory"),
        (tmp_path / "file" / "a.rrd", "Not a directory"),
        (tmp_path / "folder.rrd", "Is a directory"),
    ]:
        with pytest.raises(OSError, match=f"cannot write '{path}': {why}"):
            RerunRecorder(path, loop.controller, loop.plant)
    with pytest.raises(ValueError, match=r"a recording is a \.rrd file"):
        RerunRecorder(tmp_path / "a.mp4", loop.controller, loop.plant)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full: run on Linux")
def test_a_full_disk_is_told_before_the_run(loop, tmp_path):
    (tmp_path / "full.rrd").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"cannot write '.*full\.rrd': No space left"):
        RerunRecorder(tmp_path / "full.rrd", loop.controller, loop.plant)


def test_a_disk_that_fills_up_ends_the_recording_not_the_run(loop, tmp_path, caplog):
    """The limit on the size of files stands for the disk's: rerun by itself waits for ever."""
    path, limits = tmp_path / "a.rrd", resource.getrlimit(resource.RLIMIT_FSIZE)
    with RerunRecorder(path, loop.controller, loop.plant) as recorder:
        size = path.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 1000, limits[1]))
        try:
            for _ in range(2 * ROWS):
                loop.step(recorder)
            recorder.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sum(f"cannot write '{path}': File too large" in record.getMessage() for record in caplog.records) == 1
    assert path.stat().st_size == size + 1000
    assert not recorder._plans


def test_log_and_close_in_the_wrong_order(loop, tmp_path):
    recorder = RerunRecorder(tmp_path / "a.rrd", loop.controller, loop.plant)
    with pytest.raises(ValueError, match="log comes after"):
        recorder.log(np.zeros(3))
    recorder.close()
    recorder.close()
    with pytest.raises(ValueError, match="is closed"):
        recorder.log(np.zeros(3))
