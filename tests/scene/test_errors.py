# SPDX-License-Identifier: Apache-2.0
"""Every mistake in a scene ends in one message that says where, what was found, what is allowed."""

import pickle

import pytest
from scene_text import SMALL, write

from warpmpc import SceneError, load_scene
from warpmpc.scene.load import variants


def spoil(tmp_path, old: str, new: str) -> SceneError:
    """The error of the small scene after one replacement in its text."""
    assert old in SMALL
    path = write(tmp_path, SMALL.replace(old, new, 1))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert caught.value.file == path or str(caught.value.file).startswith(f"{path}:")
    assert str(caught.value).startswith(str(path))
    return caught.value


def set_to(tmp_path, override: str) -> SceneError:
    """The error of the small scene under one override."""
    with pytest.raises(SceneError) as caught:
        load_scene(write(tmp_path), overrides=[override])
    return caught.value


PHASE = '[[phase]]\nname = "a"\nafter = 1.0\nweight = { distance = -2.0 }\n[planner]'


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        # unknown keys
        ("samples = 64", "sampels = 64", "planner.sampels", ["unknown key", "horizon", "Did you mean 'samples'?"]),
        ("mass = 1.0", "mas = 1.0", "object.box.mas", ["unknown key", "Did you mean 'mass'?"]),
        ("samples = 64", "horizo = 64", "planner.horizo", ["'horizon'? (", "teps"]),
        ("[planner]", "[planer]", "planer", ["unknown key", "Did you mean 'planner'?", "variants"]),
        ("[variants.near]", "[variant.near]", "variant", ["this key cannot be set"]),
        ('{ link = "base_link" }', '{ lnk = "base_link" }', "robot.base.frames.tip.lnk", ["Did you mean 'link'?"]),
        ("damping = 600.0, ", "armature = 0.1, ", "robot.base.drive.armature", ["it belongs to robot.base: write"]),
        ('"base_link" }', '"base_link", armature = 1 }', "robot.base.frames.tip.armature", ["to robot.base: write"]),
        ("[planner]", "[randomize.box]\ntiming = 2\n[planner]", "randomize.box.timing", ["belongs to the file"]),
        ("[planner]", '[planner]\npath = "x"', "planner.path", ["unknown key; found 'path'"]),
        ("[planner]", "[planner]\nobject = 3", "planner.object", ["unknown key here, it belongs to the file"]),
        # missing keys
        ("mass = 1.0", "", "object.box.mass", ["this key is missing"]),
        # choices
        ('shape = "sphere"', 'shape = "Spere"', "obstacle.ball.shape", ["found 'Spere'", "cylinder", "'sphere'?"]),
        # types
        ("[planner]", "[planner]\nmethod = []", "planner.method", ["no such choice", "found []"]),
        ("mass = 1.0", 'mass = "1.0"', "object.box.mass", ["must be a number", "found '1.0'"]),
        ("mass = 1.0", "mass = true", "object.box.mass", ["must be a number", "found true"]),
        ("mass = 1.0", "mass = [1.0]", "object.box.mass", ["must be a number", "found [1.0]"]),
        ("mass = 1.0", "mass = { kg = 1.0 }", "object.box.mass", ["must be a number, not a table"]),
        ("samples = 64", "samples = 64.0", "planner.samples", ["must be a whole number", "found 64.0"]),
        ("samples = 64", "samples = true", "planner.samples", ["must be a whole number", "found true"]),
        ('object = "box"', "object = 3", "goal.object", ["must be text in quotes", "found 3"]),
        ("size = 0.2", 'size = "0.2"', "obstacle.ball.size", ["must be a number or a list of numbers", "'0.2'"]),
        ("position = [2.0, 0.0]", "position = 2.0", "goal.position", ["must be a list of numbers", "found 2.0"]),
        ("drive = {", 'floating = "yes"\ndrive = {', "robot.base.floating", ["must be true or false", "found 'yes'"]),
        # values
        ("mass = 1.0", "mass = -1.0", "object.box.mass", ["must be above 0", "found -1.0"]),
        ("mass = 1.0", "mass = nan", "object.box.mass", ["must be finite", "found nan"]),
        ("mass = 1.0", "mass = inf", "object.box.mass", ["must be finite", "found inf"]),
        ('term = "distance"', 'term = "distance"\nweight = -1.0', "cost.distance.weight", ["must be at least 0"]),
        ("[planner]", PHASE, "phase.a.weight.distance", ["must be at least 0", "found -2.0"]),
        ("horizon = 16", "horizon = 0", "planner.horizon", ["must be at least 1", "found 0"]),
        ("samples = 64", "discount = 1.5", "planner.discount", ["must be at most 1", "found 1.5"]),
        ("samples = 64", "samples = 5000000000", "planner.samples", ["must be at most 2147483647"]),
        ("limit = [0.8, 0.8, 1.0]", "limit = [0.8, -0.8, 1.0]", "robot.base.drive.limit", ["value 2", "found -0.8"]),
        ("limit = [0.8, 0.8, 1.0]", "limit = -1", "robot.base.drive.limit", ["must be above 0", "found -1"]),
        ("[0.0, 0.0, 0.0]", "[0.0, inf, 0.0]", "robot.base.joint_q", ["value 2 must be finite", "found inf"]),
        ("[0.0, 0.0, 0.0]", '{ yaw = "x" }', "robot.base.joint_q.yaw", ["must be a number", "found 'x'"]),
        ('between = ["base/tip"', 'gain = nan\nbetween = ["base/tip"', "cost.distance.gain", ["finite", "found nan"]),
        ('between = ["base/tip"', 'gain = [{ a = [-inf] }]\nbetween = ["base/tip"', "cost.distance.gain", ["finite"]),
        ('between = ["base/tip"', 'gain = 1979-05-27\nbetween = ["base/tip"', "cost.distance.gain", ["not date"]),
        ('name = "ball"', 'name = "my ball"', "obstacle.my ball.name", ["letters, digits", "found 'my ball'"]),
        # lengths
        ("[1.0, 1.0, 0.05]", "[1.0, 1.0]", "obstacle.wall.position", ["exactly 3 values", "found [1.0, 1.0]"]),
        ("[1.0, 1.0, 0.05]", "[1, 1, 1, 1]", "obstacle.wall.position", ["exactly 3 values", "found [1, 1, 1, 1]"]),
        ("position = [2.0, 0.0]", "position = [2.0]", "goal.position", ["at least 2 values", "found [2.0]"]),
        ("position = [2.0, 0.0]", "position = [2, 0, 0, 0]", "goal.position", ["at most 3 values"]),
        ("[0.0, 0.0, 0.0]", "[]", "robot.base.joint_q", ["at least 1 value"]),
        ("size = [0.3, 0.5, 0.3]", "size = [0.3, 0.5]", "object.box", ["'box' needs size", "[x, y, z]", "found 2"]),
        ('shape = "sphere"', 'shape = "cylinder"\nradius = 1', "obstacle.ball", ["size = [radius, length]"]),
        ("mass = 1.0", "mass = 1.0\nheight = 1", "object.box", ["unknown key height", "a box has size = [x, y, z]"]),
        # sections that contradict themselves
        ("damping = 600.0, ", "", "robot.base.drive", ["needs damping"]),
        ("samples = 64", "temperature.eta = [9.0, 2.0]", "planner.temperature", ["low < high"]),
        ("samples = 64", "temperature = { eta = [5.0, 9.0], ess = 9.0 }", "planner.temperature", ["eta", "ess"]),
        ('object = "box"', "", "goal", ["either object or frame"]),
        ("position = 0.05", "", "success", ["at least one of position"]),
        ("size = 0.2", "size = 0.2\nrotation = [0, 0, 0, 0]", "obstacle.ball.rotation", ["quaternion"]),
        # references and names
        ('object = "box"', 'object = "bix"', "goal.object", ["no such object", "allowed: box", "'box'?"]),
        ('object = "box"', 'frame = "bse/tip"', "goal.frame", ["no such robot", "'base'?"]),
        ('object = "box"', 'frame = "base"', "goal.frame", ["robot/frame", "base/tip"]),
        ('name = "ball"', 'name = "box"', "obstacle.box.name", ["taken by another object", "found 'box'"]),
        ('name = "ball"', 'name = "goal"', "obstacle.goal.name", ["reserved", "found 'goal'"]),
        ('term = "contact_force"', 'term = "distance"', "cost.distance", ["2 cost entries", "another name"]),
        ("position = 0.05", "position = [1.0, 1.0, 1.0]", "success.position", ["each of the goal's 2 axes"]),
        ("position = 0.05", "yaw = 0.1", "success.yaw", ["goal has no orientation"]),
        ("[planner]", "[randomize.bix]\nmass.uniform = 0.1\n[planner]", "randomize.bix", ["'box'?"]),
        ("[planner]", "[randomize.wall]\nmass.uniform = 0.1\n[planner]", "randomize.wall.mass", ["has no mass"]),
        ("[planner]", "[randomize.base]\nsize.normal = 0.1\n[planner]", "randomize.base.size", ["by its asset"]),
        ("[planner]", "[timing]\ntimeout = 0.01\n[planner]", "timing.timeout", ["control_dt = 0.04; found 0.01"]),
        ("[planner]", "[timing]\ncontrol_dt = 50.0\n[planner]", "timing.timeout", ["control_dt = 50; found 45.0"]),
        ("samples = 64", 'samples = 4\nmethod = "cem"', "planner.elites", ["more elites than samples", "found 8"]),
    ],
)
def test_a_mistake_in_the_file_is_told_with_its_key(tmp_path, old, new, key, says):
    error = spoil(tmp_path, old, new)
    assert error.key.replace('"', "") == key
    for words in says:
        assert words in str(error)
    assert "Input should" not in str(error)


KICK = '[[plant.kicks]]\ntime = {}\ntarget = "{}"\nvelocity = {}\n[planner]'


@pytest.mark.parametrize(
    ("kick", "key", "says"),
    [
        ((50.0, "box", [0.0, 1.0, 0.0]), "plant.kicks.time", "less than timing.timeout = 45"),
        ((1.0, "bix", [0.0, 1.0, 0.0]), "plant.kicks.target", "Did you mean 'box'?"),
        ((1.0, "wall", [0.0, 1.0, 0.0]), "plant.kicks.target", "allowed: base, box"),
        ((1.0, "box", [0.0, 1.0]), "plant.kicks.velocity", "(x, y, z); found [0.0, 1.0]"),
    ],
)
def test_a_kick_needs_a_time_and_a_target_of_the_run(tmp_path, kick, key, says):
    error = spoil(tmp_path, "[planner]", KICK.format(*kick))
    assert error.key == key
    assert says in str(error)


@pytest.mark.parametrize(
    ("drive", "key", "says"),
    [
        ('{ joints = ["x", "y"], damping = 1, limit = [1, 2, 3] }', ".limit", "1 value, or 2"),
        ('[{ joints = ["x"], damping = 1, limit = 1 }, { damping = 1, limit = 1 }]', ".1.joints", "name its joints"),
        (
            '[{ joints = ["x"], damping = 1, limit = 1 }, { joints = ["x"], damping = 1, limit = 1 }]',
            ".1.joints",
            "driven twice; found 'x'",
        ),
        ("{ damping = 1, lower = -1 }", "", "give both lower"),
        ('{ damping = 1, mode = "acceleration" }', "", "needs limit"),
        ("3", "", "[[robot.base.drive]]"),
        ("[{ damping = 1, limt = 1 }, { damping = 1, limit = 1 }]", ".0.limt", "Did you mean 'limit'?"),
    ],
)
def test_drives_are_checked(tmp_path, drive, key, says):
    error = spoil(tmp_path, "{ damping = 600.0, limit = [0.8, 0.8, 1.0] }", drive)
    assert error.key == f"robot.base.drive{key}"
    assert says in str(error)


@pytest.mark.parametrize(
    ("task", "key", "says"),
    [
        ('draw."goal.positon" = { low = [0, 0], high = [1, 1] }', '.draw."goal.positon"', "Did you mean 'position'?"),
        ('draw."obstacle.bal.size" = { low = 0.1, high = 1 }', '.draw."obstacle.bal.size"', "Did you mean 'ball'?"),
        ('draw."goal.position" = { low = 0, high = 1 }', '.draw."goal.position"', "must be a list of numbers"),
        ('draw."object.box.mass" = { low = -1, high = 1 }', '.draw."object.box.mass"', "above 0"),
        ('draw."goal.position" = { low = [0, 0], high = [1] }', '.draw."goal.position"', "of one length"),
        (
            'draw."obstacle.*.friction" = { low = 0, high = 1 }\ndraw."obstacle.ball.friction" = { low = 0, high = 1 }',
            '.draw."obstacle.ball.friction"',
            "drawn already",
        ),
        ('reject = [{ place = "gaol", clearance = 1 }]', ".reject.place", "Did you mean 'goal'?"),
        ('reject = [{ place = "base/tip", clearance = 1 }]', ".reject.at", "at = [x, y, z]"),
        ('reject = [{ place = "goal", clearance = -1 }]', ".reject.clearance", "at least 0"),
    ],
)
def test_a_task_draw_is_checked_before_it_is_drawn(tmp_path, task, key, says):
    error = spoil(tmp_path, "[planner]", f"[randomize_task]\n{task}\n[planner]")
    assert error.key == f"randomize_task{key}"
    assert says in str(error)


def test_a_syntax_error_names_file_and_line(tmp_path):
    error = spoil(tmp_path, 'name = "base"', "name = base")
    line = SMALL[: SMALL.index('name = "base"')].count("\n") + 1
    assert str(error.file).endswith(f"small.toml:{line}")
    assert "is not valid TOML: invalid value" in str(error)


def test_a_file_that_ends_too_early_names_its_last_line(tmp_path):
    path = write(tmp_path, "[planner]\nsamples = ")
    with pytest.raises(SceneError, match=r"small\.toml:[12]: is not valid TOML"):
        load_scene(path)


def test_a_file_that_is_not_text_is_an_error(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"title = 1\n\xff\xfe")
    with pytest.raises(SceneError, match=r"binary\.toml:2: is not UTF-8"):
        load_scene(path)


def test_a_missing_scene_suggests_the_nearest(tmp_path):
    for source in ("omni_push_bax", tmp_path / "omni_push_bax.toml"):
        with pytest.raises(SceneError, match=r"no such scene file.*point_reach.*Did you mean 'omni_push_box'\?"):
            load_scene(source)
    path = write(tmp_path)
    with pytest.raises(SceneError) as caught:
        load_scene(tmp_path / "smal.toml")
    assert caught.value.suggestion == str(path)


def test_an_unknown_variant_lists_the_variants(tmp_path):
    with pytest.raises(SceneError, match=r"no such variant; found 'nera'; allowed: near\. Did you mean 'near'\?"):
        load_scene(f"{write(tmp_path)}:nera")
    with pytest.raises(SceneError, match="nothing, there is none"):
        load_scene("pendulum:B")


def test_variants_that_are_no_tables_are_errors(tmp_path):
    path = write(tmp_path, "variants = 3\n" + SMALL.partition("[variants")[0])
    assert variants(path) == ()
    with pytest.raises(SceneError, match=r"variants: must be tables"):
        load_scene(path)
    path = write(tmp_path, "variants.near = 3\n" + SMALL.partition("[variants")[0])
    with pytest.raises(SceneError, match=r"variants\.near: must be a table; found 3"):
        load_scene(f"{path}:near")


def test_a_mistake_in_a_variant_names_the_variant(tmp_path):
    path = write(tmp_path, SMALL + "goal.yw = 3\n")
    assert load_scene(path)
    with pytest.raises(SceneError) as caught:
        load_scene(f"{path}:near")
    assert str(caught.value).startswith(f"{path} [variants.near]: goal.yw: unknown key")
    path = write(tmp_path, SMALL + "obstacle.wal.friction = 3\n")
    with pytest.raises(SceneError) as caught:
        load_scene(f"{path}:near")
    assert str(caught.value).startswith(f"{path} [variants.near]: obstacle.wal: no entry")


@pytest.mark.parametrize(
    ("override", "key", "says"),
    [
        ("planner.sampels=3", "planner.sampels", "Did you mean 'samples'?"),
        ("planner.samples=nan", "planner.samples", "must be a whole number; found nan"),
        ("object.box.mass=nan", "object.box.mass", "must be finite"),
        ("cost.distance.gain=inf", "cost.distance.gain", "must be finite"),
        ("cost.*.gain=inf", "cost.distance.gain", "must be finite"),
        ("robot.bse.joint_q=[0]", "robot.bse", "allowed: base. Did you mean 'base'?"),
        ("object.0.mass=1", "object.0", "allowed: box"),
        ("cost.distnce.weight=1", "cost.distnce", "Did you mean 'distance'?"),
        ("planner.samples=[1", "planner.samples", "is not a TOML value; found '[1'"),
        ("planner.samples=.5", "planner.samples", "is not a TOML value; found '.5'"),
        ("planner.samples=1\nx=2", "planner.samples", "is not a TOML value"),
        ("planner.samples", None, "KEY=VALUE"),
        ("planner.samples=", None, "KEY=VALUE"),
        ("=3", None, "KEY=VALUE"),
        ("planner..samples=3", None, "is not a dotted key"),
        ("planner=3", "planner", "must be a table; found 3"),
        ("robot=[]", "robot", "needs at least 1 entry; found []"),
        ("robot=3", "robot", "write [[robot]]"),
        ("path=x", "path", "this key cannot be set"),
        ("variants.near.goal.yaw=1", "variants", "this key cannot be set"),
        ("robot.base.floating=True", "robot.base.floating", "found 'True'; allowed: false, true"),
    ],
)
def test_a_mistake_in_an_override_names_the_override(tmp_path, override, key, says):
    error = set_to(tmp_path, override)
    assert error.file == f"--set {override}"
    assert error.key == key
    assert says in str(error)


SPEED = "[scalar]\nspeed = 1.0\n"


@pytest.mark.parametrize(
    ("override", "key", "says"),
    [
        ("scalar.sped=1", "scalar.sped", "nothing reads a new one; found 'sped'; allowed: speed. Did you"),
        ("scalar={ sped = 1 }", "scalar.sped", "Did you mean 'speed'?"),
        ('robot.base.frames.tp={ link = "base_link" }', "robot.base.frames.tp", "allowed: tip. Did you mean 'tip'?"),
        ('robot.*.frames.tp.link="base_link"', "robot.base.frames.tp", "allowed: tip. Did you mean 'tip'?"),
    ],
)
@pytest.mark.parametrize("variant", [False, True])
def test_a_changed_name_in_a_free_table_is_one_that_is_there(tmp_path, override, key, says, variant):
    changed = override.replace("*", "base")
    path = write(tmp_path, f"{SPEED}{SMALL}\n[variants.other]\n{changed}\n")
    with pytest.raises(SceneError) as caught:
        load_scene(f"{path}:other") if variant else load_scene(path, overrides=[override])
    assert caught.value.file == (f"{path} [variants.other]" if variant else f"--set {override}")
    assert caught.value.key == key
    assert says in str(caught.value)


def test_a_change_may_add_what_another_one_reads(tmp_path):
    changes = ['robot.base.frames.side={ link = "base_link" }', 'cost.distance.between=["base/side", "box"]']
    changes += ["scalar.fast=2.0", 'cost.distance.gain="fast"', "scalar.speed=3.0"]
    scene = load_scene(write(tmp_path, SPEED + SMALL), overrides=changes)
    assert scene.scalar == {"speed": 3.0, "fast": 2.0}


def test_an_ambiguous_cost_term_is_told_as_such(tmp_path):
    text = SMALL.replace('term = "distance"', 'name = "near"\nterm = "distance"')
    text = text.replace('term = "contact_force"', 'name = "far"\nterm = "distance"').partition("[variants")[0]
    with pytest.raises(
        SceneError, match=r"cost\.distance: 2 entries of cost .* another name; found 'distance'; allowed: far, near"
    ):
        load_scene(write(tmp_path, text), overrides=["cost.distance.weight=3"])


def test_objects_of_a_scene_without_any_are_told_as_such():
    with pytest.raises(SceneError, match=r"object\.box: .*nothing, there is none"):
        load_scene("point_reach", overrides=["object.box.mass=3"])


def test_all_mistakes_are_told_and_the_unknown_key_comes_first(tmp_path):
    error = spoil(tmp_path, "mass = 1.0", 'mas = 1.0\nfriction = "x"\nposition = [1, "a", 3]')
    keys = ["object.box.mas", "object.box.position", "object.box.friction"]  # not mass: mas is meant for it
    assert sorted(each.key for each in error.each) == sorted(keys)
    assert error.key == keys[0]
    lines = str(error).splitlines()
    assert lines == [each.line for each in error.each]
    assert all(f"{error.file}: {each.key}: " in line for each, line in zip(error.each, lines, strict=True))


def test_all_mistakes_between_sections_are_told(tmp_path):
    text = SMALL.replace('object = "box"', 'frame = "bse/tip"').replace("position = 0.05", "position = 0.05\nyaw = 1.0")
    text += "[randomize.bx]\nmass.uniform = 0.1\n[randomize.wall]\nmass.uniform = 0.1\n"
    changes = ["planner.method=cem", "planner.samples=4"]
    with pytest.raises(SceneError) as caught:
        load_scene(write(tmp_path, text), overrides=changes)
    keys = ["goal.frame", "success.yaw", "planner.elites", "randomize.bx", "randomize.wall.mass"]
    assert [each.key for each in caught.value.each] == keys


def test_of_many_mistakes_the_first_are_told(tmp_path):
    text = "".join(f"wrong_{i} = 1\n" for i in range(12)) + SMALL
    with pytest.raises(SceneError) as caught:
        load_scene(write(tmp_path, text))
    lines = str(caught.value).splitlines()
    assert (len(lines), lines[-1]) == (11, "and 2 more mistakes")


def test_an_error_survives_pickling(tmp_path):
    error = set_to(tmp_path, "planner.sampels=3")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_absurd_nesting_is_an_error_like_any_other(tmp_path):
    deep = ".".join(["a"] * 5000)
    for override in (f"{deep}=1", f"cost.distance.{deep}=1"):
        with pytest.raises(SceneError, match="nested too deeply"):
            load_scene(write(tmp_path), overrides=[override])
    with pytest.raises(SceneError, match=r"is not valid TOML|nested too deeply"):
        load_scene(write(tmp_path, SMALL.replace("samples = 64", f"samples = {'[' * 5000}")))


@pytest.mark.parametrize(
    ("overrides", "key", "says"),
    [
        (["planner.samples=1_000_000_000"], "planner.samples", "physics steps"),
        (["planner.horizon=10_000_000"], "planner.horizon", "physics steps"),
        (["planner.iterations=1_000_000"], "planner.iterations", "physics steps"),
        (["planner.iterations=1_000_000", "planner.samples=2", "planner.horizon=2"], "planner.iterations", "rounds"),
        (["planner.domains=1_000_000_000"], "planner.domains", "physics steps"),
        (["engine.substeps=1_000_000"], "engine.substeps", "at most 80000"),
        (["plant.substeps=1_000_000"], "plant.substeps", "at most 40000"),
        (["engine.substeps=10_000", "planner.dt={ first = 0.001, last = 0.1 }"], "engine.substeps", "at most 1000"),
        (["engine.substeps=10_000", "planner.dt=[0.1, 0.001]", "planner.horizon=2"], "engine.substeps", "at most 1000"),
        (["timing.control_dt=1e-12"], "timing.control_dt", "controls"),
        (["timing.timeout=1e12"], "timing.timeout", "controls"),
        (["engine.threads=100_000"], "engine.threads", "at most 1024"),
    ],
    ids=lambda value: value[0].partition("=")[0] if isinstance(value, list) else None,
)
def test_absurd_sizes_are_refused_before_anything_is_built(tmp_path, overrides, key, says):
    with pytest.raises(SceneError) as caught:
        load_scene(write(tmp_path), overrides=overrides)
    assert caught.value.key == key
    assert says in str(caught.value)


def test_large_sizes_are_not_absurd(tmp_path):
    overrides = ["planner.samples=65536", "planner.horizon=100", "engine.substeps=10", "plant.substeps=1000"]
    load_scene(write(tmp_path), overrides=overrides)
