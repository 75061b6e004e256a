# SPDX-License-Identifier: Apache-2.0
"""What is printed before anything runs: version, help, scenes, terms, and what a check built."""

import subprocess
import sys

from program import SCENE, warpmpc


def test_version():
    done = warpmpc("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "warpmpc 0.1.0\n"


def test_scenes_lists_every_shipped_scene_with_its_variants():
    done = warpmpc("scenes")
    assert (done.returncode, done.stderr) == (0, "")
    row = next(line for line in done.stdout.splitlines() if "omni_push_box" in line)
    for part in ("A, B", "base", "×", "pushes a box"):
        assert part in row
    assert "point_reach" in done.stdout


def test_listing_scenes_loads_no_physics():
    slow = "{'warp', 'mujoco', 'scipy'}"
    code = f"import sys, warpmpc.cli.report as r; r.print_scenes(); print(sorted({slow} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, encoding="utf-8")
    assert done.stdout.splitlines()[-1] == "[]"


def test_terms_lists_every_term_and_key_with_type_default_and_meaning():
    from warpmpc.terms import TERMS

    done = warpmpc("terms")
    assert (done.returncode, done.stderr) == (0, "")
    words = done.stdout.split()
    for name, term in TERMS.items():
        assert name in words
        assert set(term.keys.model_fields) <= set(words)
    for part in (
        "straight | geodesic",
        "number ≥ 0",
        "number > 0",
        "[text, text]",
        "true | false",
        "required",
        "[m]",
        "[[text, text], ...]",
    ):
        assert part in done.stdout


def test_check_shows_what_was_built(tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE)
    done = warpmpc("check", "mine.toml:near", "--set", "cost.distance.weight=2.5", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for part in (
        "mine, variant near",
        "base: 3 DoF",
        "box [0.3, 0.5, 0.3] m, 1 kg",
        "base/tip",
        "box at [1.2, 0] m; reached within position 0.05",
        "16 worlds × 4 controls × 2 substeps = 128 physics steps",
        "fused on cpu",
        "rad/s",
        "100 N·m",
        "between = [base/tip, box]",
    ):
        assert part in done.stdout
    row = next(line for line in done.stdout.splitlines() if "distance" in line and "between" in line)
    assert "2.5" in row.split()
