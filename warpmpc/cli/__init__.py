# SPDX-License-Identifier: Apache-2.0
"""The program ``warpmpc``: commands, progress, printed reports."""

import gc

gc.set_threshold(100_000, 50, 100)  # a million objects of imports and models stay: looking at them takes seconds
