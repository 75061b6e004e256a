# SPDX-License-Identifier: Apache-2.0
import pytest

from warpmpc.live.saving import save
from warpmpc.scene.errors import SceneError
from warpmpc.scene.load import load_scene


@pytest.fixture
def scene(tmp_path):
    shipped = load_scene("cylinder_push")
    path = tmp_path / "mine.toml"
    assets = (shipped.path.parent / "assets").resolve()
    path.write_text(shipped.path.read_text().replace('"assets/', f'"{assets}/'))
    return path


def test_values_are_written_and_everything_else_stays(scene):
    before = scene.read_text().splitlines()
    keys = {"planner.samples": "32", "planner.noise.sigma": "0.5", "planner.method": '"cem"'}
    save(scene, load_scene(scene).cost_labels, {"reach": 0.75}, keys)
    after = scene.read_text().splitlines()
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert changed[0] == ("weight = 0.5", "weight = 0.75")
    assert {b.split(" =")[0] for _, b in changed} == {"weight", "samples", "noise", "method"}
    assert next(b for _, b in changed if b.startswith("noise")).endswith("# [m]")
    saved = load_scene(scene)
    assert (saved.planner.samples, saved.planner.method.value, saved.planner.noise.sigma) == (32, "cem", (0.5,))


def test_a_comment_behind_a_value_stays(scene):
    save(scene, load_scene(scene).cost_labels, {}, {"planner.dt": "0.01"})
    assert "dt = 0.01                    # [s] rollouts look 1 s ahead" in scene.read_text()


def test_what_is_not_a_scene_is_refused_and_the_file_stays(scene):
    before = scene.read_text()
    with pytest.raises(SceneError):
        save(scene, load_scene(scene).cost_labels, {}, {"planner.samples": "-3"})
    assert scene.read_text() == before
    assert [p.name for p in scene.parent.iterdir()] == ["mine.toml"]
