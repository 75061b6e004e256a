# SPDX-License-Identifier: Apache-2.0
"""Task: what a run wants."""
