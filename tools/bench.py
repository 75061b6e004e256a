#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Times, rates and differences of engines on this machine; ``python tools/bench.py --help`` lists them."""

import sys

from shared.commands import run

if __name__ == "__main__":
    sys.exit(run("benches", "Times, rates and differences of engines on this machine.", sys.argv[1:]))
