# SPDX-License-Identifier: Apache-2.0
"""Engines: from a state and knots to costs and trajectories."""
