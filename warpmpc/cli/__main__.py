# SPDX-License-Identifier: Apache-2.0
"""``python -m warpmpc.cli``: the program ``warpmpc``."""

from .main import main

main()
