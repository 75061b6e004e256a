# SPDX-License-Identifier: Apache-2.0
"""A link with faults loses, delays and reorders as many messages as it is told to, and none without."""

import numpy as np
import pytest
from shared import faulty_link as link
from shared.faulty_link import FaultyLink

from warpmpc import State
from warpmpc.loop.robots.safety import Command


class Perfect:
    """A transport that hands over at once what is in its lists."""

    def __init__(self):
        self.published, self.commands = [], []

    def publish(self, state):
        self.published.append(state.time)

    def receive(self, now):
        came, self.commands = self.commands, []
        return came


class Clock:
    now = 100.0

    def monotonic(self):
        return self.now


def through(monkeypatch, *, speed: float = 1.0, count: int = 2000, **faults) -> tuple[np.ndarray, np.ndarray]:
    """Stamps of states and of commands in the order in which they came, by rows: stamp, when it came."""
    clock, transport = Clock(), Perfect()
    monkeypatch.setattr(link, "time", clock)
    faulty = FaultyLink(transport, seed=3, speed=speed, **faults)
    states, commands = [], []
    for tick in range(count + 200):
        clock.now = 100.0 + 0.002 * tick / speed
        if tick < count:
            faulty.publish(State(np.zeros(1), np.zeros(1), time=0.002 * tick))
            transport.commands = [Command(np.zeros(1), 0.002 * tick, "a")]
        else:
            faulty._drop = 1.0  # what is sent now only moves the rest on
            faulty.publish(State(np.zeros(1), np.zeros(1), time=0.0))
        states += [(stamp, 0.002 * tick) for stamp in transport.published]
        transport.published = []
        commands += [(command.stamp, 0.002 * tick) for command in faulty.receive(0.002 * tick)]
    return np.array(states), np.array(commands)


def test_a_good_link_changes_nothing(monkeypatch):
    for came in through(monkeypatch):
        np.testing.assert_allclose(came[:, 0], 0.002 * np.arange(2000))
        np.testing.assert_allclose(came[:, 1], came[:, 0])


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_messages_are_lost(monkeypatch, share):
    for came in through(monkeypatch, drop=share):
        assert 1.0 - len(came) / 2000 == pytest.approx(share, abs=0.03)
        assert (np.diff(came[:, 0]) > 0.0).all()


@pytest.mark.parametrize("speed", [1.0, 0.25])
def test_messages_are_late_on_the_robots_clock_and_then_not_in_order(monkeypatch, speed):
    for came in through(monkeypatch, delay=(0.02, 0.08), speed=speed):
        late = came[:, 1] - came[:, 0]
        assert len(came) == 2000
        assert 0.02 <= late.min() < 0.025
        assert 0.075 < late.max() <= 0.0821
        assert (np.diff(came[:, 0]) < 0.0).any()


def test_messages_are_overtaken(monkeypatch):
    for came in through(monkeypatch, reorder=0.1):
        late = came[:, 1] - came[:, 0]
        assert len(came) == 2000
        assert np.mean(late > 0.009) == pytest.approx(0.1, abs=0.03)
        assert (np.diff(came[:, 0]) < 0.0).mean() > 0.04
