#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Experiments of papers and our own, in closed loop over seeds; ``python tools/study.py --help`` lists them."""

import sys

from shared.commands import run

if __name__ == "__main__":
    sys.exit(run("studies", "Experiments of papers and our own, in closed loop over seeds.", sys.argv[1:]))
