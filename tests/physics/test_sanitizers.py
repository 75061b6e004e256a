# SPDX-License-Identifier: Apache-2.0
"""AddressSanitizer and UBSan find nothing in the generated CPU source, for random models and at its limits.

All 200 models: pytest -m slow tests/physics/test_sanitizers.py -n 16
"""

import pytest
from needs import reason
from sanitized import libraries, reports, run

EACH = 10
"""Models of a process."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(2400),
    pytest.mark.skipif(not libraries(), reason=reason("g++")),
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


def test_errors_would_be_reported():
    found = " ".join(reports(run("faulty", timeout=600)))
    for error in ("out of bounds", "shift exponent", "AddressSanitizer: stack-buffer-overflow"):
        assert error in found
