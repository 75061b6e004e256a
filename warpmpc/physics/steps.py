# SPDX-License-Identifier: Apache-2.0
"""The step of a model on a CPU, compiled by itself: what rolls it out and what evaluates that are compiled apart."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from ..compiling import compile_made
from ..launch import Launcher
from .kernel import options
from .parts import CALLS
from .tables import packed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .parts import Parts


class Steps:
    """Functions of a model's step; whoever calls them by their addresses keeps this object meanwhile.

    Args:
        parts: Parts of the source.
        what: What is stepped, for the line that tells of compiling.

    Raises:
        KernelError: If it does not compile.
        OSError: If Warp's folder of compiled kernels cannot be written.
    """

    def __init__(self, parts: Parts, what: str):
        text = packed(parts.step_functions())
        self._kernel = compile_made(partial(_make, text), options(parts.lanes), "cpu", 1, what, source=text)
        self.address = wp.zeros(len(CALLS), dtype=wp.uint64, device="cpu")
        """Addresses of :data:`~.parts.CALLS`."""
        Launcher("cpu")(self._kernel, 1, [], [self.address])


def _make(text: str, *, options: Mapping[str, object]) -> wp.Kernel:
    """The kernel that tells the addresses; Warp makes one of a text."""

    @wp.func_native(text)
    def write_addresses(address: wp.array[wp.uint64]): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=dict(options))
    def steps_kernel(
        # outputs
        address: wp.array[wp.uint64],  # [CALLS]
    ):
        """One thread: the addresses of the functions of a step."""
        write_addresses(address)

    return steps_kernel
