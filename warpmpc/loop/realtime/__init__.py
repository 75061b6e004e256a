# SPDX-License-Identifier: Apache-2.0
"""Planner and robot at their own rates: planning loop, agent, watchdog."""
