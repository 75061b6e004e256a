# SPDX-License-Identifier: Apache-2.0
"""Keys of a built-in term become the parameters of its Warp function by their types."""

from typing import ClassVar

import numpy as np
import pytest
import warp as wp
from rollouts import Rollouts

from warpmpc import SceneError, StepView, frame_position
from warpmpc.cost.binding import Binding
from warpmpc.cost.keys import Frame, Object, TermKeys, term
from warpmpc.cost.norms import NormKey, NormKind
from warpmpc.scene.types import NonNegative


class Keys(TermKeys):
    """Keys of every kind."""

    of: Frame
    at: Object
    feet: tuple[Frame, ...]
    near: NonNegative = 0.25
    flat: bool = True
    norm: NormKey = NormKind.COSH
    word: str = "no parameter"
    maybe: NonNegative | None = None

    derived: ClassVar = {"twice": float}

    def bind(self, p, b):
        p.twice = 2.0 * p.near


@term("near", Keys)
def near(s: StepView, p: Keys.Params) -> float:
    """Distance of a frame from an object, as if it were a cost [m]."""
    return p.twice * wp.length(frame_position(s, p.of) - frame_position(s, p.at))


GIVEN = {"of": "base/tip", "at": "box", "feet": ("base/tip", "goal"), "norm": {"kind": "cosh", "p": 0.3}}


@pytest.fixture(scope="module")
def rollouts():
    return Rollouts({"term": "near", **GIVEN}, terms=(near,))


def test_keys_become_parameters_by_their_types(rollouts):
    layout = rollouts.layout
    p = near.bind(GIVEN, Binding(rollouts.scene, layout, key="cost.near"))
    assert set(Keys.Params.vars) == {"of", "at", "feet", "near", "flat", "norm", "twice"}
    assert (p.of, p.at, p.flat) == (layout.frame("base/tip"), layout.frame("box"), 1)
    assert p.feet.numpy().tolist() == [layout.frame("base/tip"), layout.frame("goal")]
    assert (p.near, p.twice, p.norm.p) == pytest.approx((0.25, 0.5, 0.3))


@pytest.mark.parametrize(("key", "value"), [("of", "tip"), ("at", "wall"), ("feet", ("box", "nowhere"))])
def test_what_the_scene_does_not_have_is_one_error_that_names_the_key(rollouts, key, value):
    with pytest.raises(SceneError) as error:
        near.bind({**GIVEN, key: value}, Binding(rollouts.scene, rollouts.layout, key="cost.near"))
    assert error.value.key == f"cost.near.{key}"


def test_a_term_of_keys_costs_what_its_function_says(rollouts):
    away = rollouts.pose("base/tip")[0] - rollouts.pose("box")[0]
    np.testing.assert_allclose(rollouts.cost(), 0.5 * np.linalg.norm(away, axis=-1), rtol=1e-4)
