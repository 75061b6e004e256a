# SPDX-License-Identifier: Apache-2.0
"""Networks that stand for geometry: small, trained in NumPy on one core."""
