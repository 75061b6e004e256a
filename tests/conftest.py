# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the devices they run on and how hypothesis searches."""

from pathlib import Path

import hypothesis
import pytest
from needs import CUDA, Lacking, need

# a fixed search: a failure seen once is seen again; launches are too uneven for deadlines
hypothesis.settings.register_profile("warpmpc", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("warpmpc")


def pytest_addoption(parser):
    parser.addoption("--lacking", metavar="FILE", help="note the tests skipped for want of what a command installs")


def pytest_configure(config):
    file = config.getoption("--lacking")
    if file and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Lacking(Path(file).absolute()))


@pytest.fixture(autouse=True, scope="session")
def quick_to_start():
    """``auto`` stands for the engine ``mujoco`` on the CPU: most tests make scenes of their own, and compiling a kernel
    for each takes longer than the test. What concerns ``fused`` or the choice itself asks for it (``preferred``)."""
    from warpmpc.engine import registry

    registry.PREFERRED["cpu"] = registry.PREFERRED["cpu"][1:]


@pytest.fixture
def preferred(monkeypatch):
    """``auto`` as it is outside the tests."""
    from warpmpc.engine import registry

    monkeypatch.setitem(registry.PREFERRED, "cpu", ("fused", "mujoco"))


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Every device of this machine in turn."""
    if request.param.startswith("cuda"):
        need(CUDA)
    return request.param
