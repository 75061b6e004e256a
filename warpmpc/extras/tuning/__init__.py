# SPDX-License-Identifier: Apache-2.0
"""Tuning of scene keys: the search space, the value of an episode, the search."""
