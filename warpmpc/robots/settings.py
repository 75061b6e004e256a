# SPDX-License-Identifier: Apache-2.0
"""Keys of the drivers' files."""

from __future__ import annotations

from ..scene.types import Flag, Positive, Section

PORT = 5555
"""Port of states where none is given; commands have the next one."""


class ZmqSettings(Section):
    """Addresses of a robot behind ZeroMQ sockets."""

    states: str = f"tcp://127.0.0.1:{PORT}"
    """Address at which the robot publishes its states."""
    commands: str = f"tcp://127.0.0.1:{PORT + 1}"
    """Address at which the robot listens to commands."""
    connect_timeout: Positive = 10.0
    """Time for which the first state is waited for [s]."""
    use_sim_time: Flag = False
    """Whether the robot's clock may run slower than this host's, as that of ``warpmpc robot --speed``."""
