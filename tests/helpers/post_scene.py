# SPDX-License-Identifier: Apache-2.0
"""A robot whose goal is in the middle of a post."""

POST = """
[timing]
control_dt = 0.04

[engine]
name = "mujoco"
threads = 1

[[robot]]
name = "base"
asset = "point_robot.urdf"
ground_contact = false
frames.centre = { link = "base_link" }
drive = { damping = 300.0, effort_limit = 200.0, limit = 1.0 }

[[obstacle]]
name = "post"
shape = "cylinder"
size = [0.3, 0.3]
position = [1.0, 0.0, 0.15]
movable = true

[goal]
frame = "base/centre"
position = [1.0, 0.0]

[[cost]]
term = "distance"
between = ["base/centre", "goal"]
planar = true

[[cost]]
term = "contact_force"
between = ["base", "obstacles"]
weight = 10.0

[planner]
samples = 32
horizon = 10
dt = 0.04

[success]
distance = 0.05
"""
"""The goal is in the middle of a post that can be moved; touching it costs."""
