# SPDX-License-Identifier: Apache-2.0
"""Values that a browser sends to the panels, which may be any."""

from types import SimpleNamespace

import pytest
from needs import reason

viser = pytest.importorskip("viser", reason=reason("viser"))

from warpmpc.live.panels import PACES, Panels  # noqa: E402
from warpmpc.live.session import Session  # noqa: E402


@pytest.fixture(scope="module")
def served():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    session = Session("cylinder_push", overrides=["engine.threads=1", "planner.samples=16"], device="cpu", pace=2.0)
    Panels(server, session)
    yield server.gui, session
    server.stop()


def sent(gui, label, value):
    """An input after a browser has sent a value for it."""
    made = next(made for made in gui._gui_input_handle_from_uuid.values() if made._impl.props.label == label)
    made._impl.value = value
    for call in made._impl.update_cb:
        call(SimpleNamespace(client=object(), target=made))
    return made


@pytest.mark.parametrize("speed", [-1, 100, 2.5, float("nan"), float("inf")])
def test_a_speed_that_is_not_listed_is_put_back(served, speed):
    gui, session = served
    half = PACES.index(0.5)
    assert sent(gui, "speed", half).value == half
    assert session.pace == 0.5
    assert sent(gui, "speed", speed).value == half
    assert session.pace == 0.5


def test_a_method_is_chosen_from_the_list_alone(served):
    gui, session = served
    assert sent(gui, "method", "none").value == "mppi"
    assert not session.waiting
    sent(gui, "method", "cem")
    session._take_changes()
    assert session.waiting == {"planner.method": '"cem"'}


def test_a_scene_is_chosen_from_the_list_alone(served, tmp_path, monkeypatch):
    gui, session = served
    other = tmp_path / "other.toml"
    other.write_text(session.scene.path.read_text())
    for source in (str(other), "../other.toml", "pendulum:none"):
        assert sent(gui, "scene", source).value == "cylinder_push"
    session._take_changes()
    assert session.source == "cylinder_push"
    assert not session.message
    assert sent(gui, "scene", "pendulum").value == "pendulum"
    session._take_changes()
    assert session.source == "pendulum"
