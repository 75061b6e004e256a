# SPDX-License-Identifier: Apache-2.0
"""Tools that compare physics steps with other simulators do so from the same states."""

from benches import batched, packages
from shared.packages import package_files


def test_one_thread_ends_where_mujoco_does():
    found = batched.one_thread("quadruped", worlds=20, steps=5, runs=1)
    assert found["apart_p50"] < 1e-5
    assert found["ratio"] > 0.0


def test_a_model_is_handed_over_without_words_that_other_versions_do_not_know(tmp_path):
    model = batched.bare_model("quadruped")
    files = batched.hand_over("quadruped", model, tmp_path)
    assert " input=" not in (tmp_path / "model.xml").read_text(encoding="utf-8")
    assert set(files) == {"xml", "arrays"}


def test_single_steps_of_a_packages_model_are_mujocos():
    found = packages.compare("newton/examples/assets/nv_ant.xml")
    assert found["states"] == packages.WORLDS * packages.TIMES
    assert found["apart"]["p50"] < 1e-5


def test_what_is_refused_and_what_is_no_model_is_said():
    names = package_files()
    assert "newton/examples/assets/nv_ant.xml" in names
    assert packages._plain("Error opening file '/a/b/c.obj'\nmore") == "Error opening file c.obj'"
