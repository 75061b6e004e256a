# SPDX-License-Identifier: Apache-2.0
"""The Newton model of all worlds of a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import newton

from .builder import build_world
from .importers import new_builder

if TYPE_CHECKING:
    from ..scene.schema import Scene


def build_model(scene: Scene, worlds: int, device: str) -> newton.Model:
    """Finalize a model of ``worlds`` copies of a scene.

    Raises:
        SceneError: If an asset is missing or broken, or the scene names links or joints that its asset lacks.
    """
    builder = new_builder()
    builder.replicate(build_world(scene).builder, worlds)
    return builder.finalize(device=device)
