# SPDX-License-Identifier: Apache-2.0
"""All cost terms together: labels, weights, watched pairs, and distance fields that follow their targets."""

import numpy as np
import pytest
import warp as wp
from evaluating import Evaluating
from rollouts import Rollouts
from small_scenes import BOX, WALL, layout_of, make_scene
from ways import INFLATION, around_corners

import warpmpc
from warpmpc import SceneError, Task
from warpmpc.cost.resources.guide import Guides
from warpmpc.cost.stack import CostStack
from warpmpc.cost.trial import try_terms
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.trajectory import BatchSize

SIDE = {"name": "wall", "shape": "box", "size": (0.4, 2.0, 0.5), "position": (0.0, 0.0, 0.25)}
GEODESIC = {"metric": "geodesic", "inflation": INFLATION}


class Scenery(Evaluating):
    """Two environments of one step and one sample, their bodies put in place by hand."""

    def __init__(self, *costs: dict, obstacles=(SIDE,)):
        scene = make_scene(
            object=[{**BOX, "position": (2.5, 2.5, 0.1)}],
            obstacle=list(obstacles),
            goal={"object": "box", "position": (-1.2, 0.4)},
            cost=costs,
        )
        super().__init__(scene, BatchSize(2, 1, 1, 1))
        self.trajectory.body_q.numpy()[..., 6] = 1.0
        self.goal(*[(-1.2, 0.4)] * 2)

    def goal(self, *places) -> None:
        self.set_goal(np.array([[x, y, 0.1, 0, 0, 0, 1] for x, y in places]))

    def put(self, name: str, e: int, place, slices=(0, 1)) -> None:
        """Put a frame's body somewhere."""
        body = self.layout.frame_body[self.layout.frame(name)]
        for t in slices:
            self.trajectory.body_q.numpy()[t, e, body, :2] = place

    def cost(self) -> np.ndarray:
        """Cost of each term and environment ``[term, E]``."""
        self.observe()
        return super().cost()[:, 0]

    @property
    def field(self) -> np.ndarray:
        """Distance fields ``[E, rows, columns]``."""
        return self.stack.resources.get(Guides).guide.field.numpy()


def test_labels_are_unique_and_weights_belong_to_their_terms():
    scene = Scenery(
        {"term": "height", "of": "box", "target": 1.0, "weight": 2.0},
        {"term": "height", "of": "box", "target": 3.0, "weight": 0.5},
        {"term": "height", "of": "box", "target": 1.0, "name": "lift", "weight": 0.0},
    )
    assert scene.stack.labels == ["height", "height_2", "lift"]
    np.testing.assert_allclose(scene.cost(), [[2.0, 2.0], [1.5, 1.5], [0.0, 0.0]])


@wp.struct
class BrokenParams:
    gain: float


@warpmpc.cost_term("broken")
def broken(s: warpmpc.StepView, p: BrokenParams) -> float:
    return not_there(p.gain)  # noqa: F821


@warpmpc.array_cost("raising")
def raising(batch):
    raise AssertionError("nobody asked for this")


@pytest.mark.parametrize("term", [broken, raising])
def test_a_stack_neither_compiles_nor_runs_what_users_wrote_and_their_trial_does(term):
    scene = make_scene(cost=[{"term": term.name, **({"gain": 1.0} if term is broken else {})}])
    stack = CostStack(scene, layout_of(scene), Task(scene), terms=[term])
    with pytest.raises(SceneError, match=rf"cost\.{term.name}: .*test_stack\.py"):
        try_terms(stack, scene)


def test_the_same_terms_in_another_order_are_not_mixed_up():
    """Their functions, each once, and their parameters' types are the same."""
    kinds = ["control_effort", "control_rate"]
    for order in ((0, 1, 1, 0), (0, 0, 1, 1)):
        rollouts = Rollouts(*({"term": kinds[i]} for i in order))
        found = [rollouts.cost(i) for i in range(4)]
        assert np.abs(found[order.index(0)] - found[order.index(1)]).max() > 1.0
        for cost, i in zip(found, order, strict=True):
            np.testing.assert_array_equal(cost, found[order.index(i)])


def test_terms_share_the_list_of_watched_pairs():
    both = [{**WALL, "name": name, "position": (x, 0.0, 0.2)} for name, x in (("a", -2.0), ("b", 2.0))]
    scene = Scenery(
        {"term": "contact_force", "between": ["box", "obstacles"]},
        {"term": "height", "of": "box", "target": 0.0},
        {"term": "contact_force", "between": ["base", "box"]},
        obstacles=both,
    )
    assert scene.stack.pairs == (Pair("box", "a"), Pair("box", "b"), Pair("base", "box"))
    force = np.arange(1.0, 7.0).reshape(1, 2, 3, 1) * [1.0, 0.0, 0.0]
    scene.trajectory.contact_force.assign(force.astype(np.float32))
    np.testing.assert_allclose(scene.cost()[[0, 2]], [[3.0, 9.0], [3.0, 6.0]])


def test_a_group_never_touches_itself():
    with pytest.raises(SceneError, match=r"cost\.contact_force\.between.*two different"):
        Scenery({"term": "contact_force", "between": ["box", "box"]})
    scene = Scenery({"term": "contact_force", "between": ["objects", "obstacles"]}, obstacles=())
    assert scene.stack.pairs == ()
    np.testing.assert_array_equal(scene.cost(), 0.0)


def test_geodesic_distance_is_straight_in_the_open_and_goes_around_the_wall():
    scene = Scenery({"term": "distance", "between": ["box", "goal"], **GEODESIC})
    scene.put("box", 0, (-2.0, -1.0))
    scene.put("box", 1, (1.5, 0.3))
    found = scene.cost()[0]
    assert found[0] == pytest.approx(np.hypot(0.8, 1.4), abs=0.01)
    exact = around_corners((-1.2, 0.4), (1.5, 0.3), [(-0.2, 1.0), (0.2, 1.0)], INFLATION)
    assert found[1] == pytest.approx(exact, abs=0.05)  # a cell
    assert found[1] > np.hypot(2.7, 0.1) + 0.3


def test_every_environment_has_its_own_field():
    scene = Scenery({"term": "distance", "between": ["box", "goal"], **GEODESIC})
    scene.goal((-1.2, 0.4), (1.5, 2.0))
    for e in range(2):
        scene.put("box", e, (1.5, 0.3))
    found = scene.cost()[0]
    assert found[0] > 3.0
    assert found[1] == pytest.approx(1.7, abs=0.02)


def test_a_field_follows_its_target_when_it_moves_and_only_then():
    scene = Scenery({"term": "distance", "between": ["base/centre", "box"], **GEODESIC})
    for e in range(2):
        scene.put("base/centre", e, (-1.0, 0.3))
        scene.put("box", e, (1.5, 0.3))
    behind = scene.cost()[0, 0]
    assert behind > 3.0
    before = scene.field.copy()
    scene.put("box", 0, (1.51, 0.3))
    scene.cost()
    np.testing.assert_array_equal(scene.field, before)
    scene.put("box", 0, (-2.0, 0.3))
    found = scene.cost()[0]
    assert found[0] == pytest.approx(1.0, abs=0.02)
    assert found[1] == pytest.approx(behind, abs=1e-5)
    assert not np.array_equal(scene.field[0], before[0])
    np.testing.assert_array_equal(scene.field[1], before[1])


def test_the_straight_part_counts_to_where_the_target_is_during_the_rollout():
    scene = Scenery({"term": "distance", "between": ["base/centre", "box"], **GEODESIC})
    scene.put("base/centre", 0, (1.0, 0.3))
    scene.put("box", 0, (2.0, 0.3))
    scene.put("box", 0, (2.3, 0.3), slices=[1])
    assert scene.cost()[0, 0] == pytest.approx(1.3, abs=0.02)


@pytest.mark.parametrize("place", [(40.0, 0.0), (-3.0, -25.0)])
def test_a_target_that_left_the_grid_stays_a_target(place):
    scene = Scenery({"term": "distance", "between": ["base/centre", "box"], **GEODESIC})
    for e in range(2):
        scene.put("base/centre", e, (-2.0, -2.0))
        scene.put("box", e, place)
    found = scene.cost()[0]
    assert np.isfinite(found).all()
    assert found[0] >= np.hypot(*(np.array(place) + 2.0)) - 1e-4


def test_pushing_is_aligned_with_the_way_around_not_with_the_goal_behind_the_wall():
    keys = {"term": "push_alignment", "pusher": "base/centre", "object": "box"}
    scene = Scenery({**keys, **GEODESIC}, keys)
    box = np.array([1.2, 0.5])
    # the first leg of the shortest path heads for the upper corner, up and to the left
    corner = np.array([0.2, 1.0]) - box
    d = np.linalg.norm(corner)
    leave = np.arctan2(corner[1], corner[0]) - np.arcsin(INFLATION / d)
    for e, direction in enumerate((leave, np.pi)):
        scene.put("box", e, box)
        scene.put("base/centre", e, box - 0.6 * np.array([np.cos(direction), np.sin(direction)]))
    around, straight = scene.cost()
    assert around[0] < 0.02  # behind the box as seen along the path
    assert around[1] > 0.1
    assert straight[1] < 0.02 < straight[0]


def test_every_environment_pushes_along_its_own_field():
    """The goal of one environment lies behind the wall, that of the other beside the box."""
    scene = Scenery({"term": "push_alignment", "pusher": "base/centre", "object": "box", **GEODESIC})
    box = np.array([1.2, 0.5])
    for goals in ([(-1.2, 0.4), (2.4, 0.5)], [(2.4, 0.5), (-1.2, 0.4)]):
        scene.goal(*goals)
        for e in range(2):
            scene.put("box", e, box)
            scene.put("base/centre", e, box - [0.6, 0.0])  # pushes away from the wall
        found = scene.cost()[0]
        behind = goals[0][0] > 0.0
        assert found[int(not behind)] == pytest.approx(0.0, abs=1e-3)
        assert found[int(behind)] > 1.5


def test_pushing_is_aligned_with_the_goal_where_the_way_is_free():
    keys = {"term": "push_alignment", "pusher": "base/centre", "object": "box"}
    scene = Scenery({**keys, **GEODESIC}, keys)
    for e, pusher in enumerate([(-2.4, -0.8), (-1.5, 1.0)]):
        scene.put("box", e, (-2.0, -0.4))
        scene.put("base/centre", e, pusher)
    around, straight = scene.cost()
    np.testing.assert_allclose(around, straight, atol=1e-5)


def test_reset_forgets_the_fields():
    scene = Scenery({"term": "distance", "between": ["base/centre", "box"], **GEODESIC})
    fresh = Scenery({"term": "distance", "between": ["base/centre", "box"], **GEODESIC})
    scene.put("box", 0, (1.5, 0.3))
    scene.cost()
    for s in (scene, fresh):
        s.put("box", 0, (1.52, 0.3))  # so near that the old field would stay
    scene.stack.reset()
    np.testing.assert_array_equal(scene.cost(), fresh.cost())
    np.testing.assert_array_equal(scene.field, fresh.field)
