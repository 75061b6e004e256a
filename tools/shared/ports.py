# SPDX-License-Identifier: Apache-2.0
"""Ports for programs that are started."""

from __future__ import annotations

import os
import socket
from itertools import count

_TAKEN = count(0, 2)
FIRST, COUNT = 20_000, 12_000
"""Range of ports below the ephemeral ones (Linux: from 32768)."""


def free_port() -> int:
    """A port that is free, and the one after it; processes start at different ports, and a process takes none twice.

    The program that binds it starts later: by then an ephemeral port may be in use again.
    """
    while True:
        port = FIRST + (40 * os.getpid() + next(_TAKEN)) % COUNT
        with socket.socket() as one, socket.socket() as other:
            try:
                one.bind(("127.0.0.1", port))
                other.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port
