# SPDX-License-Identifier: Apache-2.0
"""Plants that are not as the planner takes them: wrong models, estimated states, latency, other processes."""
