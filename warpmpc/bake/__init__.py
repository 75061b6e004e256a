# SPDX-License-Identifier: Apache-2.0
"""From tables to straight-line source over a SIMD type: one float on a GPU, 16, 8 or 4 samples at once on a CPU.

What is known when the source is written (a robot's dimensions, zeros and ones of its frames) is folded into it. Engines
that evaluate terms on the way put the kinematics of :mod:`.tree` and the traced cost terms in one kernel.
"""
