# SPDX-License-Identifier: Apache-2.0
"""Cost terms as baked source, beside their Warp functions in ``kernels.terms``, which are what they are tested against.

Each takes a :class:`~warpmpc.cost.code.state.TermCode` and the filled parameter struct and returns the value, or None
where its parameters ask for what only the Warp function can do. What decides the shape of the source (frames, joints)
is read from the struct while it is written; numbers that may be drawn anew are read from it by the source itself.
"""
