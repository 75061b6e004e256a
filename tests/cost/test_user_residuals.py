# SPDX-License-Identifier: Apache-2.0
"""Residuals that users write: what they cost under a norm, their numbers one by one, and mistakes."""

import numpy as np
import pytest
import warp as wp
from rollouts import Rollouts

import warpmpc
from warpmpc import SceneError

Vec2 = wp.types.vector(length=2, dtype=float)


@wp.struct
class LeanParams:
    frame: int
    gain: float


@warpmpc.residual_term("lean")
def lean(s: warpmpc.StepView, p: LeanParams) -> Vec2:
    """How far a frame's z axis leans."""
    up = wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), wp.vec3(0.0, 0.0, 1.0))
    return Vec2(p.gain * up[0], up[1])


@warpmpc.residual_term("level")
def level(s: warpmpc.StepView, p: LeanParams) -> float:
    """How high a frame is."""
    return p.gain * warpmpc.frame_position(s, p.frame)[2]


@wp.struct
class SwayParams:
    robot: int
    lead: float


@warpmpc.residual_term("sway")
def sway(s: warpmpc.StepView, p: SwayParams) -> wp.vec3:
    """Where a centre of mass would coast to."""
    return warpmpc.centre_of_mass(s, p.robot) + p.lead * warpmpc.centre_of_mass_velocity(s, p.robot)


KEYS = {"frame": "base/tip", "gain": 2.0}
SMOOTH = {"kind": "smooth_abs", "p": 0.1}
TERMS = (lean, level, sway)


def test_a_users_residual_costs_its_norm():
    r = Rollouts(
        {"term": "lean", **KEYS},
        {"term": "lean", **KEYS, "norm": SMOOTH, "weight": 3.0},
        {"term": "level", **KEYS, "norm": {"kind": "l2", "p": 0.2}},
        terms=TERMS,
    )
    place, turn = r.pose("base/tip")
    up = turn.apply([0.0, 0.0, 1.0]).reshape(*place.shape)
    x = up[..., :2] * [2.0, 1.0]
    np.testing.assert_allclose(r.cost(0), 0.5 * (x**2).sum(-1), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(r.cost(1), 3.0 * (np.sqrt(x**2 + 0.01) - 0.1).sum(-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(r.cost(2), np.sqrt(4.0 * place[..., 2] ** 2 + 0.04) - 0.2, rtol=1e-4, atol=1e-5)


def test_centres_of_mass_are_there_for_users_residuals():
    own = [{"term": "sway", "robot": name, "lead": 0.3} for name in ("base", "box")]
    built_in = [{"term": "position_residual", "of": {"centre_of_mass": name}, "lead": 0.3} for name in ("base", "box")]
    r = Rollouts(*own, *built_in, terms=TERMS)
    for i in range(2):
        np.testing.assert_allclose(r.cost(i), r.cost(2 + i), rtol=1e-5)
    with pytest.raises(SceneError, match=r"cost\.sway\.robot.*no such robot or object with mass.*base"):
        Rollouts({"term": "sway", "robot": "wall", "lead": 0.3}, terms=TERMS)


def test_every_residual_tells_its_numbers_one_by_one():
    com = {"centre_of_mass": "base"}
    costs = [
        {"term": "lean", **KEYS},
        {"term": "level", **KEYS},
        {"term": "position_residual", "of": com, "axes": "xz", "target": [0.1, 0.2]},
        {"term": "velocity_residual", "of": com, "target": 0.2},
        {"term": "rotation_residual", "of": "box", "axes": "xz"},
        {"term": "angular_momentum_residual", "of": "base", "axes": "z"},
        {"term": "posture_residual"},
    ]
    r = Rollouts(*costs, terms=TERMS)
    kernels = []
    for (term, bound), size in zip(r.stack.terms, (2, 1, 2, 3, 6, 1, 3), strict=True):
        assert term.residual.dimension(bound) == size
        kernels.append(components_kernel(term))
    for i, (kernel, (term, bound)) in enumerate(zip(kernels, r.stack.terms, strict=True)):
        size = term.residual.dimension(bound)
        out = wp.zeros((size, r.t, r.w), dtype=float, device="cpu")
        wp.launch(kernel, out.shape, [r.evaluator.view, bound, r.shape.rollouts], [out], device="cpu")
        np.testing.assert_allclose(r.cost(i), 0.5 * (out.numpy().astype(float) ** 2).sum(0), rtol=1e-4, atol=1e-6)


def components_kernel(term: warpmpc.CostTerm) -> wp.Kernel:
    """A kernel that writes the numbers of a term's residual ``[n, T, W]``."""
    component, params = term.residual.component, term.params

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(view: warpmpc.StepView, p: params, rollouts: int, out: wp.array3d[float]):
        i, t, w = wp.tid()
        s = view
        s.t = t + 1
        s.w = w
        s.e = w // rollouts
        out[i, t, w] = component(s, p, i)

    return kernel


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"norm": "l3"}, r"cost\.lean\.norm"),
        ({"norm": {"kind": "cosh"}}, r"cost\.lean\.norm.*takes p"),
        ({"frame": "base/tpi"}, r"cost\.lean\.frame.*Did you mean 'base/tip'"),
        ({"gian": 1.0}, r"cost\.lean\.gian.*Did you mean 'gain'"),
        ({"nrom": "l2"}, r"cost\.lean\.nrom.*Did you mean 'norm'"),
        ({"terminl": 1.0}, r"cost\.lean\.terminl.*Did you mean 'terminal'"),
    ],
)
def test_mistakes_in_a_residuals_table_name_the_key(change, message):
    with pytest.raises(SceneError, match=message):
        Rollouts({"term": "lean", **KEYS, **change}, terms=TERMS)


def test_a_residual_says_what_it_returns_and_leaves_norm_alone():
    def untold(s: warpmpc.StepView, p: LeanParams):
        return 0.0

    def pose(s: warpmpc.StepView, p: LeanParams) -> wp.transform:
        return warpmpc.frame_pose(s, p.frame)

    def whole(s: warpmpc.StepView, p: LeanParams) -> wp.vec2i:
        return wp.vec2i(1, 2)

    for function in (untold, pose, whole):
        with pytest.raises(TypeError, match=rf"residual 'x': write def {function.__name__}\("):
            warpmpc.residual_term("x")(function)

    @wp.struct
    class NormParams:
        norm: float

    def own(s: warpmpc.StepView, p: NormParams) -> float:
        return p.norm

    with pytest.raises(TypeError, match="norm is a key of every residual"):
        warpmpc.residual_term("x")(own)
