# SPDX-License-Identifier: Apache-2.0
"""Source of cost terms that a launch evaluates on its way, around a state that each engine writes for itself.

``arm``, ``collision`` and ``learned`` are source by hand of the few terms whose plans are more than 3 % slower with
traced source. Each function takes a :class:`~warpmpc.cost.code.state.TermCode` and the filled parameter struct. It
returns the value, or None where the parameters ask for what only the Warp function can do. What decides the shape of
the source (frames, joints) is read from the struct while it is written; numbers that may be drawn anew are read from it
by the source.
"""
