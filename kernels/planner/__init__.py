# SPDX-License-Identifier: Apache-2.0
"""Noise, splines, weights and distributions."""
