# SPDX-License-Identifier: Apache-2.0
"""Mistakes in users' terms are found before any plan, and named with the line of the user's file."""

import inspect
import logging

import numpy as np
import pytest
import warp as wp
from evaluating import Evaluating
from small_scenes import compiled, make_scene

import warpmpc
from warpmpc import SceneError, State
from warpmpc.scene.model.trajectory import BatchSize


@wp.struct
class Params:
    gain: float
    count: int


@warpmpc.cost_term("mixed")
def mixed(s: warpmpc.StepView, p: Params) -> float:
    return p.gain * p.count  # here


@warpmpc.cost_term("vector")
def vector(s: warpmpc.StepView, p: Params) -> float:
    return wp.vec3(p.gain, 0.0, 0.0)  # here


@warpmpc.cost_term("plain_vector")
def plain_vector(s: warpmpc.StepView, p: Params):
    return wp.vec3(p.gain, 0.0, 0.0)


@warpmpc.cost_term("nothing")
def nothing(s: warpmpc.StepView, p: Params) -> float:
    p.gain * 2.0


@warpmpc.cost_term("sometimes")
def sometimes(s: warpmpc.StepView, p: Params) -> float:
    if p.gain > 0.0:
        return 1.0


@warpmpc.cost_term("unknown")
def unknown(s: warpmpc.StepView, p: Params) -> float:
    return not_there(s)  # noqa: F821  here


@warpmpc.cost_term("before")
def before(s: warpmpc.StepView, p: Params) -> float:
    earlier = warpmpc.step_before(s)
    return warpmpc.joint_position(earlier, 0) + warpmpc.joint_velocity(s, p.count)


@warpmpc.cost_term("root")
def root(s: warpmpc.StepView, p: Params) -> float:
    return wp.sqrt(-p.gain)


def raising(batch):
    return batch["joint_q"][1:, :, 77]  # here


def term(name: str, **keys):
    return {"term": name, "gain": 1.0, "count": 2, **keys}


def tried(own, **keys) -> Evaluating:
    cost = term(own.name, **keys) if isinstance(own, warpmpc.CostTerm) else {"term": own.name, **keys}
    return Evaluating(make_scene(cost=[cost]), BatchSize(1, 4, 1, 3), terms=[own])


def line(function, marker: str) -> int:
    """Line of this file in a function, that of a comment or else its first."""
    lines, first = inspect.getsourcelines(function)
    return first + next((i for i, text in enumerate(lines) if marker and text.rstrip().endswith(marker)), 0)


@pytest.mark.parametrize(
    ("own", "marker", "says"),
    [
        (mixed, "here", "float32.*int32"),
        (vector, "here", "annotated as `float`"),
        (plain_vector, "", "returns one float"),
        (nothing, "", "without returning"),
        (sometimes, "", "without returning"),
        (unknown, "here", "undefined symbol: not_there"),
        (root, "", "NaN at the start"),
    ],
    ids=lambda value: value.name if isinstance(value, warpmpc.CostTerm) else None,
)
def test_a_mistake_is_one_line_that_names_file_and_line(own, marker, says, capfd):
    where = rf"cost\.{own.name}: .*test_terms_tried\.py:{line(own.function.func, marker)}: .*{says}"
    with pytest.raises(SceneError, match=where) as raised:
        tried(own)
    assert "\n" not in str(raised.value)
    assert "error" not in capfd.readouterr().err  # no compiler has its say


def test_of_several_terms_the_wrong_one_is_named():
    scene = make_scene(cost=[term("before"), {**term("mixed"), "name": "second"}])
    with pytest.raises(SceneError, match=rf"cost\.second: .*:{line(mixed.function.func, 'here')}: Warp cannot compile"):
        Evaluating(scene, BatchSize(1, 4, 1, 3), terms=[before, mixed])


def test_what_is_right_passes():
    tried(before)


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        (None, "returned NoneType"),
        ([[0.0] * 4] * 2, "returned list"),
        (np.zeros(3), r"wrong shape, \(3,\)"),
        (np.full((2, 4), "x"), "real numbers"),
        (np.full((2, 4), np.nan), "NaN at the start"),
        (np.full((2, 4), np.inf), "infinite at the start"),
    ],
    ids=["None", "list", "shape", "text", "nan", "inf"],
)
def test_what_an_array_cost_returns_is_looked_at(returned, says):
    def given(batch):
        return returned

    where = rf"cost\.given: .*test_terms_tried\.py:{line(given, '')}: .*{says}"
    with pytest.raises(SceneError, match=where):
        tried(warpmpc.array_cost("given")(given))


def test_an_exception_in_an_array_cost_names_its_line():
    where = rf"cost\.raising: .*test_terms_tried\.py:{line(raising, 'here')}: IndexError"
    with pytest.raises(SceneError, match=where):
        tried(warpmpc.array_cost("raising")(raising))


def test_a_name_of_a_built_in_term_is_taken():
    own = warpmpc.array_cost("distance")(raising)
    with pytest.raises(SceneError, match=r"test_terms_tried\.py:\d+: there is a built-in cost term of this name"):
        Evaluating(make_scene(), BatchSize(1, 4, 1, 3), terms=[own])


def test_who_asks_for_an_unknown_term_hears_of_their_own():
    with pytest.raises(SceneError, match=r"cost\.mine\.term: no such cost term.*--terms FILE\.py"):
        Evaluating(make_scene(cost=[{"term": "mine"}]), BatchSize(1, 4, 1, 3))


@pytest.mark.parametrize("engine", ["mujoco", "kinematic"])
def test_costs_that_are_not_finite_are_not_called_diverged_physics(engine, caplog):
    calls = []

    def later(batch):
        calls.append(0)
        cost = np.zeros(batch["control"].shape[:2])
        return cost if len(calls) < 2 else cost + np.nan

    drive = {"mode": "acceleration", "damping": 300.0, "effort_limit": 200.0, "limit": (1.0, 1.0, 1.0)}
    robot = make_scene().robot[0].model_dump(exclude_none=True) | {"drive": [drive]}
    scene = make_scene(robot=[robot], cost=[{"term": "later"}], engine={"threads": 1})
    mpc = warpmpc.Controller(scene, engine=engine, terms=[warpmpc.array_cost("later")(later)], compiled=compiled(scene))
    layout = mpc.layout
    with caplog.at_level(logging.WARNING, "warpmpc"):
        mpc.step(State(layout.joint_q, layout.joint_qd, time=0.0))
    assert "no rollout has a finite cost: see the cost term later" in caplog.text
    assert "diverged" not in caplog.text
    assert mpc.info.fallback
