# SPDX-License-Identifier: Apache-2.0
"""Values that a browser sends to the panels, which may be any."""

from types import SimpleNamespace

import pytest
from needs import reason

viser = pytest.importorskip("viser", reason=reason("viser"))

from warpmpc.extras.live.panels import Panels  # noqa: E402
from warpmpc.extras.live.readouts import CURVES, Plots  # noqa: E402
from warpmpc.extras.live.session import Session  # noqa: E402


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


@pytest.mark.parametrize("speed", ["-1 %", "", "2.5 %", "nan %", "inf"])
def test_a_speed_that_is_not_listed_is_put_back(served, speed):
    gui, session = served
    half = "50 %"
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


@pytest.mark.parametrize("count", [1, 8, 9, 16, 17])
def test_plots_of_many_curves_differ_in_their_titles_and_hold_about_as_many(served, count):
    names = [f"c{i}" for i in range(count)]
    plots = Plots._split(None, SimpleNamespace(gui=served[0]), "control", names, 3)
    columns = [list(range(count + 3))[part] for _, part, _ in plots]
    assert [i for part in columns for i in part] == list(range(3, 3 + count))
    sizes = [len(part) for part in columns]
    assert max(sizes) - min(sizes) <= 1
    assert max(sizes) <= CURVES
    titles = [plot.title for plot, *_ in plots]
    assert len({*titles}) == len(titles)
    assert titles[0] == ("control" if count <= CURVES else f"control, 1 to {sizes[0]} of {count}")
    for plot, *_ in plots:
        plot.remove()
