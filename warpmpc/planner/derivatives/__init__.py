# SPDX-License-Identifier: Apache-2.0
"""Derivatives of physics and costs along a rollout, by finite differences in parallel worlds."""
