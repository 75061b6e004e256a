# SPDX-License-Identifier: Apache-2.0
"""A robot's process whose messages go wrong when it is told to.

    python tools/shared/faulty_robot.py SCENE --zmq PORT | --ros2 --topics FILE [--orders]

Without --orders it is `warpmpc robot` behind a link that loses and delays messages; its report counts unsafe commands.
With --orders it reads orders on standard input, one a line, and answers each by a line of JSON: ``await`` answers when
the drives have followed plans for :data:`CALM`; ``FAULT SECONDS`` lets messages go wrong for that time and tells how
soon the drives had their safe command to the end of it (null if they had not), which commands were refused meanwhile,
and whether any was unsafe; ``end`` answers with the report. The faults are those of :data:`FAULTS`; ``watch`` spoils
nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING

import numpy as np

from shared.drive_monitor import MonitoredProcess
from shared.faulty_link import FaultyLink
from warpmpc import State, load_scene
from warpmpc.cli.interrupts import Interrupts
from warpmpc.cli.robot import transport_of
from warpmpc.cli.setup import results_only
from warpmpc.scene.model.control_values import safe_command

if TYPE_CHECKING:
    from warpmpc.loop.estimation.measurement import Measurement
    from warpmpc.loop.robots.safety import Command
    from warpmpc.loop.robots.simulated import Transport

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


class DrilledRobot(MonitoredProcess):
    """A robot that takes orders; the arguments are those of :class:`MonitoredProcess`."""

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
        self._before = Counter(safety.refused), safety.monitor.unsafe
        self._start = self.now
        if name in FAULTS:
            self.transport.fault = name

    def _answer(self) -> dict | None:
        """The answer to the order, None while there is none yet."""
        now, safe = self.now, self._is_safe()
        name, *more = self._order
        if name == "end":
            self.over = True
            return self.told()
        if name == "await":
            self._calm = None if safe else self._calm or now
            return {"after_s": now - self._start} if self._calm and now - self._calm >= CALM else None
        self._safe_since = (self._safe_since or now) if safe else None
        if now - self._start < float(more[0]):
            return None
        # a planner that is gone has sent its last command before or after the order came
        last = self.safety.times.last if name == "watch" else self._start
        refused, unsafe = self.safety.refused - self._before[0], self.safety.monitor.unsafe - self._before[1]
        return {
            "safe_s": None if self._safe_since is None else self._safe_since - last,
            "refused": {kind.value: count for kind, count in refused.items()},
            "unsafe": unsafe,
        }

    def _is_safe(self) -> bool:
        """Return whether the drives have the command that is safe for them, from any sender."""
        if self.control is None:
            return True
        state, layout = self.plant.state, self.plant.layout
        safe = safe_command(layout, state.joint_q[None], state.joint_qd[None], self.plant.scene.timing.control_dt)[0]
        return bool(np.allclose(self.control, np.clip(safe, layout.control_lower, layout.control_upper), atol=1e-6))


def main() -> None:
    """Be the robot until the order to end or a signal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--zmq", type=int, metavar="PORT")
    parser.add_argument("--ros2", action="store_true")
    parser.add_argument("--topics", type=Path, metavar="FILE")
    parser.add_argument("--orders", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds in a second")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--delay", type=float, nargs=2, default=(0.0, 0.0), metavar="MS", help="between these, both ways"
    )
    parser.add_argument("--drop", type=float, default=0.0, help="share of messages that is lost, both ways")
    options = parser.parse_args()
    scene = load_scene(options.scene, overrides=options.set)
    connect = transport_of(scene, zmq=options.zmq, ros2=options.ros2, topics=options.topics)
    keys = {"seed": options.seed, "speed": options.speed}
    if options.orders:
        drilled = DrilledRobot(scene, lambda layout: SpoiltTransport(connect(layout)), **keys)
        drilled.run(lambda: drilled.over)
        return
    link = {"delay": tuple(1e-3 * bound for bound in options.delay), "drop": options.drop, **keys}
    with results_only() as out, suppress(KeyboardInterrupt), Interrupts() as interrupts:
        robot = MonitoredProcess(scene, lambda layout: FaultyLink(connect(layout), **link), **keys)
        with suppress(KeyboardInterrupt):
            robot.run(interrupts.check)
        print(json.dumps(robot.told()), file=out, flush=True)


if __name__ == "__main__":
    main()
