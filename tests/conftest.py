# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the devices they run on and how hypothesis searches."""

import gc
import os
import sys
from pathlib import Path
from subprocess import CompletedProcess

import hypothesis
import pytest
import quick_kernels
import warp as wp
from needs import CUDA, Lacking, need

# a fixed search: a failure seen once is seen again; launches are too uneven for deadlines
hypothesis.settings.register_profile("warpmpc", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("warpmpc")
quick_kernels.compile_soonest()
gc.set_threshold(100_000, 50, 100)  # a tenth of all time goes into looking through what modules and scenes hold


# programs that tests start compile the package once, not each of them again: a quarter of their time
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
os.environ.pop("COLUMNS", None)  # readline sets it in the environment that workers of pytest-xdist begin with


def pytest_addoption(parser):
    parser.addoption("--lacking", metavar="FILE", help="note the tests skipped for want of what a command installs")
    parser.addoption("--as-users", action="store_true", help="compile kernels of models as users do, optimized")


def pytest_configure(config):
    file = config.getoption("--lacking")
    if file and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Lacking(Path(file).absolute()))


@pytest.fixture(scope="module", autouse=True)
def _kernels(request):
    """Kernels of models, optimized or not."""
    file = request.path.relative_to(request.config.rootpath).as_posix()
    quick_kernels.quick = not (request.config.getoption("--as-users") or file.startswith(quick_kernels.AS_USERS))


@pytest.fixture
def optimized(monkeypatch) -> None:
    """Kernels as users have them, for a test whose rollouts take longer than the compiler saves."""
    monkeypatch.setattr(quick_kernels, "quick", False)


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Every device of this machine in turn."""
    if request.param.startswith("cuda"):
        need(CUDA)
    return request.param


@pytest.fixture
def command(tmp_path, capfd, monkeypatch):
    """Runs ``warpmpc ARGS`` in a separate folder, but in this process: imports take longer than the rest.

    What native code prints is seen, too. What a fresh process prints or leaves out is not.
    """
    from warpmpc.cli.main import app

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)

    def run(*args: str) -> CompletedProcess[str]:
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            app(args, prog_name="warpmpc")
        out, err = capfd.readouterr()
        return CompletedProcess(args, end.value.code, out, err)

    return run
