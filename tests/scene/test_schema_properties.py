# SPDX-License-Identifier: Apache-2.0
"""Any valid scene survives its way through a file; any spoilt one is valid still or ends in a SceneError."""

import copy
import tomllib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_text import SMALL, toml, write

from warpmpc import Scene, SceneError, load_scene, shipped_scenes
from warpmpc.scene.schema import (
    Cost,
    Drive,
    DriveMode,
    EngineSettings,
    Frame,
    Goal,
    Ground,
    Kick,
    Method,
    Noise,
    NoiseShape,
    NoiseSource,
    Normal,
    Object,
    Obstacle,
    Planner,
    PlantNoise,
    PlantSettings,
    Randomization,
    Rejection,
    Risk,
    Robot,
    ShapeKind,
    SplineKind,
    Success,
    Temperature,
    Timing,
    Uniform,
)

relaxed = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])

number = st.floats(-1e6, 1e6)
positive = st.floats(1e-6, 1e6)
count = st.integers(1, 100)
vec3 = st.tuples(number, number, number)
quat = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(c * c for c in q) > 1e-3)
text = st.text(st.characters(codec="utf-8"), max_size=20)
param = st.recursive(
    st.booleans() | st.integers(-(10**9), 10**9) | number | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=5,
)
floats = st.lists(number, min_size=1, max_size=4).map(tuple)
positives = st.lists(positive, min_size=1, max_size=4).map(tuple)
SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "plane": 0, "mesh": 0}


@st.composite
def drives(draw):
    mode = draw(st.sampled_from(DriveMode))
    bounds = draw(st.sampled_from([{"limit": (1.0,)}, {"lower": (-1.0,), "upper": (2.0,)}]))
    extra = {"wheel_radius": 0.1, "track": 0.5} if mode is DriveMode.DIFF_DRIVE else {}
    joints = ("left", "right") if mode is DriveMode.DIFF_DRIVE else draw(st.none() | st.just(("a", "b", "c")))
    if mode is DriveMode.MOCAP:
        joints, extra = (
            None,
            {"body": draw(st.none() | text), "rotation": draw(st.sampled_from(["none", "yaw", "all"]))},
        )
    return Drive(
        mode=mode,
        joints=joints,
        stiffness=(draw(positive),),
        damping=(draw(positive),),
        effort_limit=draw(st.none() | positives.map(lambda p: p[:1])),
        **bounds,
        **extra,
    )


@st.composite
def robots(draw, name):
    return Robot(
        name=name,
        asset=draw(text.filter(bool)),
        position=draw(vec3),
        rotation=draw(quat),
        floating=draw(st.booleans()),
        joint_q=draw(st.none() | floats | st.dictionaries(text, number | st.tuples(*[number] * 3), max_size=3)),
        frames=draw(
            st.dictionaries(st.sampled_from(["tip", "tool", "link"]), st.builds(Frame, link=text, offset=vec3))
        ),
        drive=(draw(drives()),),
        armature=draw(st.none() | positives),
    )


@st.composite
def shapes(draw, kind, name):
    shape = draw(st.sampled_from(ShapeKind).filter(lambda s: kind is Obstacle or s is not ShapeKind.PLANE))
    count = SIZES[shape]
    return kind(
        name=name,
        shape=shape,
        size=tuple(draw(positive) for _ in range(count)) or None,
        mesh="mesh.stl" if shape is ShapeKind.MESH else None,
        friction=draw(positive),
        position=draw(vec3),
        rotation=draw(quat),
        color=draw(st.none() | st.just((0.1, 0.5, 1.0))),
        **({"mass": draw(positive)} if kind is Object else {}),
    )


@st.composite
def scenes(draw):
    steers = draw(st.sampled_from([{}, {"eta": None}, {"ess": 20.0}, {"eta": (2.0, 3.0)}]))
    noise = st.builds(
        Noise, source=st.sampled_from(NoiseSource), shape=st.sampled_from(NoiseShape), sigma=positives, comb=vec3
    )
    planner = st.builds(
        Planner,
        method=st.sampled_from(Method),
        samples=st.integers(8, 1_000),
        horizon=count,
        risk=st.sampled_from(Risk),
        knots=st.just("steps") | st.integers(2, 50),
        spline=st.sampled_from(SplineKind),
        discount=st.floats(0.1, 1.0),
        noise=noise,
        temperature=st.just(Temperature(**steers)),
    )
    goal = st.builds(Goal, object=st.just("box"), position=vec3 | st.tuples(number, number), yaw=number)
    kick = st.builds(Kick, time=st.floats(0.0, 9.0), target=st.just("box"), velocity=vec3)
    random = st.builds(
        Randomization, mass=st.none() | st.builds(Uniform, uniform=st.floats(0, 0.9)), size=st.just(Normal(normal=0.1))
    )
    costs = st.lists(
        st.tuples(text, number.map(abs), st.dictionaries(st.sampled_from("abc"), param)), min_size=1, max_size=3
    )
    return Scene(
        title=draw(text),
        timing=Timing(control_dt=draw(st.floats(1e-3, 1.0)), timeout=draw(st.floats(10.0, 100.0))),
        ground=draw(st.none() | st.builds(Ground, friction=positive, height=number)),
        robot=(draw(robots("arm")), *draw(st.sampled_from([(), (draw(robots("base")),)]))),
        object=(draw(shapes(Object, "box")),),
        obstacle=tuple(draw(shapes(Obstacle, name)) for name in draw(st.sampled_from([(), ("wall",), ("a", "b")]))),
        goal=draw(goal),
        cost=tuple(
            Cost(term=term, name=f"term_{i}", weight=weight, **params)
            for i, (term, weight, params) in enumerate(draw(costs))
        ),
        planner=draw(planner),
        engine=EngineSettings(substeps=draw(count)),
        plant=PlantSettings(noise=PlantNoise(position=draw(positive)), kicks=tuple(draw(st.lists(kick, max_size=2)))),
        randomize=draw(st.dictionaries(st.just("box"), random)),
        randomize_task={"reject": (Rejection(place="goal", clearance=draw(positive)),)},
        success=Success(position=draw(positive), yaw=draw(st.none() | positive)),
    )


@relaxed
@given(scene=scenes())
def test_a_scene_survives_its_way_through_a_file(tmp_path, scene):
    path = write(tmp_path, toml(scene.model_dump(mode="json")))
    assert load_scene(path).model_copy(update={"path": None}) == scene


LEAKS = ("Input should", "pydantic", "validation", "function-", "tuple[", "Traceback")


def accept_or_explain(load) -> None:
    """Loading gives a scene, or a SceneError in our own words."""
    try:
        told = load()
    except SceneError as error:
        told = str(error)
    assert isinstance(told, Scene | str)
    if isinstance(told, str):
        assert not [leak for leak in LEAKS if leak in told]


FILES = {"small": SMALL, **{name: path.read_text(encoding="utf-8") for name, path in shipped_scenes().items()}}
WRONG = [
    float("nan"),
    float("inf"),
    -1,
    0,
    10**400,
    True,
    False,
    "text",
    "",
    "*",
    [],
    [1, 2],
    ["a"],
    {},
    {"a": 1},
    [{}],
]


def places(data: object, at: tuple = ()) -> list[tuple]:
    """Locations of all tables' keys and lists' entries."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [place for key, value in items for place in [(*at, key), *places(value, (*at, key))]]


@settings(relaxed, max_examples=300)
@given(data=st.data(), name=st.sampled_from(sorted(FILES)))
def test_a_spoilt_scene_is_valid_still_or_ends_in_a_scene_error(tmp_path, data, name):
    scene = copy.deepcopy(tomllib.loads(FILES[name]))
    for _ in range(data.draw(st.integers(1, 3))):
        *where, last = data.draw(st.sampled_from(places(scene)))
        inner = scene
        for part in where:
            inner = inner[part]
        match data.draw(st.sampled_from(["delete", "misspell", "replace", "swap"])):
            case "delete":
                del inner[last]
            case "misspell" if isinstance(last, str):
                inner[last[:-1] + data.draw(st.sampled_from(["", "x", '"', ".", "é"]))] = inner.pop(last)
            case "swap":
                other = data.draw(st.sampled_from(list(inner) if isinstance(inner, dict) else range(len(inner))))
                inner[last] = copy.deepcopy(inner[other])
            case _:
                inner[last] = copy.deepcopy(data.draw(st.sampled_from(WRONG)))
        if not places(scene):
            break
    path = write(tmp_path, toml(scene))
    for variant in ("", ":near", ":B"):
        accept_or_explain(lambda v=variant: load_scene(f"{path}{v}"))


@settings(relaxed, max_examples=100)
@given(data=st.data(), name=st.sampled_from(sorted(FILES)))
def test_a_corrupt_file_is_valid_still_or_ends_in_a_scene_error(tmp_path, data, name):
    raw = FILES[name].encode()
    at = data.draw(st.integers(0, len(raw) - 1))
    path = tmp_path / "corrupt.toml"
    path.write_bytes(raw[:at] + data.draw(st.binary(max_size=3)) + raw[at + data.draw(st.integers(0, 4)) :])
    accept_or_explain(lambda: load_scene(path))


KEYS = [
    "planner",
    "robot.base",
    "robot.*.drive",
    "goal",
    "cost.*.weight",
    "obstacle.*.size",
    "variants",
    "a.b",
    "*",
    ".",
]
VALUES = [
    "1",
    "nan",
    "[1, 2]",
    "false",
    "word",
    "{a=1}",
    "[{}]",
    "[",
    "'",
    "1e999",
    "2000-01-01",
    "*",
    "\0",
    "9" * 5000,
]


def quotable(text: str) -> bool:
    """Whether an error may repeat a text: it has none of the words that tell a leak."""
    return not any(leak in text for leak in LEAKS)


@settings(relaxed, max_examples=200)
@given(
    key=st.sampled_from(KEYS) | st.text(max_size=10).filter(quotable),
    rest=st.sampled_from(["", ".position", ".noise.sigma", ".x.y", ".0", ".*"]),
    value=st.sampled_from(VALUES) | st.text(max_size=10).filter(quotable),
)
def test_any_override_is_taken_or_ends_in_a_scene_error(tmp_path, key, rest, value):
    path = write(tmp_path)
    accept_or_explain(lambda: load_scene(path, overrides=[f"{key}{rest}={value}"]))


@pytest.mark.parametrize("source", ["", ":", "x:y:z", "~nobody/x.toml", "a" * 5000, "\0", "/", "omni_push_box:"])
def test_any_source_is_found_or_ends_in_a_scene_error(source):
    accept_or_explain(lambda: load_scene(source))
