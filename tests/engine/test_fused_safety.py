# SPDX-License-Identifier: Apache-2.0
"""What the engine `fused` promises when things go wrong, and that its results depend on nothing they should not."""

import logging

import mujoco
import numpy as np
import pytest
import warp as wp
from fused_models import CONTACTS, compile_model, controls, starts
from native_robots import native_scene
from shared.plain_rollout import PlainRollout
from small_scenes import BOX, WALL, compiled, layout_of, make_scene, observed

import warpmpc
from warpmpc import Controller, SceneError, State
from warpmpc.engine import launched
from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.physics import source
from warpmpc.physics import unsupported as fused_missing
from warpmpc.physics.model import FIELD, PhysicsModel
from warpmpc.physics.version import VERSION
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize

PAIRS = (Pair("base", "wall"), Pair("base", "box"), Pair("box", "ground"))
NAMES = ("joint_q", "joint_qd", "body_q", "body_qd", "contact_force", "diverged", "overflow")


@pytest.fixture(scope="module")
def scene():
    """The disc touches the box already, and the box is not far from the wall."""
    near = [{**BOX, "position": (0.36, 0.0, 0.1)}]
    random = {"box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.01}}}
    return make_scene(object=near, obstacle=[WALL], randomize=random, planner={"samples": 40, "horizon": 6})


def make_simulator(scene, *, samples: int, horizon: int = 8, substeps: int = 3, envs: int = 1, pairs=PAIRS):
    return FusedPhysics(
        scene,
        compiled(scene),
        BatchSize(envs, samples, 1, horizon),
        substeps=[substeps] * horizon,
        timestep=scene.timing.control_dt / substeps,
        pairs=pairs,
        properties=draw_properties(scene, layout_of(scene), max(samples, envs), seed=3),
    )


def forward(steps: int, worlds: int, seed: int = 0) -> np.ndarray:
    """Random controls that mostly push forward, ``[T, W, 3]``."""
    rng = np.random.default_rng(seed)
    return rng.uniform([0.2, -0.5, -1.0], [1.0, 0.5, 1.0], size=(steps, worlds, 3)).astype(np.float32)


def rolled(engine: FusedPhysics, control: np.ndarray, q, qd) -> dict[str, np.ndarray]:
    engine.clone(observed(q, qd))
    engine.rollout(wp.array(control, dtype=float, device="cpu"))
    return {name: getattr(engine.trajectory, name).numpy().copy() for name in NAMES}


def assert_others_alike(a: dict, b: dict, world: int) -> None:
    """All worlds but one are the same bit for bit."""
    for name, values in a.items():
        axis = 0 if values.ndim == 1 else 1
        np.testing.assert_array_equal(np.delete(values, world, axis), np.delete(b[name], world, axis), err_msg=name)


def test_a_world_that_blows_up_is_flagged_and_disturbs_nobody(scene):
    engine, layout = make_simulator(scene, samples=20), layout_of(scene)
    q, qd = layout.joint_q, layout.joint_qd
    control = forward(8, 20)
    clean = rolled(engine, control, q, qd)
    assert not clean["diverged"].any()
    assert (np.abs(clean["contact_force"][:, :, 1]).max(axis=(0, 2)) > 0).all()  # every world pushes
    for world, name in ((3, "par"), (17, "par"), (9, "control")):
        poisoned = control.copy()
        if name == "control":
            poisoned[2:, world] = np.nan
        else:  # a mass that is no number
            engine.work.par.numpy()[0, world], kept = np.nan, engine.work.par.numpy()[0, world]
        found = rolled(engine, poisoned, q, qd)
        assert_others_alike(clean, found, world)
        assert found["diverged"].nonzero()[0].tolist() == [world]
        assert np.isfinite(found["joint_q"]).all()
        if name == "par":
            engine.work.par.numpy()[0, world] = kept
    again = rolled(engine, control, q, qd)
    for name in NAMES:
        np.testing.assert_array_equal(clean[name], again[name])


@pytest.mark.parametrize(("array", "value"), [("q", np.nan), ("q", 1e12), ("qd", np.nan), ("qd", np.inf), ("qd", 1e12)])
def test_a_bad_state_flags_its_environment_alone(scene, array, value):
    engine, layout = make_simulator(scene, samples=1, envs=20), layout_of(scene)
    q, qd = (np.tile(a, (20, 1)) for a in (layout.joint_q, layout.joint_qd))
    q[:, 1] += 0.005 * np.arange(20)
    control = forward(8, 20)
    clean = rolled(engine, control, q, qd)
    (q if array == "q" else qd)[6, 1] = value
    found = rolled(engine, control, q, qd)
    assert found["diverged"].nonzero()[0].tolist() == [6]
    assert_others_alike(clean, found, 6)


def test_neighbours_in_a_register_change_no_bit():
    model = compile_model(CONTACTS)
    worlds, steps = 64, 40
    q, v = starts(model, worlds)
    control = controls(model, steps, worlds)
    engine = PlainRollout(model, worlds, steps, lanes=4)
    ours = [a.copy() for a in engine(q, v, control)]
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(worlds)
        mixed = engine(q[order], v[order], control[:, order])
        for a, b in zip(ours, mixed, strict=True):
            np.testing.assert_array_equal(a[:, order], b)


def test_contacts_beyond_the_room_are_flagged_for_their_world_alone(monkeypatch):
    monkeypatch.setattr(source, "MOST_CONTACTS", 6)
    balls = "".join(
        f'<body pos="{i} 0 0.5"><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".1"/></body>'
        for i in range(8)
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="9 9 1"/>{balls}</worldbody></mujoco>'
    )
    worlds = 10
    q, v = np.zeros((worlds, 8)), np.zeros((worlds, 8))
    touching = np.array([0, 6, 7, 1, 8, 0, 6, 5, 8, 2])
    for row, count in zip(q, touching, strict=True):
        row[:count] = -0.41
    engine = PlainRollout(model, worlds, 1, lanes=4)
    engine(q, v, np.zeros((1, worlds, 0)))
    np.testing.assert_array_equal(engine.work.overflow.numpy() != 0, touching > 6)
    assert not engine.work.diverged.numpy().any()
    engine(0.0 * q, v, np.zeros((1, worlds, 0)))  # the next plan begins anew
    assert not engine.work.overflow.numpy().any()


def test_the_controller_tells_once_of_contacts_without_room(monkeypatch, caplog):
    monkeypatch.setattr(source, "MOST_CONTACTS", 2)  # the box alone has four on the ground
    scene = make_scene(object=[BOX], planner={"samples": 16, "horizon": 3})
    controller = Controller(scene, engine="fused", compiled=compiled(scene))
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        controller.step(State.start(controller.layout))
        controller.step(State.start(controller.layout))
    told = [record.message for record in caplog.records if "contacts" in record.message]
    (sentence,) = told
    assert sentence.startswith(f"{scene.name}: more contacts at once than the engine fused has room for: ")
    assert 'engine.name = "mujoco"' in sentence
    assert "bodies sink into each other" in sentence


def commands(scene, *, seed: int, threads: int, plans: int = 4) -> np.ndarray:
    scene = scene.model_copy(update={"engine": scene.engine.model_copy(update={"threads": threads})})
    controller = Controller(scene, engine="fused", seed=seed, compiled=compiled(scene))
    out = np.array([controller.step(State.start(controller.layout)) for _ in range(plans)])
    controller.engine.close()
    return out


def test_one_seed_gives_the_same_commands_on_any_number_of_threads(scene):
    first = commands(scene, seed=5, threads=1)
    for threads in (1, 2, 3):
        np.testing.assert_array_equal(commands(scene, seed=5, threads=threads), first)
    assert (commands(scene, seed=6, threads=1) != first).any()


@pytest.fixture
def sources(monkeypatch):
    """Sources that simulators compile."""
    written: list[str] = []
    make = launched.make_kernel

    def remember(text: str, *args, **kwargs):
        written.append(text)
        return make(text, *args, **kwargs)

    monkeypatch.setattr(launched, "make_kernel", remember)
    return written


def test_weights_goals_samples_and_horizons_do_not_compile_again(scene, sources):
    changes = (
        {},
        {"goal": {"frame": "base/centre", "position": (2.0, -0.5)}},
        {"cost": [{"term": "distance", "between": ["base/centre", "goal"], "weight": 7.0}]},
        {"planner": {"samples": 25, "horizon": 9}},
        {"planner": {"samples": 40, "horizon": 6, "noise": {"sigma": 0.1}}},
    )
    modules = set()
    for change in changes:
        near = [{**BOX, "position": (0.36, 0.0, 0.1)}]
        other = make_scene(**{"object": near, "obstacle": [WALL], "planner": {"samples": 40, "horizon": 6}, **change})
        controller = Controller(other, engine="fused", compiled=compiled(other))
        controller.step(State.start(controller.layout))
        controller.task["goal"] = [0.3, 0.2, 0.0, 0.0, 0.0, 0.0, 1.0]
        controller.step(State.start(controller.layout))
        modules.add(controller.engine._kernel.module.name)
    assert len(set(sources)) == 1
    assert len(modules) == 1


# what MJCF can bring and the engine lacks: option, joint of the body, geom, hinge, and what follows the bodies
BODY = """
<mujoco><compiler autolimits="true"/><option {option}/>{before}
<worldbody><geom type="plane" size="5 5 .1"/>{world}
  <body name="b" pos="0 0 .3">{joint}<geom name="g" type="box" size=".1 .1 .1" {geom}/><site name="s"/>
    <body name="c" pos=".3 0 0"><joint name="h" axis="0 1 0" {hinge}/><geom name="tip" type="sphere" size=".05"/></body>
  </body>
</worldbody>{end}</mujoco>
"""
FREE = '<joint name="j" type="free"/>'


def drive(text: str) -> dict:
    return {"end": f"<actuator>{text}</actuator>"}


LACKS = {
    "equalities: FLEX": {
        "world": '<flexcomp name="f" type="grid" count="2 2 1" spacing=".1 .1 .1" pos="0 0 2" radius=".01" dim="2" '
        'mass="1"><edge equality="true"/></flexcomp>'
    },
    "armatures of tendons around shapes": {
        "world": '<site name="t" pos="1 0 0"/>',
        "end": '<tendon><spatial><site site="s"/><geom geom="tip"/><site site="t"/></spatial></tendon>',
    },
    "springs that yield (springyield)": {"hinge": 'stiffness="1" springyield="1"'},
    "plugins": {
        "before": '<extension><plugin plugin="mujoco.pid"><instance name="p"/></plugin></extension>',
        **drive('<plugin joint="h" plugin="mujoco.pid" instance="p"/>'),
    },
    "flexible bodies": {
        "world": '<flexcomp name="f" type="grid" count="2 2 1" spacing=".1 .1 .1" pos="0 0 2" radius=".01" '
        'dim="2" mass="1"/>'
    },
    "velocities of surfaces (surfacevel)": {"geom": 'surfacevel="1 0 0 0 0 0"'},
    "adhesion of contacts": {"end": '<contact><pair geom1="g" geom2="tip" adhesion="1"/></contact>'},
    "transmissions of actuators: BODY": drive('<adhesion body="b" ctrlrange="0 1"/>'),
    "actuators of several controls": drive('<pid joint="h" kp="1"/>'),
    "actuators of several activations": drive('<general joint="h" dyntype="user" actdim="3"/>'),
    "activations of servoed rotations with RK4 (implicitfast mends it)": {
        "option": 'integrator="RK4"',
        "joint": '<joint name="j" type="ball"/>',
        **drive('<intvelocity joint="j" kp="1" actrange="-1 1"/>'),
    },
    "gains of actuators: USER": drive('<general joint="h" gaintype="user"/>'),
    "delays and intervals (history in the state)": drive('<motor joint="h" delay="0.02" nsample="3"/>'),
    'ellipsoid models of fluid forces (fluidshape="none" mends it)': {
        "option": 'density="1.2"',
        "geom": 'fluidshape="ellipsoid"',
    },
    "stiffness of ball and free joints that grows with the angle": {
        "joint": '<joint name="j" type="ball" stiffness="1 2 0"/>'
    },
    'noslip iterations (noslip_iterations="0" mends it)': {"option": 'noslip_iterations="3"'},
    "solvers that MuJoCo does not have": {},
    "solver PGS for elliptic cones (Newton mends it)": {"option": 'solver="PGS" cone="elliptic"'},
    "models of more than 128 degrees of freedom": {
        "world": "".join(f'<body><freejoint/><geom type="sphere" size=".1" pos="{i} 0 1"/></body>' for i in range(21))
    },
    "few solver iterations for contacts as hard as low friction, impratio or solimp make (10 mend it)": {
        "option": 'iterations="3"',
        "geom": 'priority="1" solimp="0.99 0.9999 0.001"',
    },
    "pyramids without friction at bodies that turn about their centre of mass (condim 1 mends it)": {
        "world": '<body pos="0 2 .1"><joint axis="0 1 0"/><geom size=".1" friction="0 0 0" priority="1"/></body>'
    },
    "double precision for a nearly singular mass matrix (armatures mend it)": {
        "world": '<body pos="0 2 1"><joint/><joint/><geom size=".1" pos=".3 0 0"/></body>'
    },
    "trees of more than 64 degrees of freedom in a row": {
        "world": 70 * '<body pos=".1 0 0"><joint/><geom size=".03"/>' + 70 * "</body>"
    },
}


def mjcf(**parts: str) -> str:
    nothing = dict.fromkeys(("option", "before", "world", "geom", "hinge", "end"), "")
    return BODY.format(**{**nothing, "joint": FREE, **parts})


def lacking(what: str) -> mujoco.MjModel:
    """A model with what the engine lacks."""
    if "springyield" in what and VERSION < (4, 0):
        pytest.skip("MuJoCo 4.0 has it")
    model = mujoco.MjModel.from_xml_string(mjcf(**LACKS[what]))
    if what == "solvers that MuJoCo does not have":
        model.opt.solver = 99
    if "armatures of tendons" in what:  # MuJoCo's compiler refuses it
        model.tendon_armature[:] = 1.0
    return model


FIRST = {
    "actuators of several controls": "gains of actuators: PID",
    "actuators of several activations": "dynamics of actuators: USER",
}
"""What is named in place of a check, as its kind is refused before."""


@pytest.mark.parametrize("what", sorted({*fused_missing._CHECKS, *LACKS}))
def test_what_a_model_has_and_the_engine_lacks_has_a_name(what):
    model, name = lacking(what), FIRST.get(what, what)
    assert fused_missing.missing(model) == name
    if what in fused_missing._CHECKS:
        assert fused_missing._CHECKS[what](PhysicsModel(model))
    with pytest.raises(ValueError, match="the engine fused has no ") as caught:
        PlainRollout(model, 1, 1)
    assert name in str(caught.value)
    assert name.split()[0] not in ("a", "an", "more")  # "has no a fluid" is no English


def test_a_plain_model_lacks_nothing():
    assert fused_missing.missing(mujoco.MjModel.from_xml_string(mjcf())) is None


def test_a_pair_of_shapes_without_contacts_is_named(monkeypatch):
    monkeypatch.setattr(fused_missing, "COLLIDES", fused_missing.COLLIDES - FIELD)
    asset = '<asset><hfield name="f" nrow="2" ncol="2" size="1 1 1 1"/></asset>'
    text = mjcf(before=asset, world='<geom type="hfield" hfield="f"/>')
    assert fused_missing.missing(mujoco.MjModel.from_xml_string(text)) == "contacts between hfield and sphere"


def test_auto_takes_mujoco_for_robots_that_bring_what_the_engine_lacks(tmp_path):
    what, path = "transmissions of actuators: BODY", tmp_path / "robot.xml"
    path.write_text(mjcf(**LACKS[what]).replace('<geom type="plane" size="5 5 .1"/>', ""))
    robot = {"name": "r", "asset": str(path), "floating": True}
    scene = make_scene(
        robot=[robot],
        ground=None,
        goal={"frame": "r/c", "position": (0.0, 0.0)},
        planner={"samples": 4, "horizon": 2},
        cost=[{"term": "distance", "between": ["r/c", "goal"]}],
    )
    assert Controller(scene, device="cpu", compiled=compiled(scene)).engine.name == "mujoco"
    with pytest.raises(SceneError, match=f"the engine fused has no {what}"):
        Controller(scene, engine="fused", device="cpu", compiled=compiled(scene))


@wp.struct
class SensedParams:
    tip_sensor: int


@warpmpc.cost_term("sensed")
def sensed(s: warpmpc.StepView, p: SensedParams) -> float:
    """What a sensor shows."""
    return warpmpc.sensor(s, p.tip_sensor)


SENSING = """
<mujoco><worldbody><body name="cart" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/>
  <geom type="sphere" size=".1"/><site name="tip"/></body></worldbody>
<actuator><motor name="push" joint="x" ctrlrange="-1 1"/></actuator>
<sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>
"""


def test_terms_that_read_sensors_take_another_engine_where_it_does_not_read_them(tmp_path):
    path = tmp_path / "cart.xml"
    path.write_text(SENSING.replace("<sensor>", '<sensor><clock name="time"/>'))
    scene = native_scene(path)
    for sensor, engine in (("tip", "fused"), ("time", "mujoco")):
        planner, cost = {"samples": 4, "horizon": 2}, [{"term": "sensed", "tip_sensor": f"r/{sensor}"}]
        scene = type(scene).model_validate({**scene.model_dump(), "cost": cost, "planner": planner})
        assert Controller(scene, terms=[sensed], device="cpu").engine.name == engine
    with pytest.raises(SceneError, match="the engine fused has no sensors of the kinds clock"):
        Controller(scene, terms=[sensed], engine="fused", device="cpu")
