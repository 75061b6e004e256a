# SPDX-License-Identifier: Apache-2.0
"""Arms as in STORM: random poses, paths, a tray with a ball, clutter, and training of its learned checkers."""
