# SPDX-License-Identifier: Apache-2.0
r"""Longest observe() of a driver, and rates of the loop and the robot, while messages flood them.

    python tools/bench.py floods --transport zmq ros2 --seconds 5 --json docs/data/floods.json

The robot is `warpmpc robot SCENE` in another process, agent and driver are here, without a planner: a plan that
does not change stands in its place. A third process sends messages of one kind at full speed; where it floods ZeroMQ
with states, it is the robot. A row has the longest and the 99th percentile of observe() in wall time, the longest in
this thread's own time, which is left where the machine has other things to do; ticks of the loop and the robot's clock
as shares of what they are to be; messages sent a second. Exit code 1 where observe() took longer than --longest, or a
rate is below --rate.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from shared.files import put_group
from shared.machine import machine
from shared.wire import DRILL, PROGRAM, TOOLS, TRANSPORTS

from warpmpc import Plan, RobotLoop, Scene, State, load_scene
from warpmpc.loop.realtime.messages import TimedObservation, TimedPlan
from warpmpc.loop.robots.drivers import await_state, make_robot
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema import SplineKind
from warpmpc.scene.task.task import Task

COLUMNS = [
    "transport",
    "flood",
    "messages a second",
    "observe() max / p99 [ms]",
    "own time max [ms]",
    "loop [%]",
    "robot [%]",
]
SMALL, LARGE, HUGE = 100, 30_000, 2_000_000
"""Sizes of messages [bytes]; the last is larger than what is read."""
BASE = "go2_walk:estimated"
"""Scene whose base is estimated, for floods of its sensors."""


class Straight:
    """A planner whose plan is always the same: it stands, or moves on slowly."""

    def __init__(self, nu: int, start: np.ndarray):
        self._limits, self._start, self._nu = (np.full(nu, -1e9), np.full(nu, 1e9)), start, nu
        self._timed: TimedPlan | None = None

    def observe(self, observation: TimedObservation) -> None:
        """Make a plan at once."""
        now = observation.state.time
        plan = Plan(np.tile(self._start, (2, 1)), now + np.array([0.0, 1.0]), SplineKind.ZERO, *self._limits)
        number = 0 if self._timed is None else self._timed.number + 1
        self._timed = TimedPlan(plan, number, now, 0.0, 0.0, True)

    def newest(self) -> TimedPlan | None:
        """The newest plan."""
        return self._timed


@dataclass
class Watched:
    """A robot whose observe() is timed; everything else is the driver's."""

    robot: Any
    wall: list[float] = field(default_factory=list)
    own: list[float] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.robot, name)

    def observe(self) -> State | None:
        """The newest state."""
        begin, own = time.perf_counter(), time.thread_time()
        state = self.robot.observe()
        self.own.append(time.thread_time() - own)
        self.wall.append(time.perf_counter() - begin)
        return state


def text(size: int) -> str:
    """Text of a size [bytes]."""
    return "x" * size


def zmq_commands(place: int, scene: Scene, size: int) -> Iterator[Callable[[], None]]:
    """Commands of somebody else to the robot."""
    import zmq

    names = compile_scene(scene).layout.control_name
    socket = zmq.Context().socket(zmq.PUB)
    socket.connect(f"tcp://127.0.0.1:{place + 1}")
    control = dict.fromkeys(names, 0.5) | ({text(size): 1.0} if size > SMALL else {})
    message = json.dumps({"time": 0.0, "sender": "flood", "control": control}).encode()
    yield lambda: socket.send(message)


def zmq_states(place: int, scene: Scene, size: int) -> Iterator[Callable[[], None]]:
    """States of a robot, and of other joints."""
    import zmq

    from warpmpc.loop.robots.zeromq import StateCodec

    layout = compile_scene(scene).layout
    codec, start, begin = StateCodec(layout), State.start(layout), time.monotonic()
    socket = zmq.Context().socket(zmq.PUB)
    socket.bind(f"tcp://127.0.0.1:{place}")
    socket.setsockopt(zmq.SNDHWM, 10)

    def send() -> None:
        now = time.monotonic() - begin
        message = json.loads(codec.encode(replace(start, time=now)))
        others = {f"other_{k}": {"q": [0.0], "qd": [0.0]} for k in range(max(size - SMALL, 0) // 45)}
        message["joints"] |= others
        socket.send(json.dumps(message).encode())

    yield send


def ros2_flood(kind: str, topic: str, fill: Callable[[Any, int], None]) -> Callable[..., Iterator[Callable[[], None]]]:
    """Messages of a type on a topic of the robot."""

    def flood(place: int, scene: Scene, size: int) -> Iterator[Callable[[], None]]:
        from warpmpc.extras.ros2.connection import Connection, message_class

        publisher = Connection("flood", f"wire_{place}").publisher(kind, topic)
        message = message_class(kind)()
        fill(message, size)

        def send() -> None:
            if hasattr(message, "header"):
                seconds = time.time_ns()
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(seconds, 10**9)
            publisher.publish(message)

        yield send

    return flood


def _joints(message: Any, size: int) -> None:
    names = [f"other_{k}" for k in range(max(1, size // 40))]
    message.name, message.position = names, [0.0] * len(names)


def _dog(message: Any, size: int) -> None:
    legs = [f"{leg}_{joint}_joint" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf")]
    message.name, message.position, message.velocity, message.effort = legs, [0.1] * 12, [0.0] * 12, [0.0] * 12


def _unit(message: Any, size: int) -> None:
    message.linear_acceleration.z = 9.81


def _pose(message: Any, size: int) -> None:
    message.pose.orientation.w, message.pose.position.x = 1.0, 90.0


def _controls(message: Any, size: int) -> None:
    message.data = [0.5] * max(3, size // 8)


def _trajectory(message: Any, size: int) -> None:
    from trajectory_msgs.msg import JointTrajectoryPoint

    message.joint_names = ["x", "y", "yaw"]
    for k in range(max(1, size // 64)):
        point = JointTrajectoryPoint(velocities=[0.1, 0.0, 0.0])
        point.time_from_start.nanosec = 1000 * k
        message.points.append(point)


def _clock(message: Any, size: int) -> None:
    message.clock.sec = 1


def ros2_parameters(place: int, scene: Scene, size: int) -> Iterator[Callable[[], None]]:
    """Requests to change a weight."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    from warpmpc.extras.ros2.connection import Connection

    node = Connection("flood", f"wire_{place}").node
    client = node.create_client(SetParameters, f"/wire_{place}/warpmpc/set_parameters")
    request = SetParameters.Request(parameters=[Parameter("weight.distance", value=1.0).to_parameter_msg()])

    def send() -> None:
        client.call_async(request)
        client._pending_requests.clear()
        time.sleep(1e-4)

    yield send


FLOODS: dict[str, dict[str, tuple[Callable | None, int]]] = {
    "zmq": {
        "none": (None, 0),
        "commands": (zmq_commands, SMALL),
        "commands of 30 kB": (zmq_commands, LARGE),
        "commands of 2 MB": (zmq_commands, HUGE),
        "states": (zmq_states, SMALL),
        "states of 30 kB": (zmq_states, LARGE),
    },
    "ros2": {
        "none": (None, 0),
        "joints": (ros2_flood("sensor_msgs/JointState", "joint_states", _joints), SMALL),
        "joints of 30 kB": (ros2_flood("sensor_msgs/JointState", "joint_states", _joints), LARGE),
        "goals": (ros2_flood("geometry_msgs/PoseStamped", "goal_pose", _pose), SMALL),
        "commands": (ros2_flood("std_msgs/Float64MultiArray", "commands", _controls), SMALL),
        "commands of 30 kB": (ros2_flood("std_msgs/Float64MultiArray", "commands", _controls), LARGE),
        "/clock": (ros2_flood("rosgraph_msgs/Clock", "/clock", _clock), SMALL),
        "parameters": (ros2_parameters, SMALL),
    },
    "ros2-trajectory": {
        "none": (None, 0),
        "commands": (ros2_flood("trajectory_msgs/JointTrajectory", "commands", _trajectory), SMALL),
        "commands of 30 kB": (ros2_flood("trajectory_msgs/JointTrajectory", "commands", _trajectory), LARGE),
    },
    "ros2-base": {
        "none": (None, 0),
        "units": (ros2_flood("sensor_msgs/Imu", "robot/imu", _unit), SMALL),
        "joints": (ros2_flood("sensor_msgs/JointState", "joint_states", _dog), SMALL),
    },
}
"""Floods by transport: what makes the function that sends a message, and its size."""


@contextmanager
def process(command: list[object], number: signal.Signals) -> Iterator[subprocess.Popen]:
    """A process that is ended by a signal."""
    made = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
    try:
        yield made
    finally:
        made.send_signal(number)
        made.wait(60.0)


def measure(transport: str, name: str, seconds: float) -> dict[str, float]:
    """Figures of one flood."""
    ends = TRANSPORTS["ros2" if transport == "ros2-base" else transport]
    flood, _ = FLOODS[transport][name]
    with tempfile.TemporaryDirectory() as folder:
        place, file, own = ends.place(), Path(folder) / "robot.toml", Path(folder) / "drill.toml"
        own.write_text(DRILL, encoding="utf-8")
        file.write_text(ends.settings(place), encoding="utf-8")
        source = BASE if transport == "ros2-base" else str(own)
        changes = ["engine.threads=1", *(["agent.rate=200"] if transport == "ros2-base" else [])]
        scene, given = load_scene(source, overrides=changes), [part for change in changes for part in ("--set", change)]
        robot = [*PROGRAM, "robot", source, *ends.options(place, file), *given]
        sender = [sys.executable, TOOLS / "bench.py", "floods", "--send", transport, name, place, source]
        faked = flood is zmq_states
        with process(sender if faked else robot, signal.SIGKILL if faked else signal.SIGINT) as one:
            figures = _control(scene, f"{ends.driver}:{file}", seconds, None if faked or flood is None else sender, one)
            if faked:
                one.send_signal(signal.SIGTERM)
            else:
                one.send_signal(signal.SIGINT)
                report = json.loads(one.communicate(timeout=60.0)[0])
                figures["robot"] = 100.0 * (1.0 - report["slipped_s"] / (report["time_s"] + report["slipped_s"]))
    return figures


def _control(scene: Scene, choice: str, seconds: float, sender: list[object] | None, robot: subprocess.Popen):
    compiled, task = compile_scene(scene), Task(scene)
    driver = make_robot(choice, scene, seed=0, task=task, terms=(), watch=(), compiled=compiled)
    watched = Watched(driver)
    layout = compiled.layout
    start = np.zeros(layout.nu, dtype=np.float32)
    try:
        await_state(driver, choice)
        loop = RobotLoop(scene, watched, Straight(layout.nu, start))
        loop.run(_after(0.5))  # everything is loaded
        with process(sender or ["sleep", "600"], signal.SIGKILL) as other:
            sent = int(other.stdout.readline()) if sender else 0
            watched.wall.clear()
            watched.own.clear()
            ticks, begin = loop.ticks, time.monotonic()
            loop.run(_after(seconds))
            lasted = time.monotonic() - begin
        faults = len(loop.agent.faults)
    finally:
        driver.close()
    wall, own = 1e3 * np.array(watched.wall), 1e3 * np.array(watched.own)
    return {
        "max": wall.max(),
        "p99": np.percentile(wall, 99),
        "own": own.max(),
        "loop": 100.0 * (loop.ticks - ticks) / (lasted * scene.agent.rate),
        "faults": faults,
        "sent": sent,
    }


def _after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() >= end


def send(transport: str, name: str, place: int, source: str) -> int:
    """Send messages without end at normal priority, and print how many went in the first second."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    flood, size = FLOODS[transport][name]
    (one,) = flood(place, load_scene(source), size)
    count, begin = 0, time.monotonic()
    while time.monotonic() - begin < 1.0:
        one()
        count += 1
    print(count, flush=True)
    while True:
        one()


def main(arguments: list[str]) -> int:
    """Run and print; returns the exit code."""
    if arguments[:1] == ["--send"]:
        return send(*arguments[1:3], int(arguments[3]), arguments[4])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transport", nargs="+", default=list(FLOODS), choices=FLOODS)
    parser.add_argument("--floods", nargs="+", metavar="NAME", help="some floods, all by default")
    parser.add_argument("--seconds", type=float, default=5.0, help="time for each")
    parser.add_argument("--longest", type=float, default=5.0, help="[ms]")
    parser.add_argument("--rate", type=float, default=99.0, help="[%%]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="put the figures there, as docs/data has them")
    args = parser.parse_args(arguments)
    rows, missed = [], 0
    for transport in args.transport:
        for name in FLOODS[transport]:
            if args.floods and name not in args.floods:
                continue
            found = measure(transport, name, args.seconds)
            robot = found.get("robot")
            slow = found["own"] > args.longest or min(found["loop"], robot or 100.0) < args.rate
            missed += slow
            rows.append(
                [
                    transport,
                    name,
                    f"{found['sent']:,}" if found["sent"] else "-",
                    f"{found['max']:.1f} / {found['p99']:.2f}",
                    f"{found['own']:.1f}",
                    f"{found['loop']:.1f}",
                    "-" if robot is None else f"{robot:.1f}",
                ]
            )
            print(f"| {' | '.join(rows[-1])} |", "missed" if slow else "", f"{found['faults']} faults", flush=True)
    here = machine()
    about = f"{here['cpu']}, {here['cores']} cores, load {here['load'][0]:.1f}"
    print(about)
    if args.json:
        command = shlex.join(["python", "tools/bench.py", "floods", *arguments])
        group = {"machine": about, "date": date.today().isoformat(), "command": command, "rows": rows}
        put_group(args.json, COLUMNS, group)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
