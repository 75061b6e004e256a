# SPDX-License-Identifier: Apache-2.0
"""A robot's process whose messages go wrong when it is told to.

    python tools/shared/faulty_robot.py SCENE TRANSPORT PLACE SPEED

Reads orders on standard input, one a line, and answers each by a line of JSON: ``await`` answers when the drives have
followed plans for :data:`CALM`; ``FAULT SECONDS`` lets messages go wrong for that time and tells how soon the drives
had their safe command to the end of it (null if they had not), which commands were refused meanwhile, and whether any
was unsafe; ``end`` answers with the report. The faults are those of :data:`FAULTS`; ``watch`` spoils nothing.
"""

from __future__ import annotations

import json
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from queue import Empty, Queue
from typing import TYPE_CHECKING

import numpy as np

from shared.wire import TRANSPORTS
from warpmpc import State, load_scene
from warpmpc.model.safe import safe_command
from warpmpc.robots.process import RobotProcess

if TYPE_CHECKING:
    from warpmpc.estimation.measurement import Measurement
    from warpmpc.robots.process import Transport
    from warpmpc.robots.safety import Command

CALM = 0.3
"""Time for which plans are followed before an order [s]."""


class SpoiltTransport:
    """A transport whose messages go wrong.

    Args:
        transport: The transport; ``joints`` are those that it publishes, by name.
    """

    def __init__(self, transport: Transport):
        self.transport, self._joints = transport, dict(transport.joints)
        self.fault, self.measures = "watch", transport.measures

    def publish(self, state: State) -> None:
        """Send a state, spoilt."""
        self.transport.publish(FAULTS[self.fault](self, state))
        self.transport.joints.update(self._joints)

    def tell(self, measurements: Sequence[Measurement]) -> None:
        """Send measurements as they are."""
        self.transport.tell(measurements)

    def receive(self, now: float) -> Iterator[Command]:
        """Commands that came."""
        return self.transport.receive(now)

    def close(self) -> None:
        """Close it."""
        self.transport.close()

    def nan(self, state: State) -> State:
        """Joints that are no numbers."""
        return replace(state, joint_q=state.joint_q * np.nan)

    def ahead(self, state: State) -> State:
        """A time 2 s from now."""
        return replace(state, time=state.time + 2.0)

    def behind(self, state: State) -> State:
        """A time 2 s ago."""
        return replace(state, time=state.time - 2.0)

    def nameless(self, state: State) -> State:
        """A joint is missing."""
        self.transport.joints.pop(next(iter(self._joints)))
        return state

    def silent(self, state: State) -> State:
        """All joints are missing."""
        self.transport.joints.clear()
        return state


FAULTS = {
    "watch": lambda _, state: state,
    "nan": SpoiltTransport.nan,
    "ahead": SpoiltTransport.ahead,
    "behind": SpoiltTransport.behind,
    "nameless": SpoiltTransport.nameless,
    "silent": SpoiltTransport.silent,
}
"""What happens to a state."""


class DrilledRobot(RobotProcess):
    """A robot that takes orders; the arguments are those of :class:`~warpmpc.robots.process.RobotProcess`."""

    def __init__(self, *args: object, **keys: object):
        super().__init__(*args, **keys)
        self.over = False
        self._orders: Queue[list[str]] = Queue()
        self._order: list[str] | None = None
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in sys.stdin:
            self._orders.put(line.split())
        self._orders.put(["end"])

    def tick(self) -> None:
        """Take an order, tick, and answer what has been answered for."""
        if self._order is None:
            try:
                self._order = self._orders.get_nowait()
            except Empty:
                pass
            else:
                self._begin()
        super().tick()
        if self._order is not None and (answer := self._answer()) is not None:
            self._order, self.transport.fault = None, "watch"
            print(json.dumps(answer), flush=True)

    def _begin(self) -> None:
        name, *_ = self._order
        safety = self.safety
        self._calm: float | None = None
        self._safe_since: float | None = None
        self._before = Counter(safety.refused), self.monitor.unsafe
        self._start = self.now
        if name in FAULTS:
            self.transport.fault = name

    def _answer(self) -> dict | None:
        """The answer to the order, None while there is none yet."""
        now, safe = self.now, self._is_safe()
        name, *more = self._order
        if name == "end":
            self.over = True
            return self.report().to_json()
        if name == "await":
            self._calm = None if safe else self._calm or now
            return {"after_s": now - self._start} if self._calm and now - self._calm >= CALM else None
        self._safe_since = (self._safe_since or now) if safe else None
        if now - self._start < float(more[0]):
            return None
        # a planner that is gone has sent its last command before or after the order came
        last = self.safety.times.last if name == "watch" else self._start
        refused, unsafe = self.safety.refused - self._before[0], self.monitor.unsafe - self._before[1]
        return {
            "safe_s": None if self._safe_since is None else self._safe_since - last,
            "refused": {kind.value: count for kind, count in refused.items()},
            "unsafe": unsafe,
        }

    def _is_safe(self) -> bool:
        """Return whether the drives have the command that is safe for them, whoever sent it."""
        if self.control is None:
            return True
        state, layout = self.plant.state, self.plant.layout
        safe = safe_command(layout, state.joint_q[None], state.joint_qd[None], self.plant.scene.timing.control_dt)[0]
        return bool(np.allclose(self.control, np.clip(safe, layout.control_lower, layout.control_upper), atol=1e-6))


def main(scene: str, transport: str, place: str, speed: str) -> None:
    """Be the robot until the order to end."""
    ends = TRANSPORTS[transport]
    robot = DrilledRobot(
        load_scene(scene), lambda layout: SpoiltTransport(ends.connect(layout, int(place))), speed=float(speed)
    )
    robot.run(lambda: robot.over)


if __name__ == "__main__":
    main(*sys.argv[1:])
