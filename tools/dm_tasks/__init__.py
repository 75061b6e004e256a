# SPDX-License-Identifier: Apache-2.0
"""Tasks of the DeepMind Control Suite: their environments, scenes to plan in, and what others reach."""
