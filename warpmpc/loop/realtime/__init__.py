# SPDX-License-Identifier: Apache-2.0
"""Planner and robot at rates of their own: planning loop, agent, watchdog."""
