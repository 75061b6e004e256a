# SPDX-License-Identifier: Apache-2.0
"""Noise that turns over what it should tell about, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...loop.run.result import Changes
from ...planner.tumbles import OVER, tumble
from ...scene.errors import some
from .finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...planner.controller.controller import Controller


def tumble_findings(controller: Controller) -> Iterator[Finding]:
    """Noise that turns over what it should tell about, and whether it was lowered."""
    scene, layout = controller.scene, controller.layout
    found = controller.lowered or tumble(scene, controller.compiled, controller.engine.name)
    if found is None:
        return
    names = [name for name, factor in zip(layout.control_name, found.factor, strict=True) if factor < 1.0]
    ((key, value),) = Changes(controller).sigma(1.0 if controller.lowered else found.factor).items()
    yield Finding(
        "planner.noise.sigma",
        f"samples{' with the default' if controller.lowered else ''} turn {found.body} over ({OVER:g} rad) within "
        f"{found.time:.2g} s by {some(names)}, and knots are {found.knots:.2g} s apart",
        f"plans take {key} = {value}" if controller.lowered else f"try {key} = {value}, with which they do not",
    )
