# SPDX-License-Identifier: Apache-2.0
"""Mistakes by the hundred: every mutated scene, asset or file of terms runs, or is one line that says why.

Slow ones by hand: pytest -m slow tests/cli/test_mutants.py
"""

import pytest
from fuzzing import outcome, outcomes
from mutants import FILES, mutant

FAST, ALL = 20, 1260
"""Seeds of the suite and of the long run begin at 0."""


def test_the_folder_without_a_mistake_runs(tmp_path, command):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    for scene in ("arm.toml", "cart.toml"):
        done = command("run", scene, "--quiet", "--terms", "terms.py")
        assert (done.returncode, done.stderr) == (1, "")  # three controls reach nothing


def test_mutants_are_what_their_seeds_say():
    assert mutant(7) == mutant(7)
    cases = [mutant(seed) for seed in range(FAST)]
    assert {case.changed for case in cases} == FILES.keys()
    assert all(case.content != FILES[case.changed].encode() for case in cases[:10])


def test_every_mutant_runs_or_says_what_is_wrong():
    found = [outcome(mutant(seed)) for seed in range(FAST)]
    print("seeds", 0, "to", FAST - 1)
    assert not [str(each) for each in found if each.fault]
    assert len([each for each in found if each.code != 2]) > FAST / 8  # mistakes that change nothing that matters
    assert len([each for each in found if each.code == 2]) > FAST / 4


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_mutant_of_the_long_run():
    print("seeds", FAST, "to", FAST + ALL - 1)
    faults = [str(each) for each in outcomes(range(FAST, FAST + ALL)) if each.fault]
    assert not faults, f"{len(faults)} of {ALL}:\n" + "\n".join(faults)
