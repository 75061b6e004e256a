# SPDX-License-Identifier: Apache-2.0
"""Optimization fabrics, from the PyPI package ``fabrics``, as a baseline of Table I."""
