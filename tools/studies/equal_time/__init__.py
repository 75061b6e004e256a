# SPDX-License-Identifier: Apache-2.0
"""Strategies compared at equal wall-clock."""
