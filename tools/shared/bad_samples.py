# SPDX-License-Identifier: Apache-2.0
"""Bad measurements of twenty kinds, and what each does to the estimate of a base and of a pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from warpmpc import Plant, Scene, State, load_scene
from warpmpc.loop.estimation.free_joints import FreeJoint
from warpmpc.loop.estimation.measurement import ImuMeasured, JointsMeasured, Measurement, PoseMeasured
from warpmpc.loop.robots.estimated import EstimatedRobot
from warpmpc.scene import schema
from warpmpc.scene.model.compiled import CompiledScene, compile_scene

BAD, BACK, AFTER = 0.7, 0.5, 0.1
"""When the first bad measurement comes, how long after the last the error is what it was, and for how long it is looked
at then [s]."""
DRIFT = (0.02, 0.01)
"""Way [m] and yaw [rad] of a base, which nothing shows, by which a bad measurement may move it."""
WARM = 0.3
"""Time from which errors before count [s]."""
TICK = 0.005
"""Time between states [s]."""
SENSORS = {"unit": ImuMeasured, "joints": JointsMeasured, "pose": PoseMeasured}
ARRAYS = {ImuMeasured: ("gyro", "accel"), JointsMeasured: ("q", "qd", "effort"), PoseMeasured: ("pose",)}
MOVE = {ImuMeasured: "gyro", JointsMeasured: "q", PoseMeasured: "pose"}
"""The array of each measurement that jumps."""
FEET = ("dog/fr_foot", "dog/fl_foot", "dog/rr_foot", "dog/rl_foot")
Change = Callable[[Measurement], list[Measurement]]


def of_all(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """All arrays of a measurement changed."""
    return lambda m: [replace(m, **{name: change(getattr(m, name)) for name in ARRAYS[type(m)]})]


def jump(unit: float, joints: float, pose: float, axis: int = 0) -> Change:
    """Angular velocity [rad/s], a joint [rad] or a position [m] that is off."""

    def change(m: Measurement) -> list[Measurement]:
        array = np.array(getattr(m, MOVE[type(m)]))
        array[axis] += {ImuMeasured: unit, JointsMeasured: joints, PoseMeasured: pose}[type(m)]
        return [replace(m, **{MOVE[type(m)]: array})]

    return change


def turned(angle: float, axis: int) -> Change:
    """Everything about another axis: a unit that is mounted wrongly, joints of other signs, a pose that is turned."""
    turn = Rotation.from_rotvec(angle * np.eye(3)[axis])

    def change(m: Measurement) -> list[Measurement]:
        match m:
            case ImuMeasured():
                return [replace(m, gyro=turn.apply(m.gyro), accel=turn.apply(m.accel))]
            case JointsMeasured():
                return [replace(m, q=-m.q, qd=-m.qd)]
        return [replace(m, pose=np.r_[m.pose[:3], (turn * Rotation.from_quat(m.pose[3:])).as_quat()])]

    return change


def other(unit: float, joints: float, pose: float) -> Change:
    """Acceleration [m/s²], velocities of joints [rad/s] or yaw [rad] that is off."""

    def change(m: Measurement) -> list[Measurement]:
        match m:
            case ImuMeasured():
                return [replace(m, accel=m.accel + [unit, 0.0, 0.0])]
            case JointsMeasured():
                return [replace(m, qd=m.qd + joints)]
        return turned(pose, 2)(m)

    return change


def later(seconds: float) -> Change:
    """The time of the measurement is off."""
    return lambda m: [replace(m, time=m.time + seconds)]


def twice(m: Measurement) -> list[Measurement]:
    """Another measurement of the same time comes first."""
    return [*jump(5.0, 0.2, 0.5)(m), m]


@dataclass(frozen=True)
class Kind:
    """A kind of bad measurements."""

    change: Change
    """What becomes of each of them."""
    count: int = 1
    """How many there are in a row."""
    lasts: float = 0.0
    """Time for which they come, where that is longer [s]."""
    frozen: bool = False
    """Whether all are the first but for their times."""


KINDS = {
    "not finite": Kind(of_all(lambda a: np.full(len(a), np.nan))),
    "a number too few": Kind(of_all(lambda a: a[:-1])),
    "1e200": Kind(of_all(lambda a: np.full(len(a), 1e200))),
    "all zero": Kind(of_all(np.zeros_like)),
    "beyond the range": Kind(jump(300.0, 100.0, 1e6)),
    "jump, large": Kind(jump(20.0, 1.0, 10.0)),
    "jump, middle": Kind(jump(5.0, 0.2, 0.5)),
    "jump, small": Kind(jump(1.5, 0.05, 0.05)),
    "jump about the vertical": Kind(jump(20.0, 1.0, 0.5, axis=2)),
    "of acceleration, velocity or yaw": Kind(other(100.0, 20.0, 1.5)),
    "turned over": Kind(turned(np.pi, 0)),
    "2 jumps, middle": Kind(jump(5.0, 0.2, 0.5), 2),
    "5 jumps, large": Kind(jump(20.0, 1.0, 10.0), 5),
    "5 jumps, middle": Kind(jump(5.0, 0.2, 0.5), 5),
    "5 jumps about the vertical": Kind(jump(20.0, 1.0, 0.5, axis=2), 5),
    "5 of acceleration, velocity or yaw": Kind(other(100.0, 20.0, 1.5), 5),
    "jumps for 0.1 s": Kind(jump(5.0, 0.2, 0.5), lasts=0.1),
    "jumps about the vertical for 0.1 s": Kind(jump(5.0, 0.2, 0.5, axis=2), lasts=0.1),
    "5 turned over": Kind(turned(np.pi, 0), 5),
    "frozen for 0.2 s": Kind(lambda m: [m], lasts=0.2, frozen=True),
    "silent for 0.2 s": Kind(lambda m: [], lasts=0.2),
    "of long ago": Kind(later(-1e6)),
    "0.2 s ago": Kind(later(-0.2)),
    "0.2 s ahead": Kind(later(0.2)),
    "0.5 s ahead": Kind(later(0.5)),
    "two of one time": Kind(twice),
}


LONGEST = max(kind.lasts for kind in KINDS.values())
END = BAD + LONGEST + BACK + AFTER


def spoilt(rows: list[Measurement], kind: Kind, sensor: type) -> tuple[list[tuple[float, Measurement]], float]:
    """Measurements, each with when it comes [s], and when the last bad one did."""
    out, first, seen, last = [], None, 0, BAD
    for m in rows:
        more = m.time < BAD + kind.lasts if kind.lasts else seen < kind.count
        if not (isinstance(m, sensor) and m.time >= BAD and more):
            out.append((m.time, m))
            continue
        seen, last = seen + 1, m.time
        first = m if first is None else first
        out += [(m.time, bad) for bad in kind.change(replace(first, time=m.time) if kind.frozen else m)]
    return out, last


class Recorded:
    """A driver that shows true states, and what is measured until then."""

    def __init__(self, rows: list[tuple[float, Measurement]]):
        self.state, self._rows = None, rows

    def observe(self) -> State:
        """The state."""
        return self.state

    def apply(self, control: np.ndarray) -> None:
        """Do nothing."""

    def measurements(self) -> list[Measurement]:
        """What came since the last call."""
        count = sum(came <= self.state.time + 1e-9 for came, _ in self._rows[:1000])
        told, self._rows = self._rows[:count], self._rows[count:]
        return [measured for _, measured in told]


@dataclass(frozen=True)
class Outcome:
    """What became of an estimate by bad measurements."""

    back: bool
    """Whether its error was below twice what it was before half a second later, or it was not trusted then.

    So is that of the way and the yaw of a base, which nothing shows, but for :data:`DRIFT`, or more where the safe
    command came meanwhile.
    """
    safe: float
    """Time for which it was not trusted [s]."""
    worst: tuple[float, ...]
    """Largest errors while it was trusted, as :meth:`Motion.errors` has them."""


@dataclass(frozen=True)
class Motion:
    """A motion with what was measured of it."""

    scene: Scene
    compiled: CompiledScene
    joint: FreeJoint
    """What is estimated."""
    states: list[State]
    measured: list[Measurement]

    def errors(self, rows: list[tuple[float, Measurement]]) -> np.ndarray:
        """Errors of the estimate from measurements ``[n, 5]``, NaN where it is too old to be trusted.

        Those that may be told from what is measured: height [m] or position [m], tilt [rad], velocity [m/s], angular
        velocity [rad/s], then the way [m] and the yaw [rad] that a base has drifted by.
        """
        driver = Recorded(rows)
        robot, out = EstimatedRobot(driver, self.scene, self.compiled), []
        robot.apply(np.zeros(self.compiled.layout.nu))
        for true in self.states:
            driver.state = true
            seen = robot.observe()
            old = seen is None or true.time - seen.time > self.scene.agent.observation_timeout
            out.append(np.full(6, np.nan) if old else self._off(seen, true))
        return np.array(out)

    def drill(self, kind: Kind, sensor: type, good: np.ndarray) -> Outcome:
        """What becomes of the estimate by bad measurements of a kind, beside its errors without."""
        times = np.array([state.time for state in self.states])
        rows, last = spoilt(self.measured, kind, sensor)
        found = self.errors(rows)
        end = last + BACK
        late = (times >= end) & (times < end + AFTER)
        before = np.nanmax(good[(times >= WARM) & (times < BAD)], axis=0)
        bound = 2.0 * np.maximum(before, np.nanmax(good[late], axis=0))
        bound[4:] = np.maximum(bound[4:], DRIFT)
        meanwhile = found[(times >= BAD) & (times < end)]
        held = np.isnan(meanwhile[:, 0])
        back = (np.isnan(found[late]) | (found[late] <= bound)).all(axis=0)
        if held.any():
            back[4:] = True  # nothing shows the way and the yaw: the drift was told of
        return Outcome(bool(back.all()), TICK * int(held.sum()), tuple(np.nanmax(meanwhile, axis=0).tolist()))

    def _off(self, seen: State, true: State) -> np.ndarray:
        q, p = (state.joint_q[self.joint.q].astype(float) for state in (seen, true))
        v, w = (state.joint_qd[self.joint.qd].astype(float).reshape(2, 3) for state in (seen, true))
        turn = Rotation.from_quat(q[3:]) * Rotation.from_quat(p[3:]).inv()
        off = turn.inv().apply(v) - w  # along the thing's own axes
        up = turn.as_matrix()[2, 2]
        way, yaw = np.linalg.norm(q[:2] - p[:2]), abs(turn.as_rotvec()[2])
        return np.array([abs(q[2] - p[2]), np.arccos(np.clip(up, -1.0, 1.0)), *np.linalg.norm(off, axis=1), way, yaw])


def trot(seed: int) -> Motion:
    """A quadruped that trots, at a pace and with steps of the seed."""
    scene = load_scene("quadruped_walk", overrides=("plant.delay=0.0", "plant.substeps=2", f"timing.control_dt={TICK}"))
    sensors = scene.plant.sensor.model_copy(
        update={"imu": {"dog": schema.ImuSensor()}, "joints": {"dog": schema.JointSensor()}}
    )
    scene = scene.model_copy(
        update={
            "plant": scene.plant.model_copy(update={"sensor": sensors}),
            "estimate_base": {"dog": schema.EstimateBase(feet=FEET)},
        }
    )
    plant, states, measured = Plant(scene, seed=seed), [], []
    rng = np.random.default_rng(seed)
    pace, swing, lift, lean = rng.uniform([2.5, 0.1, 0.3, -0.1], [3.5, 0.3, 0.5, 0.1])
    while plant.time < END:
        plant.observe()
        measured += plant.measured
        states.append(plant.state)
        control, phase, begin = plant.layout.control_start.copy(), pace * np.pi * plant.time, min(1.0, 2.0 * plant.time)
        for leg, shift in enumerate((0.0, np.pi, np.pi, 0.0)):
            control[3 * leg] += lean * begin * np.cos(phase + shift)
            control[3 * leg + 1] += swing * begin * np.cos(phase + shift)
            control[3 * leg + 2] -= lift * begin * max(np.sin(phase + shift), 0.0)
        plant.apply(control)
    return Motion(scene, plant.compiled, FreeJoint.of(plant.layout, "dog", key="estimate_base"), states, measured)


def waved(model: str, seed: int) -> Motion:
    """A box that is moved about before a camera."""
    scene = load_scene("omni_push_box", overrides=("plant.delay=0.0",))
    scene = scene.model_copy(update={"estimate": {"box": schema.Estimate(model=model)}})
    compiled, rng, states, measured = compile_scene(scene), np.random.default_rng(seed), [], []
    joint, start = FreeJoint.of(compiled.layout, "box", key=""), State.start(compiled.layout)
    ways, speeds = rng.uniform(0.0, 2.0 * np.pi, 6), rng.uniform(0.5, 2.0, 6)

    def pose(time: float) -> tuple[np.ndarray, np.ndarray]:
        moved = np.sin(speeds * time + ways)
        return 0.5 * moved[:3], 0.7 * moved[3:]

    for tick in range(round(END / TICK)):
        time = tick * TICK
        (place, turn), (place_after, turn_after), (place_before, turn_before) = (
            pose(time),
            pose(time + 1e-4),
            pose(time - 1e-4),
        )
        rotation = Rotation.from_rotvec(turn)
        spin = (Rotation.from_rotvec(turn_after) * Rotation.from_rotvec(turn_before).inv()).as_rotvec() / 2e-4
        q, qd = start.joint_q.astype(float), start.joint_qd.astype(float)
        q[joint.q] = joint.coordinates(place, rotation.as_quat())
        qd[joint.qd] = joint.velocities(rotation.as_quat(), (place_after - place_before) / 2e-4, spin)
        states.append(replace(start, joint_q=q, joint_qd=qd, time=time))
        if tick % 6 == 0:
            seen = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)) * rotation
            measured.append(PoseMeasured("box", time, np.r_[place + rng.normal(0.0, 0.005, 3), seen.as_quat()]))
    return Motion(scene, compiled, joint, states, measured)
