# SPDX-License-Identifier: Apache-2.0
import pytest
from typer.testing import CliRunner

from warpmpc import SceneError, load_scene, shipped_scenes
from warpmpc.cli.main import app
from warpmpc.extras.live.saving import place_of, save, values_of
from warpmpc.scene.load import shipped_folder


def changed(before, path):
    pairs = zip(before.splitlines(), path.read_text().splitlines(), strict=True)
    return [(a, b) for a, b in pairs if a != b]


@pytest.fixture
def scene(tmp_path):
    """A copy of a shipped scene, and its text."""
    path = tmp_path / "mine.toml"
    planner = '[planner]\nmethod = "mppi"\nsamples = 64\ndt = 0.02  # [s] fine\nnoise = { sigma = 1.0 }  # [m]\n'
    path.write_text(text := shipped_scenes()["cylinder_push"].read_text() + "\n" + planner)
    return path, text


def test_values_are_written_and_everything_else_stays(scene):
    path, before = scene
    texts = ["planner.samples=32", "planner.noise.sigma=0.5", 'planner.method="cem"']
    save(path, None, [*texts, *values_of(load_scene(path).cost_labels, {"reach": 0.75})], to=path)
    lines = changed(before, path)
    assert lines[0] == ("weight = 0.5", "weight = 0.75")
    assert {b.split(" =")[0] for _, b in lines} == {"weight", "samples", "noise", "method"}
    assert next(b for _, b in lines if b.startswith("noise")).endswith("# [m]")
    saved = load_scene(path)
    assert (saved.planner.samples, saved.planner.method.value, saved.planner.noise.sigma) == (32, "cem", (0.5,))


def test_a_comment_behind_a_value_stays(scene):
    path, _ = scene
    save(path, None, ["planner.dt=0.01"], to=path)
    assert "dt = 0.01  # [s] fine" in path.read_text()


def test_what_the_variant_says_is_changed_in_the_variant(scene):
    path, text = scene
    text += "\n[variants.far]\ncost.reach.weight = 0.1  # gentle\nplanner.noise.sigma = 0.2\n"
    path.write_text(text)
    save(path, "far", ["cost.reach.weight=0.3", "cost.place.weight=7.5", "planner.noise.sigma=0.4"], to=path)
    weights = {cost.label: cost.weight for cost in load_scene(f"{path}:far").cost}
    assert (weights["reach"], weights["place"]) == (0.3, 7.5)
    assert "cost.reach.weight = 0.3  # gentle" in path.read_text()
    plain, before = load_scene(path), load_scene(shipped_scenes()["cylinder_push"])
    assert {c.label: c.weight for c in plain.cost}["reach"] == {c.label: c.weight for c in before.cost}["reach"]
    assert plain.planner.noise.sigma == (1.0,)
    assert load_scene(f"{path}:far").planner.noise.sigma == (0.4,)


def test_of_several_variants_the_last_that_says_a_value_is_changed(scene):
    path, text = scene
    path.write_text(
        text + "\n[variants.far]\ncost.reach.weight = 0.1\n\n[variants.coarse]\nplanner.noise.sigma = 0.2\n"
    )
    save(path, "far+coarse", ["cost.reach.weight=0.3", "planner.noise.sigma=0.4"], to=path)
    assert {cost.label: cost.weight for cost in load_scene(f"{path}:far").cost}["reach"] == 0.3
    assert load_scene(f"{path}:coarse").planner.noise.sigma == (0.4,)
    assert load_scene(path).planner.noise.sigma == (1.0,)


@pytest.mark.parametrize("source", ["omni_push_box:B", "panda_reach", "push_t"])
def test_keys_that_a_file_does_not_have_are_added_where_they_belong(source, tmp_path):
    scene = load_scene(source)
    to, label = tmp_path / "mine.toml", scene.cost_labels[-1]
    texts = [f"cost.{label}.weight=0.125", "planner.temperature.initial=0.4", "plant.noise.position=0.001"]
    texts += ["planner.cvar=0.5", "success.hold=0.1", "cost.*.terminal=2.0"]
    save(scene.path, scene.variant, texts, to=to)
    saved = load_scene(f"{to}:{scene.variant}" if scene.variant else to)
    assert saved.cost[-1].weight == 0.125
    assert {cost.terminal for cost in saved.cost} == {2.0}
    assert (saved.planner.temperature.initial, saved.planner.cvar, saved.plant.noise.position) == (0.4, 0.5, 0.001)


def test_what_is_not_a_scene_is_refused_and_the_file_stays(scene):
    path, before = scene
    for text in ("planner.samples=-3", "robot.none.asset=1", 'robot.pusher.asset="assets/none.urdf"'):
        with pytest.raises(SceneError):
            save(path, None, [text], to=path)
        assert path.read_text() == before
    assert [p.name for p in path.parent.iterdir()] == ["mine.toml"]


def test_a_shipped_scene_is_saved_into_the_working_directory_and_checked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = shipped_scenes()["cylinder_push"]
    before, to = shipped.read_bytes(), place_of(shipped)
    assert to == tmp_path / "cylinder_push_tuned.toml"
    save(shipped, None, ["planner.samples=32", "engine.threads=1"], to=to)
    assert shipped.read_bytes() == before
    assert place_of(shipped).name == "cylinder_push_tuned2.toml", "what was saved before stays, too"
    assert place_of(to) == to
    result = CliRunner().invoke(app, ["check", str(to), "--engine", "fused", "--device", "cpu"])
    assert result.exit_code == 0, result.output


def test_a_link_stays_one_and_what_it_leads_to_is_written(scene, tmp_path):
    path, before = scene
    link = tmp_path / "links" / "linked.toml"
    link.parent.mkdir()
    link.symlink_to("../mine.toml")
    path.write_text(text := before.replace('"assets/', '"robots/'))
    (link.parent / "robots").symlink_to(shipped_folder() / "assets")  # beside the link alone
    save(link, None, ["planner.samples=32"], to=place_of(link))
    assert link.is_symlink()
    assert [b for _, b in changed(text, path)] == ["samples = 32"]
    assert load_scene(link).planner.samples == 32
    with pytest.raises(SceneError):
        save(link, None, ["planner.samples=-3"], to=link)
    assert {p.name for p in tmp_path.iterdir()} == {"mine.toml", "links"}
    assert {p.name for p in link.parent.iterdir()} == {"linked.toml", "robots"}
