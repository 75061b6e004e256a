# SPDX-License-Identifier: Apache-2.0
"""Heightfields of an asset's MJCF file are where a ray from above meets them, in recordings and on the page."""

import mujoco
import numpy as np
import pytest
import rerun as rr
from needs import need
from rerun.chunk import RrdReader
from small_scenes import make_scene

import warpmpc
from warpmpc.extras.record.scene_drawing import draw_scene
from warpmpc.scene.model.hulls import FINEST, heightfields

HILLS = """
<mujoco>
  <asset><hfield name="hills" nrow="5" ncol="7" size="3 2 0.5 0.1" elevation="{heights}"/></asset>
  <worldbody>
    <geom name="hills" type="hfield" hfield="hills" pos="0.5 -0.25 0.1" euler="0 0 30"/>
    <body name="ball" pos="0 0 2"><joint name="rise" type="slide" axis="0 0 1"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor name="lift" joint="rise" ctrlrange="-5 5" ctrllimited="true"/></actuator>
</mujoco>
"""
HEIGHTS = np.random.default_rng(1).uniform(0.0, 1.0, (5, 7))


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = tmp_path_factory.mktemp("hills") / "hills.xml"
    path.write_text(HILLS.format(heights=" ".join(f"{height:.4f}" for height in HEIGHTS.ravel())))
    robot = {"name": "ball", "asset": str(path), "frames": {"centre": {"link": "ball"}}}
    goal = {"frame": "ball/centre", "position": (0.0, 0.0, 1.0)}
    cost = [{"term": "distance", "between": ["ball/centre", "goal"]}]
    return warpmpc.Plant(make_scene(robot=[robot], goal=goal, cost=cost, ground=None))


def test_corners_and_faces_are_where_a_ray_meets_them(plant):
    (surface,) = heightfields(plant.model)
    model, data = plant.model, mujoco.MjData(plant.model)
    mujoco.mj_forward(model, data)
    assert surface.points.shape == (35, 3)
    assert surface.triangles.shape == (48, 3)
    inner = surface.points.reshape(5, 7, 3)[1:-1, 1:-1].reshape(-1, 3)
    faces = surface.points[surface.triangles]
    seen = np.concatenate([inner, faces.mean(axis=1)])
    group = np.zeros(1, dtype=np.int32)
    for point in seen:
        start = np.array([*point[:2], 1.5])
        far = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, group)
        assert model.geom_type[group[0]] == mujoco.mjtGeom.mjGEOM_HFIELD
        assert start[2] - far == pytest.approx(point[2], abs=1e-5)
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert (normal[:, 2] > 0.0).all()


def test_a_fine_field_keeps_its_edges_and_is_thinned():
    count = 2 * FINEST + 3
    spec = mujoco.MjSpec()
    spec.add_hfield(name="wide", size=[1, 1, 1, 0.1], nrow=count, ncol=3, userdata=np.linspace(0.0, 1.0, 3 * count))
    spec.worldbody.add_geom(name="wide", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="wide")
    (surface,) = heightfields(spec.compile())
    assert len(surface.points) == 3 * FINEST
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    np.testing.assert_allclose([low, high], [[-1, -1, 0], [1, 1, 1]], atol=1e-6)


def test_recordings_show_them(plant, tmp_path):
    recording = rr.RecordingStream("hills")
    recording.save(tmp_path / "hills.rrd")
    draw_scene(recording, plant, reach=1.0)
    recording.flush()
    recording.disconnect()
    chunks = {chunk.entity_path: chunk for chunk in RrdReader(tmp_path / "hills.rrd").stream()}
    (surface,) = heightfields(plant.model)
    batch = chunks[f"/scene/{surface.name}"].to_record_batch()
    points = np.array(batch.column("Mesh3D:vertex_positions").to_pylist()[0])
    np.testing.assert_array_equal(points.astype(np.float32), surface.points)


def test_the_page_shows_them(plant):
    need("viser")
    from types import SimpleNamespace

    import viser

    from warpmpc.extras.live.drawing import Drawing

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    drawn, add = {}, server.scene.add_mesh_simple
    server.scene.add_mesh_simple = lambda name, points, *rest, **keys: (
        drawn.update({name: points}) or add(name, points, *rest, **keys)
    )
    snapshot = SimpleNamespace(build=1, body_q=plant.body_q, source="hills", poses={"goal": plant.task.pose("goal")})
    Drawing(server, SimpleNamespace(plant=plant), snapshot)
    server.stop()
    (surface,) = heightfields(plant.model)
    np.testing.assert_array_equal(drawn[f"/world/{surface.name}"], surface.points)
