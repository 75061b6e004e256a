# SPDX-License-Identifier: Apache-2.0
"""Run logs that are changed."""

import numpy as np


def changed(rows: np.recarray, **columns: np.ndarray) -> np.recarray:
    """A copy of a table of a run log with other columns, which may have other shapes."""
    arrays = {name: rows[name] for name in rows.dtype.names} | columns
    made = np.zeros(len(rows), [(name, array.dtype, array.shape[1:]) for name, array in arrays.items()])
    for name, array in arrays.items():
        made[name] = array
    return made.view(np.recarray)
