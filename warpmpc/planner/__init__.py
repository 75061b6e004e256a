# SPDX-License-Identifier: Apache-2.0
"""The plan step and its strategies."""
