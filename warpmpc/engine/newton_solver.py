# SPDX-License-Identifier: Apache-2.0
"""Solvers of Newton behind one face: make one from a scene, reset it, step it, gather what contacts it reports."""

from __future__ import annotations

import inspect
import warnings
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import newton
import warp as wp

from ..kernels.engine.contacts import newton_contact_force_kernel
from ..scene.errors import SceneError
from ..scene.model.mujoco_model import Options, make_world
from ..scene.model.pairs import pair_table
from ..scene.schema import FrictionCombine, Scene, Solver
from .mujoco_warp import CAPACITY_BITS, capacities, overflow_message

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.pairs import Pair
    from ..scene.model.trajectory import BatchSize

PIPELINE_OVERFLOW = 1 << 30
"""Capacity bit of Newton's own contact pipeline."""
_NOT_FOR_SCENES = (
    *("self", "model", "separate_worlds", "use_mujoco_cpu", "use_mujoco_contacts", "use_speculative_contacts"),
    *("save_to_mjcf", "update_data_interval", "disable_sensors", "include_sites", "deterministic", "strict_capacity"),
)
"""Arguments of solvers that say how a program uses them; scenes have no say in it."""


class NewtonSolver(ABC):
    """A solver of all worlds of a model.

    A subclass makes :attr:`solver`, :attr:`contacts` and :attr:`observables`, and steps.

    Args:
        model: The model of all worlds.
        compiled: The scene, compiled.
        shape: Sizes of the batch.
        pairs: Pairs of entities whose contact force is watched.
    """

    solver: newton.solvers.SolverBase
    contacts: newton.Contacts
    """Contacts of the last step."""
    observables: Any = None
    """What the solver reports of every step, None for nothing."""
    maximal = False
    """Whether the solver moves bodies, and joint coordinates follow them."""

    def __init__(self, model: newton.Model, compiled: CompiledScene, shape: BatchSize, pairs: tuple[Pair, ...]):
        self.model, layout = model, compiled.layout
        self._worlds, self._shapes = shape.worlds, len(layout.shapes)
        self._pairs = pair_table(layout, pairs, list(range(self._shapes)), str(model.device))

    def reset(self, state: newton.State) -> None:
        """Start from the joint coordinates of a state: bodies follow them, and nothing of earlier steps remains."""
        newton.eval_fk(self.model, state.joint_q, state.joint_qd, state)
        self.solver.reset(state, flags=0)

    def step(self, before: newton.State, after: newton.State, control: newton.Control, dt: float) -> None:
        """One physics step."""
        self.solver.step(before, after, control, self.contacts, dt, observables=self.observables)

    def finish(self, state: newton.State) -> None:
        """Complete the state after a control step: joint coordinates from body poses where those lead."""
        if self.maximal:
            newton.eval_ik(self.model, state, state.joint_q, state.joint_qd)

    def add_forces(self, t: int, share: float, force: wp.array, overflow: wp.array) -> None:
        """Add the contact forces of the last physics step to control step ``t`` and gather its overflows."""
        if self.observables is None:
            return
        contacts, found = self.contacts, self.observables
        watched = found.contact_f is not None
        bits = getattr(found, "overflow", None)
        wp.launch(
            newton_contact_force_kernel,
            dim=max(contacts.rigid_contact_max if watched else 0, self._worlds if bits is not None else 0),
            inputs=[
                *(self._pairs, self._shapes, contacts.rigid_contact_count),
                *(contacts.rigid_contact_shape0, contacts.rigid_contact_shape1, found.contact_f),
                *(bits, CAPACITY_BITS, PIPELINE_OVERFLOW, t, share),
            ],
            outputs=[force, overflow],
            device=force.device,
        )

    @abstractmethod
    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed."""


class MujocoSolver(NewtonSolver):
    """``SolverMuJoCo``, with the constraint solver's options as other engines have them."""

    def __init__(
        self, model: newton.Model, scene: Scene, compiled: CompiledScene, shape: BatchSize, pairs: tuple[Pair, ...]
    ):
        super().__init__(model, compiled, shape, pairs)
        if scene.engine.friction_combine is FrictionCombine.AVERAGE:
            raise SceneError(
                "this solver knows priorities of friction alone: set engine.friction_combine to priority",
                key="engine.friction_combine",
                file=scene.path,
                found="average",
            )
        cls, given = newton.solvers.SolverMuJoCo, Options.of(scene.engine)
        world = make_world(compiled, timestep=1e-3, options=given)
        ours = {
            "iterations": int(world.model.opt.iterations),
            "tolerance": float(world.model.opt.tolerance),
            "integrator": int(world.model.opt.integrator),
            "cone": int(world.model.opt.cone),
            "impratio": float(world.model.opt.impratio),
            **capacities(world.model, compiled.layout),
        }
        with warnings.catch_warnings():
            # it asks for MuJoCo 3.17, and calls what MuJoCo Warp 4 renames
            warnings.filterwarnings("ignore", "MuJoCo dependency version mismatch|set_const_", Warning)
            self.solver = cls(model, **(ours | checked_options(scene, cls)))
        self.contacts = newton.Contacts(self.solver.get_max_contact_count(), 0, device=model.device)
        kind = cls.ObservableKind
        kinds = {kind.OVERFLOW, kind.CONTACT_F} if pairs else {kind.OVERFLOW}
        self.observables = self.solver.observables(kinds, contacts=self.contacts if pairs else None)

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""
        return overflow_message(self.solver.mjw_data, bits)


class XpbdSolver(NewtonSolver):
    """``SolverXPBD``, fed by Newton's collision pipeline."""

    maximal = True

    def __init__(
        self, model: newton.Model, scene: Scene, compiled: CompiledScene, shape: BatchSize, pairs: tuple[Pair, ...]
    ):
        super().__init__(model, compiled, shape, pairs)
        cls = newton.solvers.SolverXPBD
        self.solver = cls(model, **checked_options(scene, cls))
        self._pipeline = newton.CollisionPipeline(model, dynamic_shape_scale=bool(scene.randomize))
        self.contacts = self._pipeline.contacts()
        if pairs:
            self.observables = self.solver.observables(contacts=self.contacts, kinds={cls.ObservableKind.CONTACT_F})

    def step(self, before: newton.State, after: newton.State, control: newton.Control, dt: float) -> None:
        """One physics step; contacts are found before it."""
        before.clear_forces()
        self._pipeline.collide(before, self.contacts)
        super().step(before, after, control, dt)

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed."""
        return (
            f"more contacts than Newton's pipeline holds ({self.contacts.rigid_contact_max}, bits {bits:#x}): "
            "some were dropped; fewer samples or simpler shapes make room"
        )


_SOLVERS = {Solver.MUJOCO: MujocoSolver, Solver.XPBD: XpbdSolver}


def make_solver(
    model: newton.Model, scene: Scene, compiled: CompiledScene, shape: BatchSize, pairs: tuple[Pair, ...]
) -> NewtonSolver:
    """The solver a scene asks for."""
    try:
        return _SOLVERS[scene.engine.solver](model, scene, compiled, shape, pairs)
    except SceneError:
        raise
    except (TypeError, ValueError, NotImplementedError) as error:  # what Newton's solvers refuse with
        raise SceneError(
            f"the solver refuses this scene or its options: {error}",
            key="engine.options",
            file=scene.path,
            found=dict(scene.engine.options),
        ) from error


def checked_options(scene: Scene, solver: type[newton.solvers.SolverBase]) -> dict[str, Any]:
    """The scene's solver options.

    Args:
        scene: The scene.
        solver: The solver, whose constructor takes them by name.

    Raises:
        SceneError: If the solver has no such option.
    """
    allowed = [n for n in inspect.signature(solver.__init__).parameters if n not in _NOT_FOR_SCENES]
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
