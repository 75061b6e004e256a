# SPDX-License-Identifier: Apache-2.0
"""Many worlds of one MuJoCo model that are stepped side by side."""

from __future__ import annotations

import copy
import operator
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property

import mujoco
import numpy as np
import warp as wp

from .batch import BatchRollout
from .outputs import unwritten_field
from .runtime.launch import capturing, one_thread
from .runtime.thread_pool import thread_count
from .unsupported import callbacks

NUMBERS = (
    "body_mass",
    "body_inertia",
    "geom_friction",
    "geom_size",
    "actuator_gainprm",
    "actuator_biasprm",
    "gravity",
)
"""Arrays of a model that worlds may have of their own."""
SIGNED = ("actuator_gainprm", "actuator_biasprm", "gravity")
"""Those of any sign."""
_MANY = 2**31
_DERIVED = ("body_invweight0", "dof_invweight0", "tendon_invweight0", "geom_rbound")
"""Arrays that follow from them."""


class BatchSimulator:
    """W worlds of a model, each in its own state, in single precision.

    Arrays are views of the simulator's memory: NumPy arrays on a CPU, on a GPU ``wp.array`` with DLPack and
    ``__cuda_array_interface__`` (``torch.from_dlpack(sim.qpos)``). They stay the same ones; writing into ``qpos``,
    ``qvel`` and ``act`` moves the worlds. Poses and readings are those of the state that the last :meth:`step` or
    :meth:`reset` led to, while MuJoCo's, after ``mj_step``, are those of the state before; sensors of forces and
    accelerations take the solver for it once more. The same numbers give the same bits, whatever the number of threads.
    One thread at a time uses a simulator: a call while another thread is in one is a ``RuntimeError``.

    Args:
        model: The model.
        worlds: Number of worlds W.
        device: Warp device.
        threads: Threads on a CPU; 0 for one for each core.
        vary: Numbers that worlds have of their own: ``body_mass``, ``body_inertia``, ``geom_friction``, ``geom_size``,
            ``actuator_gainprm``, ``actuator_biasprm``, ``gravity``; :meth:`set_numbers` sets them without compiling.
        contact_pairs: Pairs of bodies, by name (``world`` is one), whose contact forces are kept.

    Raises:
        ValueError: If the model has what this physics lacks, there is no world, or a name is unknown.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        *,
        device: wp.DeviceLike = "cpu",
        threads: int = 0,
        vary: Sequence[str] = (),
        contact_pairs: Sequence[tuple[str, str]] = (),
    ):
        if not 1 <= operator.index(worlds) < _MANY:
            raise ValueError(f"worlds is {worlds}, not at least 1 and below 2**31")
        if unknown := sorted(set(vary) - set(NUMBERS)):
            raise ValueError(f"vary has {', '.join(unknown)}; there is: {', '.join(NUMBERS)}")
        if unread := unwritten_field(model, "sensordata"):
            raise ValueError(
                f"the physics of warpmpc reads no {unread}: delete them, or switch all off (mjDSBL_SENSOR)"
            )
        self._in_use = threading.RLock()
        self.model, self.worlds, self._substeps = model, operator.index(worlds), 1
        self._numbers = {name: self._nominal(name) for name in vary}
        self._batch = BatchRollout(
            model,
            worlds,
            1,
            arrays=self._arrays() if vary else None,
            settable=True,
            bodies=range(model.nbody),
            pairs=[tuple(model.body(name).id for name in pair) for pair in contact_pairs],
            device=device,
            threads=thread_count(threads),
            sensors_before=False,
            in_place=True,
        )
        self.reset()

    @cached_property
    def _rows(self) -> np.ndarray | wp.array:
        """Time, coordinates, velocities and activations ``[W, 1+nq+nv+na]``."""
        return self._view(self._batch.work.initial)

    def _view(self, array: wp.array) -> np.ndarray | wp.array:
        return array.numpy() if self._batch.device.is_cpu else array

    def _columns(self, first: int, count: int) -> np.ndarray | wp.array:
        return self._rows[:, first : first + count]

    @property
    def batch(self) -> BatchRollout:
        """Arrays of all worlds, and what runs on them."""
        return self._batch

    @property
    def time(self) -> np.ndarray | wp.array:
        """Time of each world ``[W]`` [s]."""
        return self._rows[:, 0]

    @property
    def qpos(self) -> np.ndarray | wp.array:
        """Coordinates ``[W, nq]``."""
        return self._columns(1, self.model.nq)

    @property
    def qvel(self) -> np.ndarray | wp.array:
        """Velocities ``[W, nv]``."""
        return self._columns(1 + self.model.nq, self.model.nv)

    @property
    def act(self) -> np.ndarray | wp.array:
        """Activations ``[W, na]``."""
        return self._columns(1 + self.model.nq + self.model.nv, self.model.na)

    @property
    def ctrl(self) -> np.ndarray | wp.array:
        """Controls of the next step ``[W, nu]``, in single precision."""
        return self._view(self._batch.work.knots)[0, :, 0]

    @property
    def xpos(self) -> np.ndarray | wp.array:
        """Positions of all bodies ``[W, nbody, 3]`` [m]."""
        return self._view(self._batch.outputs.poses)[:, :, :3]

    @property
    def xquat(self) -> np.ndarray | wp.array:
        """Rotations of all bodies (w, x, y, z) ``[W, nbody, 4]``."""
        return self._view(self._batch.outputs.poses)[:, :, 3:]

    @property
    def sensordata(self) -> np.ndarray | wp.array:
        """Sensor readings ``[W, nsensordata]``."""
        return self._view(self._batch.sensordata)[:, 0]

    @property
    def contact_force(self) -> np.ndarray | wp.array:
        """Mean contact force on the first body of each pair during the last step ``[W, pairs, 3]`` [N]."""
        return self._view(self._batch.outputs.force)

    @property
    def diverged(self) -> np.ndarray:
        """Worlds whose state or controls were no numbers, or beyond 1e10 ``[W]``.

        They stay where they were before that step, or at the model's own coordinates, until :meth:`reset`.
        """
        return self._batch.work.diverged.numpy() != 0

    @property
    def overflow(self) -> np.ndarray:
        """Worlds in which contacts were lost in the last step since they were too many ``[W]``."""
        return self._batch.work.overflow.numpy() != 0

    @one_thread
    def reset(
        self,
        mask: np.ndarray | None = None,
        qpos: np.ndarray | None = None,
        qvel: np.ndarray | None = None,
    ) -> None:
        """Put worlds into a state, at time 0, with no activation.

        Args:
            mask: Which worlds ``[W]``; all if None.
            qpos: Coordinates ``[nq]``, of each of these worlds ``[n, nq]`` or of all ``[W, nq]``; the model's own if
                None.
            qvel: Velocities likewise; zero if None.

        Raises:
            ValueError: If a size is wrong.
        """
        m = self.model
        chosen = np.ones(self.worlds, bool) if mask is None else np.asarray(mask, bool)
        if chosen.shape != (self.worlds,):
            raise ValueError(f"mask has the shape {chosen.shape}, not {(self.worlds,)}")
        rows = self._batch.work.initial.numpy()
        rows[chosen] = 0.0
        rows[chosen, 1 : 1 + m.nq] = self._given("qpos", qpos, m.qpos0, chosen)
        rows[chosen, 1 + m.nq : 1 + m.nq + m.nv] = self._given("qvel", qvel, np.zeros(m.nv), chosen)
        start, force = self._batch.outputs.warmstart.numpy(), self._batch.outputs.force.numpy()
        lost = self._batch.work.diverged.numpy()
        start[chosen], force[chosen], lost[chosen] = 0.0, 0.0, 0
        if not self._batch.device.is_cpu:
            with capturing:
                self._batch.work.initial.assign(rows)
                self._batch.outputs.warmstart.assign(start)
                self._batch.outputs.force.assign(force)
                self._batch.work.diverged.assign(lost)
        self.forward()

    def _given(self, name: str, values: np.ndarray | None, usual: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Rows of the worlds that are put into a state."""
        values = usual if values is None else np.asarray(values, dtype=float)
        count = int(chosen.sum())
        if values.shape == (self.worlds, len(usual)):
            return values[chosen]
        if values.shape not in ((len(usual),), (count, len(usual))):
            shapes = f"{(len(usual),)}, {(count, len(usual))} or {(self.worlds, len(usual))}"
            raise ValueError(f"{name} has the shape {values.shape}, not {shapes}")
        return values

    @one_thread
    def forward(self) -> None:
        """Bring poses and sensor readings up to date after ``qpos`` or ``qvel`` were written."""
        self._run(0)

    @one_thread
    def step(self, ctrl: np.ndarray | wp.array | None = None, n: int = 1) -> None:
        """Take physics steps with the same controls.

        Args:
            ctrl: Controls ``[W, nu]`` or ``[nu]``, as a ``wp.array`` ``[W, nu]`` of floats; those in :attr:`ctrl` if
                None.
            n: Number of physics steps, at least 1.

        Raises:
            ValueError: If a size or type is wrong, or a callback of MuJoCo (``mjcb_*``) is installed.
        """
        if not 1 <= operator.index(n) < _MANY:
            raise ValueError(f"n is {n}, not at least 1 and below 2**31")
        if isinstance(ctrl, wp.array):
            wanted = (self.worlds, self.model.nu), wp.float32
            if (ctrl.shape, ctrl.dtype) != wanted:
                raise ValueError(f"ctrl is a wp.array of shape {ctrl.shape} and {ctrl.dtype}, not {wanted}")
            with capturing:
                wp.copy(self._batch.work.knots.reshape((self.worlds, self.model.nu)), ctrl)
        elif ctrl is not None:
            shape = (self.worlds, self.model.nu)
            if np.shape(ctrl) not in (shape, shape[1:]):
                raise ValueError(f"ctrl has the shape {np.shape(ctrl)}, not {shape} or {shape[1:]}")
            values = np.broadcast_to(np.asarray(ctrl, np.float32), shape)
            if self._batch.device.is_cpu:
                self.ctrl[...] = values
            else:
                with capturing:
                    self._batch.work.knots.assign(np.ascontiguousarray(values)[None, :, None])
        self._run(n)

    def _run(self, substeps: int) -> None:
        if installed := callbacks():
            raise ValueError(f"the physics of warpmpc has no {installed}")
        if self._substeps != substeps:
            with capturing:
                self._batch.work.substeps.fill_(substeps)
            self._substeps = substeps
        self._batch.run()

    @one_thread
    def set_numbers(self, mask: np.ndarray | None = None, **numbers: np.ndarray) -> None:
        """Give worlds their own numbers; nothing is compiled.

        What MuJoCo derives from them (inverse inertias, bounding spheres) follows for each world.

        Args:
            mask: Which worlds ``[W]``; all if None.
            **numbers: Arrays in the model's shape, or of each of these worlds ``[n, ...]``.

        Raises:
            ValueError: If one is not in ``vary``, has another shape, is no number or is negative where that has no
                meaning, or if numbers that were zero at the start no longer are.
        """
        chosen = np.ones(self.worlds, bool) if mask is None else np.asarray(mask, bool)
        for name in numbers:
            if name not in self._numbers:
                raise ValueError(f"{name} is the same in all worlds: name it in vary")
            own, values = self._numbers[name].shape[1:], np.asarray(numbers[name], dtype=float)
            if values.shape not in (own, (int(chosen.sum()), *own)):
                raise ValueError(f"{name} has the shape {values.shape}, not {own} or {(int(chosen.sum()), *own)}")
            least = -np.inf if name in SIGNED else 0.0
            if not (np.isfinite(values) & (values >= least)).all():
                raise ValueError(f"{name} has values that are negative or no numbers")
            if np.abs(values).max(initial=0.0) > mujoco.mjMAXVAL:
                raise ValueError(f"{name} has values beyond {mujoco.mjMAXVAL:g}")
        before = {name: values.copy() for name, values in self._numbers.items()}
        for name, values in numbers.items():
            self._numbers[name][chosen] = values
        try:
            self._batch.set_arrays(self._arrays())
        except ValueError:
            self._numbers = before
            raise

    def numbers(self, name: str) -> np.ndarray:
        """Copy of the numbers of all worlds ``[W, ...]``."""
        return self._numbers[name].copy()

    def _nominal(self, name: str) -> np.ndarray:
        nominal = self.model.opt.gravity if name == "gravity" else getattr(self.model, name)
        return np.repeat(nominal[None], self.worlds, axis=0)

    def _arrays(self) -> Mapping[str, np.ndarray]:
        """Numbers of all worlds, and what follows from them."""
        out = dict(self._numbers)
        if not {"body_mass", "body_inertia", "geom_size"} & set(out):
            return out
        own = copy.copy(self.model)
        data = mujoco.MjData(own)
        derived = {name: np.repeat(getattr(own, name)[None], self.worlds, axis=0) for name in _DERIVED}
        for world in range(self.worlds):
            for name, values in self._numbers.items():
                (own.opt.gravity if name == "gravity" else getattr(own, name))[...] = values[world]
            mujoco.mj_setConst(own, data)
            _bound(own)
            for name, rows in derived.items():
                rows[world] = getattr(own, name)
        return {**out, **derived}


def _bound(m: mujoco.MjModel) -> None:
    """Set the radii of geoms' bounding spheres from their sizes."""
    kinds = mujoco.mjtGeom
    size = m.geom_size
    for kind, radius in (
        (kinds.mjGEOM_SPHERE, size[:, 0]),
        (kinds.mjGEOM_CAPSULE, size[:, 0] + size[:, 1]),
        (kinds.mjGEOM_CYLINDER, np.hypot(size[:, 0], size[:, 1])),
        (kinds.mjGEOM_BOX, np.linalg.norm(size, axis=1)),
        (kinds.mjGEOM_ELLIPSOID, size.max(axis=1)),
    ):
        own = m.geom_type == int(kind)
        m.geom_rbound[own] = radius[own]
