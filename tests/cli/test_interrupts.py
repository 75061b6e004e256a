# SPDX-License-Identifier: Apache-2.0
"""A Ctrl-C that a library swallows still ends the run."""

import signal

import pytest

from warpmpc.cli_run import Interrupts


def test_a_swallowed_ctrl_c_is_raised_again():
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Interrupts() as interrupts:
            interrupts.check()
            with pytest.raises(KeyboardInterrupt):  # this is where a library may drop it
                signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
