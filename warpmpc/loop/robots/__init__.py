# SPDX-License-Identifier: Apache-2.0
"""Robots: drivers by their names, and the simulated robot as a separate process."""
