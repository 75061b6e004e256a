# SPDX-License-Identifier: Apache-2.0
"""Optional packages that files are written with."""

from __future__ import annotations

from importlib.util import find_spec

NEEDED = {"mcap": ("mcap", "rosbags"), "hdf5": ("h5py",), "minari": ("minari", "h5py")}
"""Packages by format."""


def require(kind: str) -> None:
    """Refuse a format whose packages are not installed.

    Raises:
        ValueError: If one is not.
    """
    if missing := [package for package in NEEDED[kind] if find_spec(package) is None]:
        raise ValueError(f'--{kind} needs {" and ".join(missing)}: pip install "warpmpc[export]"')
