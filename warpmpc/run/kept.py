# SPDX-License-Identifier: Apache-2.0
"""Results of episodes on disk, so that a run that was interrupted goes on."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..origin import code_digest
from .code import scene_digest
from .episode import EpisodeResult
from .records import Records

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
        return [result_from_json(record["result"]) for record in found]

    def add(self, seeds: Sequence[int], result: EpisodeResult) -> None:
        """Keep the result of one of the episodes that were planned together, on disk before this returns."""
        self._records.add(self._key(seeds, result.seed), {"code": self._code, "result": result.to_json()})

    def _key(self, seeds: Sequence[int], seed: int) -> str:
        together = [seeds[0], len(seeds)] if len(seeds) > 1 else None
        return json.dumps([*self._what, together, seed])


def result_from_json(data: dict[str, Any]) -> EpisodeResult:
    """The result that :meth:`~warpmpc.EpisodeResult.to_json` wrote."""
    final, collisions = data["final"], data["collisions"]
    same = ("scene", "variant", "seed", "engine", "device", "success", "reason", "steps", "diverged_worlds", "samples")
    return EpisodeResult(
        **{name: data[name] for name in (*same, "horizon", "fallbacks", "envs")},
        sim_time=data["sim_time_s"],
        position_error=final["position_error_m"],
        yaw_error=final["yaw_error_rad"],
        axis_error=final.get("axis_error_m"),
        cost=_number(final["cost"]),
        max_force=collisions["max_force_N"],
        time_in_contact=collisions["time_in_contact_s"],
        plan_ms={name: _number(value) for name, value in data["plan_ms"].items()},
        stages_ms={name: _number(value) for name, value in data["stages_ms"].items()},
        phases=tuple((entry["phase"], entry["time_s"]) for entry in data.get("phases", ())),
        reached=data.get("reached"),
        drawn=data.get("drawn", {}),
        verdict=tuple(data.get("verdict", ())),
        mean_cost=None if data["success"] is not None else _number(data["mean_cost"]),
    )


def _number(value: float | None) -> float:
    """A number that JSON could say, or else NaN."""
    return math.nan if value is None else value
