# SPDX-License-Identifier: Apache-2.0
"""Source of cost terms that a launch evaluates on its way, around a state that each engine writes for itself."""
