# SPDX-License-Identifier: Apache-2.0
"""A ball on a tray: how it is seen, and how well models of it predict."""
