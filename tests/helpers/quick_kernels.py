# SPDX-License-Identifier: Apache-2.0
"""Kernels that tests compile without optimization, in a third to two thirds of the time.

Those of Newton and MuJoCo Warp always. Those that are written for one model or one list of terms, where rollouts are
few: other programs have others on disk, and their last bits differ.
"""

import importlib

import warp as wp

LIBRARIES = ("newton.", "mujoco_warp.")
SOONEST = {"enable_backward": False, "optimization_level": 0}
AS_USERS = ("tests/scenes/", "tests/extras/live/test_hand_over.py")
"""Tests whose rollouts take longer than the compiler saves, and those of when kernels are optimized; for single ones
there is the fixture ``optimized``."""

quick = True
"""Whether kernels of models that are made now are compiled soonest, too."""


def compile_soonest() -> None:
    """Let modules of kernels be compiled like that from now on."""
    importlib.import_module("warpmpc.physics.runtime.launch")  # wraps the loading itself, inside of what is done here
    load, resolve = wp.Module.load, wp.Module.resolve_options

    def soonest(module: wp.Module, *args: object, **options: object) -> object:
        foreign = any((kernel.func.__module__ or "").startswith(LIBRARIES) for kernel in module.kernels.values())
        if foreign and not module.execs and any(module.options[name] != value for name, value in SOONEST.items()):
            wp.set_module_options(SOONEST, module=module)
        return load(module, *args, **options)

    def resolved(module: wp.Module, *args: object, **keys: object) -> dict[str, object]:
        options = resolve(module, *args, **keys)
        written = "." not in module.name  # not a file of a package
        if quick and written and options["optimization_level"] is None:
            options["optimization_level"] = module.options["optimization_level"] = 0
        return options

    wp.Module.load, wp.Module.resolve_options = soonest, resolved
