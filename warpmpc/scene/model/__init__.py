# SPDX-License-Identifier: Apache-2.0
"""A scene as physics: Newton world, MuJoCo model, and tables of what is in them.

``compiled`` is the entry: scene → model and layout, cached. ``builder`` makes the Newton world from ``importers``
(``urdf``, USD) and ``mjcf`` files; ``compose`` joins MJCF files to it as one MuJoCo model, ``mujoco_model`` opens that.
``layout`` lists joints, bodies, shapes and controls; ``controls`` makes controls of drives; ``properties`` and
``randomize`` vary masses and sizes; ``spheres``, ``hulls`` and ``link_pairs`` simplify shapes; ``equilibrium``
finds controls that hold the start; ``conversion`` maps states from and to other simulators.
"""
