# SPDX-License-Identifier: Apache-2.0
"""What turns a state and controls into trajectories."""
