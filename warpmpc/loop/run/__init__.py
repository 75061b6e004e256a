# SPDX-License-Identifier: Apache-2.0
"""Closed-loop episodes, one or many at once, and choosing an engine by measuring."""
