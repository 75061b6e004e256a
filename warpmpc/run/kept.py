# SPDX-License-Identifier: Apache-2.0
"""Results of episodes on disk, so that a run that was interrupted goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..origin import code_digest
from .code import scene_digest
from .records import Records
from .result import EpisodeResult

if TYPE_CHECKING:
    from ..scene.schema import Scene


class KeptResults:
    """Results of a scene's episodes in a file, one JSON object a line.

    A result counts as long as scene, assets, terms, engine, device and the episodes it was planned together with are
    the same.

    Args:
        path: The file; made when the first result is added.
        scene: The scene, before its tasks are drawn.
        term_files: Files of users' cost terms; what they hold counts, not where.
        engine: Engine that was asked for.
        device: Device that was asked for.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If the file holds something else.
    """

    def __init__(self, path: Path, scene: Scene, *, term_files: Sequence[Path] = (), engine: str, device: str):
        self._records = Records(path)
        terms = [hashlib.sha256(file.read_bytes()).hexdigest()[:16] for file in term_files]
        self._what = [scene_digest(scene), engine, device, terms]
        self._code = code_digest()
        self.outdated = 0
        """Results found that another state of warpmpc made."""
        self.taken = 0
        """Results found, whose episodes need not be run."""

    def find(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Results of episodes that were planned together, or nothing if one is missing."""
        found = [self._records.by_key.get(self._key(seeds, seed)) for seed in seeds]
        if None in found:
            return []
        self.taken += len(found)
        self.outdated += sum(record["code"] != self._code for record in found)
        return [EpisodeResult.from_json(record["result"]) for record in found]

    def add(self, seeds: Sequence[int], result: EpisodeResult) -> None:
        """Keep the result of one of the episodes that were planned together, on disk before this returns."""
        self._records.add(self._key(seeds, result.seed), {"code": self._code, "result": result.to_json()})

    def _key(self, seeds: Sequence[int], seed: int) -> str:
        together = [seeds[0], len(seeds)] if len(seeds) > 1 else None
        return json.dumps([*self._what, together, seed])
