# SPDX-License-Identifier: Apache-2.0
"""The types of what proposes samples beside those that are drawn."""

from __future__ import annotations

from pydantic import model_validator

from .types import Count, Fractions, Names, Positive, Section

KINDS = {
    "function": (),
    "motions": ("nearest", "joints"),
    "recall": ("nearest", "joints", "splice"),
    "policy": ("observation",),
}
"""What may propose, and the keys that each of them has for itself."""


class Ancillary(Section):
    """Samples that something else proposes for the observed state: a function, stored motions, the past, a policy."""

    function: str | None = None
    """Name of an ancillary controller of your own (``@warpmpc.ancillary``), from a file of ``--terms`` or given to the
    ``Controller``."""
    motions: str | None = None
    """``.npz`` file of motions: ``joint_q [N, nq]``, ``joint_qd [N, nv]``, ``control [N, K, nu]``, ``time [K]`` after
    each of these states [s]; or a run that ``--npz`` wrote, from any of its states on."""
    recall: Positive | None = None
    """How long a run remembers what it was sent and in which states, with a plan for every control [s]: what followed
    the states most like the observed one is tried again. Whoever walks has been where it is one stride ago."""
    nearest: Count = 1
    """``motions`` and ``recall``: how many are tried, those whose states are nearest to the observed one; recalled ones
    a tenth of the horizon apart at least."""
    joints: Names | None = None
    """``motions`` and ``recall``: joints whose positions and velocities say what is near; all when left out, without
    the places of floating bodies and of joints that slide without end for ``recall``. Each number counts by its
    spread over what is stored."""
    splice: Fractions = (0.0, 0.3, 0.6)
    """``recall``: shares of the horizon for which the plan goes on as it was before the recalled controls take over;
    each is a sample of its own for every one of the ``nearest``."""
    policy: str | None = None
    """``.onnx`` file of a policy, run by onnxruntime (``pip install "warpmpc[onnx]"``)."""
    observation: Names = ("joint_q", "joint_qd")
    """``policy``: what it reads, side by side: ``joint_q``, ``joint_qd``, ``act``, poses of the task (x, y, z, qx, qy,
    qz, qw) and its scalars, by name. It returns one control ``[nu]``, or controls ``[T, nu]`` or ``[n, T, nu]``."""

    @model_validator(mode="after")
    def _one_kind(self) -> Ancillary:
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            found = ", ".join(given) if given else "none of them"
            raise ValueError(f"needs one of function, motions, recall and policy; found {found}")
        for kind, keys in KINDS.items():
            for key in keys:
                if key not in KINDS[given[0]] and getattr(self, key) != type(self).model_fields[key].default:
                    raise ValueError(f"'{key}' is a key of {kind}, not of {given[0]}")
        return self

    @property
    def file(self) -> str | None:
        """The file it is read from, if any."""
        return self.motions or self.policy
