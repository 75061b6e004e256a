# SPDX-License-Identifier: Apache-2.0
"""Kernels of Newton and MuJoCo Warp: tests compile them without optimization and gradients, in a third of the time."""

import importlib

import warp as wp

LIBRARIES = ("newton.", "mujoco_warp.")
SOONEST = {"enable_backward": False, "optimization_level": 0}


def compile_soonest() -> None:
    """Let modules of kernels of these libraries be loaded with :data:`SOONEST` from now on, and no others."""
    importlib.import_module("warpmpc.physics.runtime.launch")  # wraps the loading itself, inside of what is done here
    load = wp.Module.load

    def soonest(module: wp.Module, *args: object, **options: object) -> object:
        foreign = any((kernel.func.__module__ or "").startswith(LIBRARIES) for kernel in module.kernels.values())
        if foreign and not module.execs and any(module.options[name] != value for name, value in SOONEST.items()):
            wp.set_module_options(SOONEST, module=module)
        return load(module, *args, **options)

    wp.Module.load = soonest
