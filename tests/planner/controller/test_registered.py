# SPDX-License-Identifier: Apache-2.0
"""Engines, strategies and terms that a program registers or an installed package brings work in scene files."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from scene_text import toml
from small_scenes import DISC

import warpmpc
from warpmpc import SceneError
from warpmpc.engine.evaluation import SimulatorEngine
from warpmpc.engine.protocol import OnePart
from warpmpc.engine.registry import EngineEntry, register
from warpmpc.planner.strategy import SamplingStrategy
from warpmpc.scene.model.trajectory import Trajectory
from warpmpc.scene.registry import ENGINES, STRATEGIES, TERMS, Registry


class Gliding(OnePart):
    """A simulator without physics: joints move as fast as their controls say."""

    name, device = "gliding", "cpu"

    def __init__(self, request, steps):
        self.shape, self._costs, self._dt = request.shape, request.costs, request.grid.dt
        self.trajectory = Trajectory.allocate(self.shape, request.costs.layout, 0, "cpu")

    def clone(self, state, first=0, count=None):
        self.trajectory.joint_q.numpy()[0] = np.repeat(state.joint_q.numpy(), self.shape.rollouts, axis=0)

    def rollout(self, control):
        out = self.trajectory
        q, speed = out.joint_q.numpy(), control.numpy()
        out.joint_qd.numpy()[1:] = speed
        for t, dt in enumerate(self._dt):
            q[t + 1] = q[t] + dt * speed[t]
        self._costs.kinematics(out.joint_q, out.joint_qd, out.body_q, out.body_qd)

    def overflow_message(self, bits):
        return ""

    def close(self):
        pass


def make_gliding(request, steps):
    return SimulatorEngine(request, steps, Gliding)


class BestThree:
    """Three samples carry all weight, the same each."""

    adapts_sigma = False

    def __init__(self, planner):
        pass

    def launch(self, state):
        state.launch(weigh_three_kernel, state.cost.shape[0], [state.cost], [state.weight, state.eta])


@wp.kernel
def weigh_three_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    # outputs
    weight: wp.array2d[float],  # [E, S]
    eta: wp.array[float],  # [E]
):
    """One thread: one environment."""
    e = wp.tid()
    for s in range(cost.shape[1]):
        better = wp.float32(0.0)
        for other in range(cost.shape[1]):
            if cost[e, other] < cost[e, s] or (cost[e, other] == cost[e, s] and other < s):
                better += 1.0
        weight[e, s] = wp.where(better < 3.0, 1.0 / 3.0, 0.0)
    eta[e] = 3.0


best_three = partial(SamplingStrategy, weighting=BestThree)


@pytest.fixture
def registered():
    """The engine and the strategy of this file, for a while."""
    register(EngineEntry(name="gliding", make=make_gliding, any_dt=True))
    STRATEGIES.register("best_three", best_three)
    yield
    del ENGINES["gliding"], STRATEGIES["best_three"]


def scene_file(tmp_path, *, engine="auto", method="mppi", term="distance"):
    """A scene file of the disc that drives to (1, 0.5)."""
    keys = {"between": ["base/centre", "goal"]}
    scene = {
        "timing": {"control_dt": 0.04, "timeout": 4.0},
        "robot": [DISC],
        "goal": {"frame": "base/centre", "position": [1.0, 0.5]},
        "cost": [{"term": term, **keys}],
        "engine": {"name": engine},
        "planner": {"method": method, "samples": 32, "horizon": 6},
        "success": {"distance": 0.1},
    }
    path = tmp_path / "disc.toml"
    path.write_text(toml(scene))
    return path


@pytest.mark.usefixtures("registered")
def test_a_registered_engine_and_strategy_drive_to_the_goal_of_a_scene_file(tmp_path):
    scene = warpmpc.load_scene(scene_file(tmp_path, engine="gliding", method="best_three"))
    controller = warpmpc.Controller(scene)
    assert isinstance(controller.engine.simulator, Gliding)
    assert isinstance(controller.plan_step.strategy.weighting, BestThree)
    plant = warpmpc.Plant(scene, task=controller.task)
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
        assert controller.info.eta == 3.0
    assert plant.reason == "goal reached"


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("method", ["ilqg", "gradient_descent"])
def test_a_planner_with_derivatives_drives_to_the_goal_on_a_registered_engine(tmp_path, method):
    scene = warpmpc.load_scene(scene_file(tmp_path, engine="gliding", method=method))
    controller = warpmpc.Controller(scene)
    linear = controller.plan_step.refiner.differences
    assert isinstance(linear.worlds._simulator, Gliding)
    plant = warpmpc.Plant(scene, task=controller.task)
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"


class Silent:
    """An engine that says nothing about derivatives."""

    name = "silent"

    def __init__(self, request, steps):
        self.cost = wp.zeros((1, request.shape.samples), dtype=float, device="cpu")

    def close(self):
        pass


def test_an_engine_without_derivatives_is_told_with_the_cure(tmp_path, monkeypatch):
    monkeypatch.setitem(ENGINES, "silent", EngineEntry(name="silent", make=Silent))
    scene = warpmpc.load_scene(scene_file(tmp_path, engine="silent", method="ilqg"))
    wanted = "no derivatives of the engine silent: its class Silent has no step_worlds .* take another engine"
    with pytest.raises(SceneError, match=wanted) as caught:
        warpmpc.Controller(scene)
    assert caught.value.key == "engine.name"


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("key", "name"), [("engine", "glidin"), ("method", "best_thre")])
def test_a_name_that_there_is_not_is_told_with_those_that_there_are(tmp_path, key, name):
    with pytest.raises(SceneError) as caught:
        warpmpc.load_scene(scene_file(tmp_path, **{key: name}))
    assert caught.value.key == {"engine": "engine.name", "method": "planner.method"}[key]
    assert {"engine": "gliding", "method": "best_three"}[key] in caught.value.allowed
    assert {"engine": "fused", "method": "cem"}[key] in caught.value.allowed


class NoPlanner(BestThree):
    def __init__(self):
        pass


class NoSigma:
    def __init__(self, planner):
        pass

    launch = BestThree.launch


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            partial(SamplingStrategy, weighting=NoPlanner),
            r"NoPlanner cannot be used \(too many.*__init__\(self, planner\)",
        ),
        (partial(SamplingStrategy, weighting=NoSigma), r"NoSigma cannot be used \(no adapts_sigma\): .*state\.eta"),
        (BestThree, r"BestThree cannot be used .*partial\(SamplingStrategy, weighting=Class\)"),
        (lambda *plan, seed: object(), r"cannot be used \(no population, .*made from \(scene, layout"),
    ],
)
def test_a_strategy_that_cannot_be_used_says_what_it_needs(tmp_path, monkeypatch, make, says):
    monkeypatch.setitem(STRATEGIES, "wrong", make)
    with pytest.raises(SceneError, match=says) as caught:
        warpmpc.Controller(warpmpc.load_scene(scene_file(tmp_path, method="wrong")))
    assert caught.value.key == "planner.method"


PACKAGE = """
from warpmpc.cost.terms import TERMS
from warpmpc.planner.strategy import SamplingStrategy
near = TERMS["distance"]
class Packaged(SamplingStrategy):
    pass
"""
POINTS = """
[warpmpc.strategies]
packaged = bringing:Packaged
broken = bringing:nothing
[warpmpc.terms]
near = bringing:near
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package with entry points."""
    (tmp_path / "bringing.py").write_text(PACKAGE)
    folder = tmp_path / "bringing-1.0.dist-info"
    folder.mkdir()
    (folder / "entry_points.txt").write_text(POINTS)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: bringing\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    for registry in (STRATEGIES, TERMS):
        fresh = Registry(registry._kind, registry._group)
        monkeypatch.setattr(registry, "_points", fresh._points)
        monkeypatch.setattr(registry, "_known", dict(registry._known))


@pytest.mark.usefixtures("package")
def test_entry_points_of_an_installed_package_are_known_by_name(tmp_path):
    scene = warpmpc.load_scene(scene_file(tmp_path, method="packaged", term="near"))
    controller = warpmpc.Controller(scene, device="cpu")
    assert type(controller.plan_step.strategy).__name__ == "Packaged"
    controller.step(warpmpc.State.start(controller.layout))
    assert controller.info.terms["near"] > 0.0
    assert set(STRATEGIES) >= {"mppi", "packaged", "broken"}


@pytest.mark.usefixtures("package")
def test_an_entry_point_that_cannot_be_loaded_names_its_package(tmp_path):
    scene = warpmpc.load_scene(scene_file(tmp_path, method="broken"))
    with pytest.raises(
        ValueError, match=r"the strategy 'broken' \(bringing:nothing\) cannot be loaded: AttributeError"
    ):
        warpmpc.Controller(scene, device="cpu")
