# SPDX-License-Identifier: Apache-2.0
"""From the Warp function of a cost term to source for many worlds at once, by running its syntax tree on symbols.

``values`` are the symbols, ``arithmetic`` what operators do to them, ``functions`` Warp's own functions, ``accessors``
what a term reads of a step, ``statements`` branches and loops, ``tracer`` expressions and calls.
"""
