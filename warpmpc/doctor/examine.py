# SPDX-License-Identifier: Apache-2.0
"""The examination: every finding about a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .contacts import contact_findings
from .control import plan_findings, reach_findings
from .joints import joint_findings
from .subject import Finding, Subject

if TYPE_CHECKING:
    from ..controller.controller import Controller


def examine(controller: Controller) -> list[Finding]:
    """Likely mistakes of a scene, none for one that looks as it should.

    Args:
        controller: It has made a plan from the scene's start.
    """
    subject = Subject(controller.scene, controller.compiled)
    return [
        *joint_findings(subject),
        *contact_findings(subject),
        *reach_findings(subject),
        *plan_findings(controller),
    ]
