# SPDX-License-Identifier: Apache-2.0
"""Data sets of demonstrations for learning: HDF5 files as robomimic reads them, and Minari's."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .packages import require

if TYPE_CHECKING:
    import h5py

    from .demonstration import Demonstration

MINARI_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")
GYMNASIUM = 2
"""Kind of environment in robomimic's ``env_args``."""


class DataSet(Protocol):
    """A data set that is being written."""

    name: str
    """File or id."""
    steps: int
    """Steps so far."""

    def add(self, demonstration: Demonstration) -> None:
        """Add an episode."""

    def close(self) -> None:
        """Finish the data set; without an episode there is none."""


def open_data_set(name: str) -> DataSet:
    """Begin a data set: of Minari where its name is an id such as ``push-v0``, else an HDF5 file.

    Args:
        name: The id, or the file; ``.hdf5`` is added to a name without an ending.

    Raises:
        ValueError: If it is there already, or a package is missing.
        OSError: If the file cannot be written.
    """
    if MINARI_ID.fullmatch(name):
        return MinariDataSet(name)
    path = Path(name)
    return Hdf5DataSet(path if path.suffix else path.with_name(f"{path.name}.hdf5"))


class Hdf5DataSet:
    """An HDF5 file in robomimic's layout; every episode is in it when :meth:`add` returns.

    ``data/demo_I`` has ``actions``, ``rewards``, ``dones``, ``obs/NAME``, ``next_obs/NAME`` and ``time``, and the
    attributes ``num_samples``, ``seed``, ``success`` and ``reason``; ``mask/success`` names those that reached
    their goal. ``data`` has the attributes ``total`` and ``env_args``.

    Args:
        path: A new file.

    Raises:
        ValueError: If it is there already, has another ending, or h5py is missing.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path):
        require("hdf5")
        if path.suffix not in (".hdf5", ".h5"):
            raise ValueError(f"--hdf5: '{path}' is no .hdf5 file: give another name")
        if path.exists():
            raise ValueError(f"'{path}' is there already: give a new name, a data set is of one kind")
        if not path.absolute().parent.is_dir():
            raise ValueError(f"'{path}': no such folder: {path.absolute().parent}")
        self.name, self.steps = str(path), 0
        self._path, self._file = path, None
        self._successful: list[str] = []
        self._count = 0

    def add(self, demonstration: Demonstration) -> None:
        """Add an episode.

        Raises:
            OSError: If the file cannot be written.
        """
        if self._file is None:
            self._file = self._begin(demonstration)
        name = f"demo_{self._count}"
        group = self._file["data"].create_group(name)
        arrays = {"actions": demonstration.actions, "rewards": demonstration.rewards}
        arrays |= {"dones": demonstration.ends.astype(np.uint8), "time": demonstration.time[:-1]}
        arrays |= {f"obs/{key}": rows[:-1] for key, rows in demonstration.observations.items()}
        arrays |= {f"next_obs/{key}": rows[1:] for key, rows in demonstration.observations.items()}
        for key, rows in arrays.items():
            group.create_dataset(key, data=rows, compression="gzip")
        about = {"num_samples": len(demonstration), "seed": demonstration.origin["seed"]}
        about |= {"success": demonstration.success, "reason": demonstration.reason}
        for key, value in about.items():
            if value is not None:
                group.attrs[key] = value
        self._count, self.steps = self._count + 1, self.steps + len(demonstration)
        self._file["data"].attrs["total"] = self.steps
        if demonstration.success:
            self._successful.append(name)
            self._file.pop("mask/success", None)
            self._file["mask/success"] = np.array(self._successful, dtype="S")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def _begin(self, first: Demonstration) -> h5py.File:
        import h5py

        file = h5py.File(self._path, "x")
        kwargs = {"names": first.names, "limits": first.limits.tolist(), "origin": first.origin}
        about = {"env_name": first.origin["scene"], "type": GYMNASIUM, "env_kwargs": kwargs}
        file.create_group("data").attrs["env_args"] = json.dumps(about, ensure_ascii=False)
        return file


class MinariDataSet:
    """A data set of Minari, in its local folder (``MINARI_DATASETS_PATH``); written when it is closed.

    Args:
        name: A new id, ``NAME-vN`` or ``NAMESPACE/NAME-vN``.

    Raises:
        ValueError: If it is no id, is there already, or minari is missing.
    """

    def __init__(self, name: str):
        require("minari")
        import minari

        if not MINARI_ID.fullmatch(name):
            raise ValueError(f"--minari: '{name}' is no id of Minari: give NAME-vN, such as push/box-v0")
        if name in minari.list_local_datasets():
            raise ValueError(f"--minari: '{name}' is there already: give a new id")
        self.name, self.steps = name, 0
        self._episodes: list[Any] = []
        self._first: Demonstration | None = None

    def add(self, demonstration: Demonstration) -> None:
        """Keep an episode for :meth:`close`."""
        from minari.data_collector import EpisodeBuffer

        self._first = self._first or demonstration
        ends = demonstration.ends
        known = {"success": demonstration.success, "reason": demonstration.reason}
        self._episodes.append(
            EpisodeBuffer(
                id=len(self._episodes),
                seed=demonstration.origin["seed"],
                options={key: value for key, value in known.items() if value is not None},
                observations=demonstration.observations,
                actions=demonstration.actions,
                rewards=demonstration.rewards,
                terminations=ends & demonstration.terminated,
                truncations=ends & (not demonstration.terminated),
                infos={"time": demonstration.time},
            )
        )
        self.steps += len(demonstration)

    def close(self) -> None:
        """Write the data set.

        Raises:
            OSError: If it cannot be written.
        """
        if self._first is None:
            return
        import minari
        from gymnasium.spaces import Box
        from gymnasium.spaces import Dict as Spaces

        first, about = self._first, self._first.origin
        spaces = {key: Box(-np.inf, np.inf, rows.shape[1:], np.float32) for key, rows in first.observations.items()}
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # of authors and links that are not given
            minari.create_dataset_from_buffers(
                self.name,
                self._episodes,
                action_space=Box(*first.limits, dtype=np.float32),
                observation_space=Spaces(spaces),
                algorithm_name=about["strategy"],
                description=f"{about['scene']}, planned by warpmpc with {about['samples']} samples",
            )
        self._first = None
