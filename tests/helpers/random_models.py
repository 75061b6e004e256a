# SPDX-License-Identifier: Apache-2.0
"""Random small MuJoCo models: trees, joints, shapes, drives, contacts, friction of joints, equalities, tendons."""

from hypothesis import strategies as st

numbers = st.integers(-8, 8).map(lambda n: n / 10)
sizes = st.integers(4, 14).map(lambda n: n / 100)


def row(values) -> str:
    return " ".join(f"{x:g}" for x in values)


@st.composite
def directions(draw) -> str:
    axis = draw(st.tuples(numbers, numbers, numbers))
    return row(axis if any(axis) else (0, 0, 1))


@st.composite
def turns(draw) -> str:
    return row((1.0, *draw(st.tuples(numbers, numbers, numbers))))


def some(draw, name: str, values) -> str:
    """An attribute, or nothing."""
    return f'{name}="{draw(values)}" ' if draw(st.booleans()) else ""


@st.composite
def geoms(draw) -> str:
    kind = draw(st.sampled_from(["sphere", "capsule", "box", "cylinder", "ellipsoid"]))
    size = row(draw(st.tuples(sizes, sizes, sizes)))
    # what MuJoCo itself finds by iteration meets the floor alone
    meets = 'contype="0" conaffinity="2" ' if kind in ("cylinder", "ellipsoid") else 'contype="1" conaffinity="3" '
    soft = some(draw, "solref", st.sampled_from(["0.01 1", "0.03 0.7", "-900 -25"]))
    soft += some(draw, "solimp", st.sampled_from(["0.8 0.95 0.01 0.4 2", "0.3 0.99 0.003 0.5 2"]))
    soft += some(draw, "friction", st.sampled_from(["0.1", "0.6 0.02 0.01", "1.4 0.3 0.001"])) + some(
        draw, "condim", st.sampled_from([1, 3, 4, 6])
    )
    soft += some(draw, "priority", st.sampled_from([0, 1])) + some(draw, "solmix", st.sampled_from([0.3, 2.0]))
    soft += some(draw, "margin", st.sampled_from([0.003, 0.01])) + some(draw, "gap", st.sampled_from([0.01]))
    place = f'pos="{row(x / 10 for x in draw(st.tuples(numbers, numbers, numbers)))}" quat="{draw(turns())}" '
    return f'<geom type="{kind}" size="{size}" mass="{draw(st.sampled_from([0.3, 1.0, 3.0]))}" {meets}{soft}{place}/>'


@st.composite
def joints(draw, name: str, kinds) -> tuple[str, list[str]]:
    """A joint, and the actuators that drive it."""
    kind = draw(st.sampled_from(kinds))
    if kind == "free":
        return "<freejoint/>" if draw(st.booleans()) else '<joint type="free" damping="0.1" armature="0.01"/>', []
    text = f'type="{kind}" name="{name}" pos="{row(x / 10 for x in draw(st.tuples(numbers, numbers, numbers)))}" '
    text += some(draw, "damping", st.sampled_from([0.05, 0.5])) + f'armature="{draw(st.sampled_from([0.005, 0.05]))}" '
    text += some(draw, "frictionloss", st.sampled_from([0.02, 0.3]))
    if kind == "ball":
        text += some(draw, "range", st.sampled_from(["0 0.3", "0 1"])) + some(draw, "stiffness", st.sampled_from([0.5]))
        return f"<joint {text}/>", [f'<motor joint="{name}" gear="0.2 -0.1 0.3"/>'] if draw(st.booleans()) else []
    text += f'axis="{draw(directions())}" ' + some(draw, "range", st.sampled_from(["-0.3 0.4", "0 0.8"]))
    text += some(draw, "stiffness", st.sampled_from([1.0, 15.0]))
    text += some(draw, "springref", st.sampled_from([-0.2, 0.3]))
    text += some(draw, "ref", st.sampled_from([0.1])) + some(draw, "actuatorfrcrange", st.sampled_from(["-1 2"]))
    text += some(draw, "solreflimit", st.sampled_from(["0.05 0.8", "-500 -30"]))
    drives = draw(
        st.lists(
            st.sampled_from(
                [
                    f'<motor joint="{name}" gear="1.5"/>',
                    f'<position joint="{name}" kp="20" kv="1" ctrlrange="-0.5 0.5"/>',
                    f'<velocity joint="{name}" kv="2" forcerange="-2 2"/>',
                    f'<general joint="{name}" gaintype="affine" gainprm="1 0.5 -0.2" '
                    'biastype="affine" biasprm="0.3 -2 -0.3"/>',
                    f'<general joint="{name}" dyntype="filter" dynprm="0.02" gainprm="2"/>',
                    f'<general joint="{name}" dyntype="filterexact" dynprm="0.03" actearly="true" '
                    'actrange="-0.2 0.3"/>',
                    f'<intvelocity joint="{name}" kp="5" kv="0.2" actrange="-0.1 0.2"/>',
                ]
            ),
            max_size=2,
        )
    )
    return f"<joint {text}/>", drives


@st.composite
def links(draw, joints: list[str], bodies: list[str]) -> str:
    """Tendons and equalities between slides and hinges, and between bodies and the world or one another.

    Args:
        joints: Names of slides and hinges.
        bodies: Names of bodies, each with a site of its name.
    """
    tendons, equalities = [], []
    soft = some(draw, "solref", st.sampled_from(["0.05 1", "-300 -20"]))
    soft += some(draw, "solimp", st.sampled_from(["0.5 0.9 0.3 0.5 2", "0.8 0.95 0.1 0.4 3"]))
    if joints and draw(st.booleans()):
        chosen = draw(st.lists(st.sampled_from(joints), min_size=1, max_size=3, unique=True))
        parts = "".join(f'<joint joint="{j}" coef="{draw(st.sampled_from([-0.7, 0.4, 1.2]))}"/>' for j in chosen)
        more = some(draw, "damping", st.just(0.3)) + some(draw, "stiffness", st.just(2))
        more += some(draw, "range", st.just("-0.1 0.1")) + some(draw, "frictionloss", st.just(0.1))
        tendons.append(f'<fixed name="t" {more}>{parts}</fixed>')
        if draw(st.booleans()):
            equalities.append(f'<tendon tendon1="t" polycoef="0.05 0 0 0 0" {soft}/>')
    if len(bodies) > 1 and draw(st.booleans()):
        a, b = draw(st.sampled_from(bodies)), draw(st.sampled_from(["anchor", *bodies]))
        if a != b:
            more = some(draw, "damping", st.just(0.2)) + some(draw, "range", st.just("0 0.2"))
            ends = f'<site site="{a}"/><site site="{b}"/>'
            tendons.append(f'<spatial {more}stiffness="5" springlength="0.1">{ends}</spatial>')
    if len(joints) > 1 and draw(st.booleans()):
        a, b = draw(st.permutations(joints))[:2]
        equalities.append(f'<joint joint1="{a}" joint2="{b}" polycoef="0.05 0.6 0.2 0 0" {soft}/>')
    if draw(st.booleans()):
        kind, body = draw(st.sampled_from(["connect", "weld"])), draw(st.sampled_from(bodies))
        anchor = f'anchor="{row(draw(st.tuples(*[st.sampled_from([0.0, 0.1, -0.05])] * 3)))}"'
        equalities.append(f'<{kind} body1="{body}" {anchor} {soft}/>')
    return f"<tendon>{''.join(tendons)}</tendon><equality>{''.join(equalities)}</equality>"


BLOCK = '<body pos="0.3 0 0.1" quat="0.9 0 0.1 0.2"><geom type="box" size=".15 .1 .1"/></body>'


@st.composite
def models(draw) -> str:
    """MJCF of one or two trees of one to three bodies over a floor, maybe a block beside them that stands still."""
    actuators: list[str] = []
    names: list[str] = []
    bodies: list[str] = []
    count = 0

    def body(depth: int) -> str:
        nonlocal count
        count += 1
        name, parts = f"j{count}", []
        kinds = ["hinge", "slide", "ball", *(["free", "free"] if depth == 0 else [])]
        text, drives = draw(joints(name, kinds))
        parts.append(text)
        actuators.extend(drives)
        bodies.append(f"b{count}")
        parts.append(f'<site name="b{count}" pos="0.05 0 0.02"/>')
        if "hinge" in text or "slide" in text:
            names.append(name)
        if "hinge" in text and draw(st.booleans()):  # two on one body
            text, drives = draw(joints(f"{name}b", ["hinge"]))
            parts.append(text)
            actuators.extend(drives)
        parts += [draw(geoms()) for _ in range(draw(st.integers(1, 2)))]
        if depth < 2:
            parts += [body(depth + 1) for _ in range(draw(st.integers(0, 2 if depth == 0 else 1)))]
        x, y, z = draw(st.tuples(numbers, numbers, st.integers(2, 5)))
        place = (x / 2, y / 2, z / 20) if depth == 0 else (x / 2, y / 2, (z - 3) / 10)
        comp = some(draw, "gravcomp", st.sampled_from([0.5, 1.0]))
        return f'<body name="b{name[1:]}" pos="{row(place)}" quat="{draw(turns())}" {comp}>{"".join(parts)}</body>'

    trees = "".join(body(0) for _ in range(draw(st.integers(1, 2))))
    block = draw(st.sampled_from(["", BLOCK]))
    integrator = draw(st.sampled_from(["Euler", "implicitfast", "implicit", "RK4"]))
    cone = draw(st.sampled_from(['cone="pyramidal"', 'cone="elliptic"', 'cone="elliptic" impratio="4"']))
    gravity = draw(st.sampled_from(["0 0 -9.81", "1 0 -9", "0 0 0"]))
    return (
        f'<mujoco><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="0.004" iterations="100" tolerance="1e-8" integrator="{integrator}" gravity="{gravity}" '
        f"{cone}/>"
        f'<worldbody><geom type="plane" size="5 5 .1" contype="2"/>{block}{trees}'
        f'<site name="anchor" pos="0 0 0.4"/></worldbody>'
        f"<actuator>{''.join(actuators)}</actuator>{draw(links(names, bodies))}</mujoco>"
    )
