# SPDX-License-Identifier: Apache-2.0
"""Run logs in the formats of others: MCAP for Foxglove and ROS 2, HDF5 for learning."""
