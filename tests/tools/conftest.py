# SPDX-License-Identifier: Apache-2.0
"""The tools are programs, not an installed package: tests import them from their folder."""

import sys
from pathlib import Path

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
