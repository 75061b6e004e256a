# SPDX-License-Identifier: Apache-2.0
"""Robots behind two ZeroMQ sockets, both ends: states one way, commands the other, as JSON with names.

A state is ``{"time": 1.5, "joints": {"base/x": {"q": [0.1], "qd": [0.0]}, ...}}``, in Newton's conventions, with
``act`` ``[na]`` and ``mocap`` ``[nm, 7]`` where the scene has them, and measured ``poses``, ``{"name": "box", "time":
1.46, "pose": [x, y, z, qx, qy, qz, qw]}``, in every message for a while. A command is ``{"time": 1.5, "sender": "...",
"control": {"base/x": 0.2, ...}}``; its time is that of the observation that it answers.
"""

from __future__ import annotations

import json
import math
import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import zmq
from pydantic import BaseModel, Field, ValidationError

from ...scene.errors import SceneError, some
from ...scene.model.state import State
from ..estimation.measurement import PoseMeasured
from .drivers import ZmqSettings
from .safety import Command
from .sources import BACK, Heard, Stamps

if TYPE_CHECKING:
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema import Scene
    from ..estimation.measurement import Measurement

TOLD = 200
"""Measured poses that a message has, and that are kept until they are asked for, at most."""
REPEATED = 0.25
"""Age until which a measured pose goes with every state: those who hear the newest state alone miss none [s]."""
MOST = 20
"""Messages that are read in a tick at most; others wait."""
LARGEST = 32768
"""Size of a message at most [bytes], and of those that are read in a tick: the connection of a longer one is closed."""


class JointMessage(BaseModel):
    """Coordinates and velocities of a joint."""

    q: list[float]
    qd: list[float]


class PoseMessage(BaseModel):
    """A measured pose."""

    name: str
    time: float
    pose: Annotated[list[float], Field(min_length=7, max_length=7)]


class StateMessage(BaseModel):
    """State of a robot and of what it sees."""

    time: float
    joints: dict[str, Any]
    """A :class:`JointMessage` of each; those that the scene does not have are left as they are, for it takes time."""
    act: list[float] | None = None
    mocap: list[list[float]] | None = None
    poses: Annotated[list[PoseMessage], Field(max_length=TOLD)] = []


class CommandMessage(BaseModel):
    """Controls by their names."""

    time: float
    sender: str
    control: dict[str, float]


class StateCodec:
    """Turns states into messages and back; joints are found by name, in any order and among others.

    Args:
        layout: State layout.
    """

    def __init__(self, layout: Layout):
        self._layout = layout
        q = np.append(layout.joint_q_start, layout.nq)
        qd = np.append(layout.joint_qd_start, layout.nv)
        self.joints = {
            name: (slice(int(q[j]), int(q[j + 1])), slice(int(qd[j]), int(qd[j + 1])))
            for j, name in enumerate(layout.joint_name)
            if layout.joint_dof_dim[j].sum()
        }
        """Joints that move: where their coordinates and velocities are."""

    def encode(self, state: State, poses: Sequence[PoseMeasured] = ()) -> bytes:
        """The message of a state and measured poses."""
        q, qd = state.joint_q, state.joint_qd
        joints = {name: {"q": q[a].tolist(), "qd": qd[b].tolist()} for name, (a, b) in self.joints.items()}
        message = {"time": float(state.time), "joints": joints}
        for name in ("act", "mocap"):
            if (part := getattr(state, name)) is not None and len(part):
                message[name] = part.tolist()
        if poses:
            message["poses"] = [{"name": m.name, "time": m.time, "pose": m.pose.tolist()} for m in poses]
        return json.dumps(message).encode()

    def decode(self, message: bytes) -> tuple[State, list[PoseMeasured]]:
        """The state of a message, and its measured poses.

        Raises:
            ValueError: If it is none, or lacks joints of the scene.
        """
        try:
            found = StateMessage.model_validate_json(message)
        except ValidationError as error:
            raise ValueError(f"a message is no state: {_first(error)}") from None
        lacking = [name for name in self.joints if name not in found.joints]
        if lacking:
            has = some(list(found.joints)) or "none"
            raise ValueError(f"the state has no joint {some(lacking)}; it has {has}: name them as the scene does")
        layout = self._layout
        q, qd = np.zeros(layout.nq, dtype=np.float32), np.zeros(layout.nv, dtype=np.float32)
        for name, (a, b) in self.joints.items():
            try:
                joint = JointMessage.model_validate(found.joints[name])
            except ValidationError as error:
                raise ValueError(f"a message is no state: joints.{name}: {_first(error)}") from None
            sizes, wanted = (len(joint.q), len(joint.qd)), (a.stop - a.start, b.stop - b.start)
            if sizes != wanted:
                raise ValueError(f"joint {name} has {wanted[0]} coordinates and {wanted[1]} velocities, not {sizes}")
            q[a], qd[b] = joint.q, joint.qd
        act, mocap = (None if part is None else np.array(part, np.float32) for part in (found.act, found.mocap))
        poses = [PoseMeasured(entry.name, entry.time, np.array(entry.pose)) for entry in found.poses]
        return State(q, qd, time=found.time, act=act, mocap=mocap), poses


class ZmqRobot:
    """A robot at the other end of two sockets.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        settings: Where it is.
        config: File of the settings, for messages.

    Raises:
        SceneError: If an address is none.
    """

    measures = (PoseMeasured,)
    """Kinds of its measurements."""

    def __init__(
        self, scene: Scene, *, compiled: CompiledScene, settings: ZmqSettings, config: Path | None = None, **_: object
    ):
        self.connect_timeout, self.use_sim_time = settings.connect_timeout, settings.use_sim_time
        self._names, self._codec = compiled.layout.control_name, StateCodec(compiled.layout)
        self._context, self._sender = zmq.Context(), uuid.uuid4().hex[:8]
        self._states, self._commands = self._context.socket(zmq.SUB), self._context.socket(zmq.PUB)
        self._states.setsockopt(zmq.CONFLATE, 1)  # the newest alone: nothing waits while the planner starts
        self._states.setsockopt(zmq.MAXMSGSIZE, LARGEST)
        self._states.subscribe(b"")
        for socket, key in ((self._states, "states"), (self._commands, "commands")):
            address = getattr(settings, key)
            try:
                socket.connect(address)
            except zmq.ZMQError as error:
                self.close()
                message = f"is no address ({error}), such as {ZmqSettings().states}"
                raise SceneError(message, key=key, file=config, found=address) from None
        self._heard = Heard(settings.states, "states")
        self._newest: State | None = None
        self._stamps, self._believed = Stamps(), -np.inf  # the newest time of those that can be true
        self._told: deque[Measurement] = deque(maxlen=TOLD)
        self._known: set[tuple[str, float]] = set()  # poses of the last message

    def heard(self) -> list[Heard]:
        """Messages of states."""
        return [self._heard]

    def observe(self) -> State | None:
        """The newest state, None before the first."""
        for message in _waiting(self._states, 1):  # the newest alone waits
            try:
                state, poses = self._codec.decode(message)
            except ValueError as error:
                self._heard.refuse(str(error))
                continue
            self._heard.note(state.time)
            self._told += [pose for pose in poses if (pose.name, pose.time) not in self._known]
            self._known = {(pose.name, pose.time) for pose in poses}
            if not self._stamps.believes(state.time):
                self._newest = state  # the watchdog reports it
            elif not self._believed - BACK < state.time < self._believed:
                self._newest, self._believed = state, state.time
        return self._newest

    def measurements(self) -> list[Measurement]:
        """Measured poses that came since the last call, as :meth:`observe` took them in."""
        told = list(self._told)
        self._told.clear()
        return told

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        command = dict(zip(self._names, control.tolist(), strict=True))
        self._commands.send_json({"time": self._newest.time, "sender": self._sender, "control": command})

    def close(self) -> None:
        """Close the sockets; what was sent last has a moment to leave."""
        self._context.destroy(linger=200)


class ZmqTransport:
    """The robot's end: binds to a port for states, and to the next one for commands.

    Args:
        layout: State layout.
        port: The first port.
        host: Address to bind to; by default only this machine can command it.

    Raises:
        ValueError: If a port is taken.
    """

    measures = (PoseMeasured,)
    """Kinds of measurements that it sends."""

    def __init__(self, layout: Layout, port: int, host: str = "127.0.0.1"):
        self._codec, self._names = StateCodec(layout), layout.control_name
        self._poses: list[PoseMeasured] = []
        self._context = zmq.Context()
        self._states, self._commands = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._commands.subscribe(b"")
        self._commands.setsockopt(zmq.MAXMSGSIZE, LARGEST)
        for socket, number in ((self._states, port), (self._commands, port + 1)):
            try:
                socket.bind(f"tcp://{host}:{number}")
            except zmq.ZMQError as error:
                self.close()
                raise ValueError(f"port {number}: {error}: choose another with --zmq PORT") from None

    @property
    def joints(self) -> dict[str, object]:
        """Joints that are published, by name."""
        return self._codec.joints

    def publish(self, state: State) -> None:
        """Send a state."""
        self._poses = [pose for pose in self._poses[-TOLD:] if pose.time > state.time - REPEATED]
        self._states.send(self._codec.encode(state, self._poses))

    def tell(self, measurements: Sequence[Measurement]) -> None:
        """Send measured poses, with the states that follow."""
        self._poses += [measured for measured in measurements if isinstance(measured, PoseMeasured)]

    def receive(self, now: float) -> Iterator[Command]:
        """Commands that came since the last call, in their order; one that cannot be read has no values."""
        for message in _waiting(self._commands):
            try:
                found = CommandMessage.model_validate_json(message)
                named = found.control.keys() == set(self._names)
                values = [found.control[name] for name in self._names] if named else []
                yield Command(np.array(values), found.time, found.sender)
            except ValidationError:
                yield Command(np.zeros(0), math.nan, "")

    def close(self) -> None:
        """Close the sockets."""
        self._context.destroy(linger=0)


def _waiting(socket: zmq.Socket, most: int = MOST) -> Iterator[bytes]:
    """Messages that are waiting, some at most, until they are :data:`LARGEST` bytes."""
    size = 0
    try:
        for _ in range(most):
            message = socket.recv(zmq.NOBLOCK)
            yield message
            if (size := size + len(message)) >= LARGEST:
                return
    except zmq.Again:
        return


def _first(error: ValidationError) -> str:
    detail = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}" if detail["loc"] else detail["msg"]
