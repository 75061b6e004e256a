# SPDX-License-Identifier: Apache-2.0
"""Newton's solvers but for MuJoCo behind one face: make one from a scene, step it, say what contacts it reports."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import newton
import warp as wp

from ..kernels.worlds.contacts import newton_contact_force_kernel
from ..model.pairs import pair_table
from ..scene.errors import SceneError
from ..scene.schema import Scene, Solver

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..model.batch_size import BatchSize
    from ..model.layout import Layout
    from ..model.pairs import Pair

PIPELINE_OVERFLOW = 1 << 30
"""Capacity bit of Newton's own contact pipeline."""
_NOT_FOR_SCENES = (
    *("self", "model", "separate_worlds", "use_mujoco_cpu", "use_mujoco_contacts", "use_speculative_contacts"),
    *("save_to_mjcf", "update_data_interval"),
)
"""Arguments of solvers that say how a program uses them; scenes have no say in it."""


class PipelineSolver:
    """A solver fed by Newton's collision pipeline: XPBD, Featherstone, semi-implicit, Steel, Kamino."""

    def __init__(self, model: newton.Model, scene: Scene, layout: Layout, shape: BatchSize, pairs: tuple[Pair, ...]):
        name, self._maximal = _PIPELINE_SOLVERS[scene.engine.solver]
        cls = getattr(newton.solvers, name)
        self.model = model
        self.solver = (
            _kamino(model, scene)
            if scene.engine.solver is Solver.KAMINO
            else cls(model, **checked_options(scene, cls.__init__))
        )
        self._pipeline = newton.CollisionPipeline(model, dynamic_shape_scale=bool(scene.randomize))
        self._contacts = self._pipeline.contacts()
        self._observables = None
        kind = newton.solvers.SolverBase.ObservableKind.CONTACT_F
        if pairs:
            if kind not in self.solver.supported_observables:
                raise SceneError(
                    "this solver reports no contact forces, but cost terms watch some",
                    key="engine.solver",
                    file=scene.path,
                    found=str(scene.engine.solver),
                    allowed=["mujoco", "xpbd", "steel", "kamino"],
                )
            self._observables = self.solver.observables(contacts=self._contacts, kinds={kind})
        self._shapes = len(layout.shapes)
        self._pairs = pair_table(layout, pairs, list(range(self._shapes)), str(model.device))

    def reset(self, state: newton.State) -> None:
        """Forget whatever the solver keeps between steps; the joint state is left as it is."""
        self.solver.reset(state, flags=0)

    def step(self, before: newton.State, after: newton.State, control: newton.Control, dt: float) -> None:
        """One physics step."""
        before.clear_forces()
        self._pipeline.collide(before, self._contacts)
        if self._observables is None:
            self.solver.step(before, after, control, self._contacts, dt)
        else:
            self.solver.step(before, after, control, self._contacts, dt, observables=self._observables)

    def finish(self, state: newton.State) -> None:
        """Complete the state after a control step: joint coordinates from body poses where those lead."""
        if self._maximal:
            newton.eval_ik(self.model, state, state.joint_q, state.joint_qd)

    def add_forces(self, t: int, share: float, force: wp.array, overflow: wp.array) -> None:
        """Add the contact forces of the last physics step to control step ``t`` and gather its overflows."""
        if self._observables is None:
            return
        contacts = self._contacts
        wp.launch(
            newton_contact_force_kernel,
            dim=contacts.rigid_contact_max,
            inputs=[
                self._pairs,
                self._shapes,
                contacts.rigid_contact_count,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
                self._observables.contact_f,
                PIPELINE_OVERFLOW,
                t,
                share,
            ],
            outputs=[force, overflow],
            device=force.device,
        )

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed."""
        return (
            f"more contacts than Newton's pipeline holds ({self._contacts.rigid_contact_max}, bits {bits:#x}): "
            "some were dropped; fewer samples or simpler shapes make room"
        )


_PIPELINE_SOLVERS = {
    Solver.XPBD: ("SolverXPBD", True),
    Solver.FEATHERSTONE: ("SolverFeatherstone", False),
    Solver.SEMI_IMPLICIT: ("SolverSemiImplicit", True),
    Solver.STEEL: ("SolverSteel", False),
    Solver.KAMINO: ("SolverKamino", True),
}
"""Class name in ``newton.solvers``, and whether body poses lead and joint coordinates follow."""


def make_solver(
    model: newton.Model, scene: Scene, layout: Layout, shape: BatchSize, pairs: tuple[Pair, ...]
) -> PipelineSolver:
    """The solver a scene asks for.

    Raises:
        SceneError: If an option does not exist, the solver refuses the scene, or cannot report the forces it watches.
    """
    try:
        return PipelineSolver(model, scene, layout, shape, pairs)
    except SceneError:
        raise
    except (TypeError, ValueError, NotImplementedError) as error:  # what Newton's solvers refuse with
        raise SceneError(
            f"the solver refuses this scene or its options: {error}",
            key="engine.options",
            file=scene.path,
            found=dict(scene.engine.options),
        ) from error


def checked_options(scene: Scene, make: Callable) -> dict[str, Any]:
    """The scene's solver options.

    Args:
        scene: The scene.
        make: What takes them by name.

    Raises:
        SceneError: If the solver has no such option.
    """
    allowed = [n for n in inspect.signature(make).parameters if n not in _NOT_FOR_SCENES]
    for name in scene.engine.options:
        if name not in allowed:
            raise SceneError(
                f"the solver {scene.engine.solver} has no such option",
                key=f"engine.options.{name}",
                file=scene.path,
                found=name,
                allowed=allowed,
            )
    return dict(scene.engine.options)


def _kamino(model: newton.Model, scene: Scene) -> newton.solvers.SolverBase:
    """Kamino takes its options as a configuration; collisions come from Newton's pipeline as for the others."""
    cls = newton.solvers.SolverKamino
    options = {"use_collision_detector": False, **checked_options(scene, cls.Config)}
    return cls(model, config=cls.Config(**options))
