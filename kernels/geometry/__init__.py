# SPDX-License-Identifier: Apache-2.0
"""Kinematics, distance fields and distances."""
