# SPDX-License-Identifier: Apache-2.0
"""The goals set for the engine ``fused``: which rows there are, how each is measured, and how it is told."""
