# SPDX-License-Identifier: Apache-2.0
"""Planted mistakes: each is named by ``check``, a run's verdict or ``diagnose``, at its key and with its cure."""

from dataclasses import dataclass

import pytest
from planted import ARM, HAND, LEGS, SCENE, TWO_ARMS

from warpmpc import Controller, Plant, RunRecorder, SceneError, load_scene
from warpmpc.extras.doctor.advice import advise
from warpmpc.extras.doctor.diagnose import diagnose
from warpmpc.extras.doctor.examine import examine
from warpmpc.extras.record.replay import logged_scene
from warpmpc.loop.run.episode import Episode
from warpmpc.scene.model.compiled import compile_scene

CHECK, VERDICT, DIAGNOSE = "check", "verdict", "diagnose"


@dataclass(frozen=True)
class Mistake:
    """A mistake in a scene that is fine without it."""

    name: str
    edits: dict[str, str]
    """Replacements in the text of the scene and of its asset; of a shipped scene, values by key."""
    says: tuple[str, ...]
    """Parts of one sentence: the key, the mistake, the cure."""
    base: str = SCENE
    """The scene's text, or the name of a shipped scene."""
    asset: str = ARM
    where: str = CHECK
    denies: tuple[str, ...] = ()
    """What no sentence may say."""


TABLE = [
    Mistake("radians read as degrees", {'<compiler angle="radian"/>': ""}, ("from -1.5° to 1.5°", 'angle="radian"')),
    Mistake(
        "a full turn in radians read as degrees, for controls of a drive",
        {
            '<compiler angle="radian"/>': "",
            "-1.5 1.5": "-2.9 2.9",
            'asset = "arm.xml"': 'asset = "arm.xml"\ndrive = { mode = "position", stiffness = 50.0, damping = 5.0 }',
        },
        ("arm/shoulder, arm/elbow may turn from -2.9° to 2.9° only", 'angle="radian"'),
        denies=("limits of the controls", "planner.noise.sigma"),
    ),
    Mistake(
        "no gravity in the file of a robot",
        {'<compiler angle="radian"/>': '<compiler angle="radian"/><option gravity="0 0 0"/>'},
        ("engine.gravity: there is no gravity, as the file of arm says: box does not fall", "[0.0, 0.0, -9.81]"),
    ),
    Mistake(
        "degrees read as radians",
        {'range="-1.5 1.5" damping': 'range="-90 90" damping', 'ctrlrange="-1.5 1.5"': ""},
        ("from -90 to 90 rad", 'angle="degree"'),
    ),
    Mistake(
        "start in degrees",
        {'asset = "arm.xml"': 'asset = "arm.xml"\njoint_q = { elbow = 30.0 }'},
        ("robot.arm.joint_q", "arm/elbow starts at 30, outside its range", "in degrees?", "give joint_q"),
    ),
    Mistake(
        "servo sent degrees",
        {'ctrlrange="-2 2"': 'ctrlrange="-115 115"'},
        ("robot.arm.asset", "is one of them in degrees?", "give ctrlrange in radians"),
    ),
    Mistake(
        "few solver iterations",
        {'<compiler angle="radian"/>': '<compiler angle="radian"/><option iterations="1"/>'},
        ("engine.iterations", 'has <option iterations="1">', "set engine.iterations = 10 or more"),
    ),
    Mistake("sign of a servo's gain", {'kp="50"': 'kp="-50"'}, ("robot.arm.asset", "wrong sign", "kp and kv are pos")),
    Mistake(
        "sign of a gear",
        {'range="-2 2" damping': 'range=".1 2" damping', 'ctrlrange="-2 2"': 'ctrlrange=".1 2" gear="-1"'},
        ("robot.arm.asset", "is the sign of gear wrong?", "make gear positive"),
    ),
    Mistake(
        "sign of damping",
        {'range="-2 2" damping="1"': 'range="-2 2" damping="-1"'},
        ("robot.arm.asset", "arm/elbow has negative damping", "make damping positive"),
    ),
    Mistake(
        "link in grams",
        {'mass=".5"': 'mass="500"'},
        ("to hold the start against gravity", "check masses (kilograms)"),
    ),
    Mistake("object in grams", {"mass = 0.5": "mass = 500.0"}, ("object.box", "in grams?", "masses are in kilograms")),
    Mistake("object in tonnes", {"mass = 0.5": "mass = 0.0005"}, ("object.box", "in tonnes?", "masses are in kilo")),
    Mistake(
        "obstacle in millimetres",
        {"[0.1, 0.1, 0.6]": "[100.0, 100.0, 600.0]", "[1.0, 0.5, 0.3]": "[1000.0, 500.0, 300.0]"},
        ("the shape post of 600 m", "in millimetres?"),
    ),
    Mistake(
        "object without friction",
        {"mass = 0.5": "mass = 0.5\nfriction = 0.0"},
        ("object.box.friction", "no friction", "rubber on wood has about 0.8"),
    ),
    Mistake(
        "robot without friction",
        {'asset = "arm.xml"': 'asset = "arm.xml"\nfriction = 0.0'},
        ("robot.arm.friction", "no friction", "rubber on wood has about 0.8"),
    ),
    Mistake(
        "robot without collision shapes",
        {'contype="1" conaffinity="1"': 'contype="0" conaffinity="0"'},
        ("object.box", "no robot can touch box", "give the robot's links collision shapes"),
    ),
    Mistake(
        "object stands in an obstacle",
        {"[0.6, 0.0, 0.05]": "[1.0, 0.5, 0.05]"},
        ("object.box", "'box' and 'post' overlap", "change the position"),
    ),
    Mistake(
        "actuators are missing",
        {'<motor joint="slide" ctrlrange="-1 1"/>': ""},
        ("nothing to control", "give a robot with joints a drive"),
        asset=HAND,
    ),
    Mistake(
        "hand that a mocap body leads",
        {'["box", "goal"]': '["arm/hand", "goal"]'},
        ("cost.distance", "no control can move arm/hand: a mocap body leads it", '{ mode = "mocap", body = "lead"'),
        asset=HAND,
    ),
    Mistake(
        "root welded to the world",
        {"<freejoint/>": ""},
        ("robot.arm.floating", "2 legs stand on the ground", "set floating = true"),
        asset=LEGS,
    ),
    Mistake(
        "robot starts in the air",
        {'pos="0 0 .5"': 'pos="0 0 1.5"'},
        ("robot.arm", "falls freely from the start", "start it on the ground"),
        asset=LEGS,
    ),
    Mistake(
        "gravity points up",
        {"<worldbody>": '<option gravity="0 0 9.81"/><worldbody>'},
        ("gravity is 9.81 m/s² upwards", 'gravity="0 0 -9.81"'),
    ),
    Mistake(
        "motor without force",
        {'joint="left" ctrlrange': 'joint="left" gear="0" ctrlrange'},
        ("robot.arm.drive", "control arm/", "changes nothing", "check gear"),
        asset=LEGS,
    ),
    Mistake(
        "drive 1000 times too soft",
        {"robot.base.drive.damping": "0.6"},
        ("robot.base.drive", "of the speed it is sent", "raise damping"),
        base="omni_push_box",
    ),
    Mistake(
        "effort limit in kilonewtons",
        {"robot.base.drive.effort_limit": "0.1"},
        ("robot.base.drive", "of the speed it is sent", "effort_limit"),
        base="omni_push_box",
    ),
    Mistake(
        "goal in an obstacle",
        {"[0.9, 0.0]": "[1.0, 0.5]"},
        ("goal.position", "inside the obstacle post", "move the goal or the obstacle"),
    ),
    Mistake(
        "goal of a frame in an obstacle",
        {'object = "box"\nposition = [0.9, 0.0]': 'frame = "arm/fore"\nposition = [1.0, 0.5, 0.3]'},
        ("goal.position", "inside the obstacle post", "move the goal or the obstacle"),
    ),
    Mistake(
        "goal of a frame that is fixed to the world",
        {
            "  <worldbody>": '  <worldbody><body name="stand" pos="1 1 0"><geom size=".05"/></body>',
            'object = "box"': 'frame = "arm/stand"',
        },
        ("goal", "arm/stand is fixed to the world", "name a frame of a body with a joint"),
    ),
    Mistake(
        "object that nothing can touch is to be moved",
        {'contype="1" conaffinity="1"': 'contype="0" conaffinity="0"'},
        ("cost.distance", "no control can move box", "let something that is driven touch it"),
    ),
    Mistake(
        "object starts beside the table",
        {"timing =": "ground = false\ntiming ="},
        ("object.box", "falls, and nothing is beneath it", "start it on what carries it"),
    ),
    Mistake(
        "goal under the ground",
        {"[0.9, 0.0]": "[0.9, 0.0, -0.05]"},
        ("goal.position", "0.05 m under the ground", "raise its third number"),
    ),
    Mistake(
        "goal in centimetres",
        {"goal.position": "[50.0, -20.0, 50.0]", "randomize_task": "{}"},
        ("goal.position", "which reaches", "check units"),
        base="panda_reach",
    ),
    Mistake(
        "two robots swapped",
        {"pos_left": "1.5", "pos_right": "-1.5"},
        ("cost.left", "which reaches", "name the robot that is near"),
        base=TWO_ARMS,
    ),
    Mistake(
        "fails at the start",
        {"failure": '[{ name = "fallen", conditions = { frame = "walker/hips", above = 0.5 } }]'},
        ("failure.fallen", "holds at the start", "above"),
        base="walker",
    ),
    Mistake(
        "weight 1000 times too small",
        {"cost.distance.weight": "0.001"},
        ("cost.distance.weight", "of what tells samples apart", "raise its weight"),
        base="quadrotor",
    ),
    Mistake(
        "terms about what does not move",
        {'["arm/fore", "box"]': '["post", "box"]'},
        ("cost", "cost the same", "add a term that leads to the goal"),
    ),
    Mistake(
        "term about two places",
        {'["box", "goal"]': '["post", "goal"]'},
        ("cost.distance", "neither post nor goal is moved", "name what is to move"),
    ),
    Mistake(
        "σ 100 times too small",
        {"planner.noise.sigma": "0.003"},
        ("planner.noise.sigma", "samples hardly differ", "a quarter of each control's range"),
        base="quadrotor",
    ),
    Mistake(
        "σ far too wide",
        {"{ range = 0.2 }": "40.0"},
        ("planner.noise.sigma", "lies at a limit", "a quarter of each control's range"),
    ),
    Mistake(
        "speeds 100 times too small",
        {"robot.panda.drive.limit": "0.015", "randomize_task": "{}", "timing.timeout": "4.0"},
        ("goal.position", "panda/hand moves at most", "raise the limits of the controls"),
        base="panda_reach",
    ),
    Mistake(
        "base 100 times too slow for what it pushes",
        {"robot.base.drive.limit": "[0.008, 0.008, 0.01]"},
        ("goal", "any robot moves at most", "box is 2.", "raise the limits of the controls"),
        base="omni_push_box",
    ),
    Mistake(
        "control range ten times too small",
        {
            'ctrlrange="-2 2"': 'ctrlrange="-.2 .2"',
            "[goal]\n": '[success]\nconditions = { joint = "arm/elbow", above = 1.0 }\n\n[goal]\n',
        },
        ("success.conditions", "arm/elbow moves at most 0.2", "raise the limits of the controls"),
    ),
    Mistake(
        "joints that are stuck",
        {'damping="1"': 'damping="1e6"'},
        ("cost.near", "no sample of a plan moves arm/fore", "check damping"),
    ),
    Mistake(
        "gains that make the physics diverge",
        {'kp="100"': 'kp="1e9"', 'kp="50"': 'kp="1e9"', ' forcerange="-40 40"': "", ' forcerange="-20 20"': ""},
        ("engine.substeps", "all samples that were compared diverged", "lower gains"),
    ),
    Mistake("horizon too short", {"horizon = 20": "horizon = 2"}, ("plans look", "0.04 s ahead", "about 1 s suits")),
    Mistake(
        "discount of a second as one of a step",
        {"horizon = 20": "horizon = 20\ndiscount = 0.5"},
        ("planner.discount", "0.04 s of the 0.4 s ahead count", "set planner.discount = 1"),
    ),
    Mistake(
        "hold longer than the run", {"success.hold": "60.0"}, ("success.hold = 60", "no run can"), base="quadrotor"
    ),
    Mistake(
        "control in milliseconds",
        {"control_dt = 0.02, timeout = 2.0": "control_dt = 20.0, timeout = 2000.0"},
        ("timing.control_dt", "in millisec"),
    ),
    Mistake(
        "timeout too short",
        {"timing.timeout": "0.4", "randomize_task": "{}", "planner.samples": "64"},
        ("distance to the goal", "still coming nearer", "a longer timing.timeout"),
        base="quadrotor",
        where=VERDICT,
    ),
    Mistake(
        "temperature far too high",
        {"planner.temperature": "{ initial = 1e6, eta = false }", "timing.timeout": "0.4", "planner.samples": "32"},
        ("all samples count alike", "lower temperature.initial"),
        base="quadrotor",
        where=VERDICT,
    ),
    Mistake(
        "robot twice as heavy as its model",
        {"plant.factor.quadrotor.mass": "2", "planner.samples": "64", "timing.timeout": "1.2"},
        ("masses, friction and sizes", "plant.factor"),
        base="quadrotor",
        where=DIAGNOSE,
    ),
]


def planted(mistake: Mistake, folder):
    """The scene with the mistake in it."""
    if "\n" not in mistake.base:
        values = {"planner.refine": "false"} | mistake.edits
        return load_scene(mistake.base, overrides=[f"{key}={value}" for key, value in values.items()])
    frame = {LEGS: "arm/left", HAND: "arm/hand"}.get(mistake.asset, "arm/fore")
    texts = {"scene.toml": mistake.base.replace("arm/fore", frame), "arm.xml": mistake.asset}
    for old, new in mistake.edits.items():
        assert any(old in text for text in texts.values()), old
        texts = {name: text.replace(old, new) for name, text in texts.items()}
    for name, text in texts.items():
        (folder / name).write_text(text)
    return load_scene(folder / "scene.toml")


def checked(scene) -> list[str]:
    """All that ``check`` would say."""
    controller = Controller(scene, engine="mujoco", device="cpu")
    plant = Plant(scene, task=controller.task, seed=1)
    controller.step(plant.observe())
    return [*advise(scene, controller.compiled), *map(str, examine(controller, plant.monitor))]


def run_verdict(scene) -> tuple[str, ...]:
    """The verdict on a run."""
    return Episode(scene, engine="mujoco", device="cpu").run().verdict


def diagnosed(scene) -> list[str]:
    """The sentence of ``diagnose`` about a run."""
    episode = Episode(scene, engine="mujoco", device="cpu")
    recorder = RunRecorder(episode.plant, episode.controller)
    episode.run(recorder=recorder)
    logged = logged_scene(recorder.run_log)
    found, _ = diagnose(recorder.run_log, logged, compile_scene(logged))
    return [f"{found.cause}: {found.sentence}"]


@pytest.mark.parametrize("mistake", TABLE, ids=[mistake.name for mistake in TABLE])
def test_a_planted_mistake_is_named_with_its_cure(tmp_path, mistake):
    try:
        scene = planted(mistake, tmp_path)
        sentences = {CHECK: checked, VERDICT: run_verdict, DIAGNOSE: diagnosed}[mistake.where](scene)
    except SceneError as error:
        sentences = [str(error)]
    assert any(all(part in sentence for part in mistake.says) for sentence in sentences), sentences
    assert not [sentence for sentence in sentences if any(part in sentence for part in mistake.denies)]


LED = {
    'asset = "arm.xml"': 'asset = "arm.xml"\ndrive = { mode = "mocap", limit = 0.5 }',
    '["box", "goal"]': '["arm/hand", "goal"]',
}
"""A hand that controls lead by its mocap body."""


@pytest.mark.parametrize(
    ("base", "asset", "edits"),
    [
        (SCENE, ARM, {}),
        (SCENE, LEGS, {}),
        (SCENE, HAND, LED),
        (TWO_ARMS, ARM, {"pos_left": "-1.5", "pos_right": "1.5"}),
    ],
    ids=["arm", "legs", "hand", "two arms"],
)
def test_without_a_mistake_nothing_is_named(tmp_path, base, asset, edits):
    assert checked(planted(Mistake("", edits, (), base, asset), tmp_path)) == []
