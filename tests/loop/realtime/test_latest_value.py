# SPDX-License-Identifier: Apache-2.0
"""The newest numbers of another process: whole or not at all, and whatever dies on the way."""

import multiprocessing
import threading

import numpy as np
import pytest

from warpmpc.loop.realtime.messages import LatestValue


@pytest.fixture
def buffer() -> LatestValue:
    return LatestValue(multiprocessing.get_context("spawn"), 500)


def test_the_newest_letter_is_read_once(buffer):
    assert buffer.read() is None
    for value in range(5):
        buffer.write(np.full(3, value))
    np.testing.assert_array_equal(buffer.read(), [4.0, 4.0, 4.0])
    assert buffer.read() is None


def test_a_letter_that_was_half_written_when_its_writer_died_is_not_read(buffer):
    buffer.write(np.arange(4.0))
    buffer.read()
    buffer.write(np.arange(8.0))
    place = np.frombuffer(buffer._places[0])  # where the second message is
    place[5] = 99.0
    assert buffer.read() is None
    buffer.write(np.arange(2.0))
    np.testing.assert_array_equal(buffer.read(), [0.0, 1.0])


def test_a_writer_that_is_started_again_goes_on_where_the_other_died(buffer):
    for _ in range(3):
        buffer.write(np.zeros(1))
    buffer.read()
    other = LatestValue.__new__(LatestValue)
    other.__dict__.update(buffer.__getstate__())
    other.write(np.ones(1))
    np.testing.assert_array_equal(buffer.read(), [1.0])


def test_what_is_read_while_it_is_written_is_never_a_mixture(buffer):
    stop = threading.Event()

    def write() -> None:
        value = 0.0
        while not stop.is_set():
            value += 1.0
            buffer.write(np.full(500, value))

    writer = threading.Thread(target=write)
    writer.start()
    messages = []
    while len(messages) < 30:
        message = buffer.read()
        if message is not None:
            messages.append(message)
    stop.set()
    writer.join()
    assert all((message == message[0]).all() for message in messages)
    newest = [message[0] for message in messages]
    assert newest == sorted(newest)


def test_a_letter_that_does_not_fit_is_refused(buffer):
    with pytest.raises(ValueError, match="501 numbers does not fit"):
        buffer.write(np.zeros(501))
