# SPDX-License-Identifier: Apache-2.0
"""Files of arrays that come from elsewhere: they may be anything, or cut off."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np


@contextmanager
def read_npz(path: str | Path) -> Iterator[np.lib.npyio.NpzFile]:
    """Open an ``.npz`` file; arrays are read from it inside the context.

    Raises:
        ValueError: If it is damaged or something else, or lacks what is read from it.
        OSError: If it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            yield data
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile, zlib, struct and NumPy have a dozen for what is damaged
        raise ValueError(f"is damaged, or no such file of arrays: {error}") from error
