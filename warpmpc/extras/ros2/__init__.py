# SPDX-License-Identifier: Apache-2.0
"""Robots behind ROS 2 topics: the driver, and the simulated robot's end."""
