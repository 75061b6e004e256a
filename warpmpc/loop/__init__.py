# SPDX-License-Identifier: Apache-2.0
"""Closing the loop: plant, log, estimation, real time, robots and runs."""
