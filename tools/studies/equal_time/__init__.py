# SPDX-License-Identifier: Apache-2.0
"""Strategies, and proposals of a cloned policy, at equal wall-clock or equal samples."""
