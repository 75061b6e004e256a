# SPDX-License-Identifier: Apache-2.0
"""Tasks of others, for the planner's defaults alone."""
