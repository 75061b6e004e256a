# SPDX-License-Identifier: Apache-2.0
"""Robots of strangers: each loads, or is refused with file, link and cure.

Slow ones by hand: pytest -m slow tests/tools/test_robots.py
"""

import importlib.metadata
import re
from pathlib import Path

import pytest
import robots
from needs import need

PAGE = Path(__file__).parents[2] / "docs" / "robots.md"
FOUND = {str(path.relative_to(root)): (package, root, path) for package, root, path in robots.robots()}
TROUBLE = {  # file → joint velocities, or what it is refused with; what is repaired
    "allegro_hand_description/urdf/allegro_right_hand.urdf": (16, "A + B ≥ C"),
    "double_pendulum_description/urdf/double_pendulum.urdf": (2, "has no range"),
    "human_description/robots/human.urdf": (36, "has no mass"),
    "iris_description/robots/iris.urdf": (4, "a limit of 0 for effort and velocity"),
    "romeo_description/urdf/romeo.urdf": (r"link '\w+' moves, .* give it an <inertial>", ""),
    "talos_data/robots/talos_left_arm.urdf": (7, "is fixed: what it mimics is left out"),
    "hector_description/robots/quadrotor_base.urdf": ("nothing to control", ""),
    "tasks/cartpole/cartpole.xml": (2, ""),
}


def need_robots():
    """Skip what wants robots of a package that is missing."""
    for package in robots.PACKAGES:
        need(package)


def known(file: str):
    if file not in FOUND:
        need_robots()
        pytest.skip("only other versions have it: docs/robots.md names them")
    return FOUND[file]


@pytest.mark.parametrize("file", sorted(TROUBLE))
def test_the_troublesome_ones_load_or_are_refused(file):
    wanted, repaired = TROUBLE[file]
    row = robots.try_robot(*known(file))
    assert row.refused
    if isinstance(wanted, str):
        assert not row.loads
        assert re.search(wanted, row.error)
        assert "Error" not in row.error  # none of MuJoCo's own
    else:
        assert (row.loads, row.error, row.dof) == (True, "", wanted)
        assert bool(row.repaired) == bool(repaired)
        assert all(line.startswith(("link '", "joint '")) for line in row.repaired)
        assert any(repaired in line for line in row.repaired) or not repaired


def test_the_page_has_a_row_for_every_robot_and_no_path_of_a_machine():
    if not {package for package, _, _ in FOUND.values()} >= {*robots.PACKAGES}:
        need_robots()
    text = PAGE.read_text(encoding="utf-8")
    if any(f"{name} {importlib.metadata.version(name)}" not in text for name in robots.PACKAGES):
        pytest.skip("other versions than the page's: python tools/robots.py writes it again")
    assert set(re.findall(r"^\|(\S+\.(?:urdf|xml))\|", text, re.MULTILINE)) == set(FOUND)
    assert "site-packages" not in text


def test_a_page_counts_what_loads_plans_and_was_mended(tmp_path):
    rows = [
        robots.Row("mjlab", "a.xml", loads=True, dof=3, engine="fused"),
        robots.Row("mjlab", "b.urdf", loads=True, dof=1, repaired=("one | two", "three")),
        robots.Row("mjlab", "c.urdf", error=f"{tmp_path}/c.urdf: " + "long " * 60),
    ]
    text = robots.page(rows, {"mjlab": tmp_path}, "mujoco")
    assert "2 of 3 load, 1 of them repaired with a warning; a plan was made with 1." in text
    assert "|a.xml|3||" in text
    assert "|b.urdf|1|one / two (and 1 more)|" in text
    assert str(tmp_path) not in text
    [long] = [line for line in text.splitlines() if line.startswith("|c.urdf|-|c.urdf: long")]
    assert len(long.split("|")[3]) == robots.TEXT


@pytest.mark.slow
def test_every_robot_loads_or_is_refused(capsys):
    if not FOUND:
        need_robots()
    rows = [robots.try_robot(*found) for found in FOUND.values()]
    with capsys.disabled():
        print("\n" + robots.table(rows, {package: root for package, root, _ in FOUND.values()}))
    assert [row.file for row in rows if not row.refused] == []
    assert [row.file for row in rows if not row.loads and not row.error] == []
