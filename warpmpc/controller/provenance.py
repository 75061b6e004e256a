# SPDX-License-Identifier: Apache-2.0
"""Provenance of a controller's plans, as plain data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..origin import origin
from ..scene.dump import dump_scene

if TYPE_CHECKING:
    from .controller import Controller


def provenance(controller: Controller) -> dict[str, Any]:
    """Plain data for JSON: scene as text, seed, engine, device, strategy; versions, source and hardware."""
    scene = controller.scene
    about = {
        "scene": scene.name,
        "variant": scene.variant,
        "file": None if scene.path is None else str(scene.path),
        "text": dump_scene(scene),
        "seed": controller.seed,
        "engine": controller.engine.name,
        "device": controller.device,
        "strategy": controller.strategy,
        "samples": controller.shape.samples,
    }
    return {**about, **origin()}
