# SPDX-License-Identifier: Apache-2.0
"""Commands that need no process of their own."""

from subprocess import CompletedProcess

import pytest
import warp as wp

from warpmpc.cli.main import app


@pytest.fixture
def command(tmp_path, capfd, monkeypatch):
    """Runs ``warpmpc ARGS`` in a folder of its own, but in this process: imports take longer than the rest.

    What native code prints is seen, too. What a fresh process prints or leaves out is not.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)

    def run(*args: str) -> CompletedProcess[str]:
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            app(args, prog_name="warpmpc")
        out, err = capfd.readouterr()
        return CompletedProcess(args, end.value.code, out, err)

    return run
