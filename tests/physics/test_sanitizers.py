# SPDX-License-Identifier: Apache-2.0
"""AddressSanitizer, UBSan and ThreadSanitizer find nothing in the compiled code of the CPU.

They look at random models, models of packages, limits, and public classes that several threads use.

All of them: pytest -m slow tests/physics/test_sanitizers.py -n 16
"""

import pytest
from needs import needs, reason
from sanitized import LIBRARIES, libraries, reports, run
from threaded_use import USES

EACH = 10
"""Models of a process."""
PARTS = 10
"""Processes for the models of packages."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(2400),
    pytest.mark.skipif(not all(map(libraries, LIBRARIES)), reason=reason("g++")),
]


@pytest.mark.parametrize("seed", range(20))
def test_random_models_have_no_report(seed):
    done = run("random", str(seed), str(EACH), timeout=2300)
    assert reports(done) == []
    assert done.stdout.splitlines()[-1] == f"model {EACH}"


def test_limits_have_no_report():
    done = run("limits", timeout=2300)
    assert reports(done) == []
    assert done.stdout.splitlines()[-1] == "heightfield, no room, 1 lanes"


@needs("example-robot-data")
@needs("dm_control")
@pytest.mark.parametrize("part", range(PARTS))
def test_models_of_packages_have_no_report(part):
    done = run("packages", str(part), str(PARTS), timeout=2300)
    assert reports(done) == []
    assert done.stdout


@pytest.mark.parametrize("name", USES)
@pytest.mark.parametrize("sanitizer", LIBRARIES)
def test_classes_in_threads_have_no_report(sanitizer, name):
    done = run("threads", name, timeout=600, sanitizer=sanitizer)
    assert reports(done) == []
    assert done.stdout.splitlines()[-1] == name


@pytest.mark.parametrize("name", ["Rollout", "Batch"])
def test_races_would_be_reported(name):
    assert "WARNING: ThreadSanitizer: data race" in " ".join(
        reports(run("racing", name, timeout=600, sanitizer="thread"))
    )


def test_errors_would_be_reported():
    found = " ".join(reports(run("faulty", timeout=600)))
    for error in ("out of bounds", "shift exponent", "AddressSanitizer: stack-buffer-overflow"):
        assert error in found
