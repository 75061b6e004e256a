# SPDX-License-Identifier: Apache-2.0
"""Tuning of scene keys: the search space, what a run is worth, and the search."""
