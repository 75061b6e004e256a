# SPDX-License-Identifier: Apache-2.0
"""MPC with hard constraints between spheres, by CasADi and IPOPT, as a baseline of Table I."""
