# SPDX-License-Identifier: Apache-2.0
"""Inputs made from a scene's schema, without a browser: a stand-in says that somebody typed."""

import time
from types import SimpleNamespace

import pytest
from needs import reason

viser = pytest.importorskip("viser", reason=reason("viser"))

from warpmpc import load_scene  # noqa: E402
from warpmpc.extras.live import panels  # noqa: E402
from warpmpc.extras.live.panels import Settings  # noqa: E402
from warpmpc.scene.schema import EngineName, Planner  # noqa: E402
from warpmpc.scene.types import Section  # noqa: E402


@pytest.fixture(scope="module")
def gui():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server.gui
    server.stop()


class Sitting:
    """What settings need of a session: a scene, and a place for changes."""

    def __init__(self, *overrides):
        self.source, self.overrides, self.waiting, self.asked = "omni_push_box", list(overrides), {}, []
        self.load()

    def load(self):
        self.scene = load_scene(self.source, overrides=self.overrides)

    def set_key(self, key, value):
        self.asked.append((key, value))


def typed(made, value):
    made._impl.value = value
    for call in made._impl.update_cb:
        call(SimpleNamespace(client=object()))


def leaves(section, at):
    for name in type(section).model_fields:
        value = getattr(section, name)
        yield from leaves(value, f"{at}.{name}") if isinstance(value, Section) else [f"{at}.{name}"]


def test_every_key_but_lists_of_tables_has_an_input(gui):
    shown = Settings(gui, Sitting(), "planner")
    assert set(shown._inputs) == set(leaves(load_scene("omni_push_box").planner, "planner")) - {"planner.ancillary"}
    assert set(Settings(gui, Sitting(), "plant")._inputs) == {
        *("plant.substeps", "plant.randomize", "plant.delay", "plant.noise.position", "plant.noise.velocity")
    }
    engine = Settings(gui, Sitting(), "engine")._inputs
    assert set(engine) == set(leaves(load_scene("omni_push_box").engine, "engine")) - {"engine.options"}
    assert set(engine["engine.name"].options) == set(EngineName.names())
    choices = shown._inputs["planner.method"].options
    assert set(choices) == {method.value for method in Planner.model_fields["method"].annotation}


def test_what_is_typed_is_what_the_scene_then_has(gui):
    session = Sitting()
    made = Settings(gui, session, "planner")._inputs
    typed(made["planner.method"], "cem")
    typed(made["planner.samples"], 48)
    typed(made["planner.discount"], 0.5)
    typed(made["planner.randomize"], False)
    typed(made["planner.noise.sigma.range"], "[0.1, 0.2, 0.3]")
    typed(made["planner.knots"], 7)
    session.overrides = [f"{key}={value}" for key, value in session.asked]
    session.load()
    planner = session.scene.planner
    assert (planner.method.value, planner.samples, planner.discount, planner.randomize) == ("cem", 48, 0.5, False)
    assert planner.noise.sigma.range == (0.1, 0.2, 0.3)
    assert planner.knots == 7


def test_inputs_show_what_became_of_a_change(gui, monkeypatch):
    monkeypatch.setattr(panels, "SETTINGS_KEEP", 0.05)
    session = Sitting("planner.horizon=12")
    shown = Settings(gui, session, "planner")
    samples, horizon = shown._inputs["planner.samples"], shown._inputs["planner.horizon"]
    typed(samples, -5)
    shown.update()
    assert samples.value == -5, "it is being typed"
    session.waiting["planner.samples"] = "-5"
    time.sleep(0.1)
    shown.update()
    assert samples.value == -5, "it is about to be tried"
    session.waiting.clear()
    shown.update()
    assert samples.value == session.scene.planner.samples, "it was refused"
    session.overrides = ["planner.horizon=7"]
    session.load()
    shown.update()
    assert horizon.value == 7
    assert [key for key, _ in session.asked] == ["planner.samples"], "what is shown is not asked for"
