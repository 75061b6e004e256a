# SPDX-License-Identifier: Apache-2.0
"""The newest numbers of another process: whole or not at all, and whatever dies on the way."""

import multiprocessing
import threading

import numpy as np
import pytest

from warpmpc.realtime.mailbox import Mailbox


@pytest.fixture
def mailbox() -> Mailbox:
    return Mailbox(multiprocessing.get_context("spawn"), 500)


def test_the_newest_letter_is_read_once(mailbox):
    assert mailbox.read() is None
    for value in range(5):
        mailbox.write(np.full(3, value))
    np.testing.assert_array_equal(mailbox.read(), [4.0, 4.0, 4.0])
    assert mailbox.read() is None


def test_a_letter_that_was_half_written_when_its_writer_died_is_not_read(mailbox):
    mailbox.write(np.arange(4.0))
    mailbox.read()
    mailbox.write(np.arange(8.0))
    place = np.frombuffer(mailbox._places[0])  # where the second letter is
    place[5] = 99.0
    assert mailbox.read() is None
    mailbox.write(np.arange(2.0))
    np.testing.assert_array_equal(mailbox.read(), [0.0, 1.0])


def test_a_writer_that_is_started_again_goes_on_where_the_other_died(mailbox):
    for _ in range(3):
        mailbox.write(np.zeros(1))
    mailbox.read()
    other = Mailbox.__new__(Mailbox)
    other.__dict__.update(mailbox.__getstate__())
    other.write(np.ones(1))
    np.testing.assert_array_equal(mailbox.read(), [1.0])


def test_what_is_read_while_it_is_written_is_never_a_mixture(mailbox):
    stop = threading.Event()

    def write() -> None:
        value = 0.0
        while not stop.is_set():
            value += 1.0
            mailbox.write(np.full(500, value))

    writer = threading.Thread(target=write)
    writer.start()
    letters = []
    while len(letters) < 30:
        letter = mailbox.read()
        if letter is not None:
            letters.append(letter)
    stop.set()
    writer.join()
    assert all((letter == letter[0]).all() for letter in letters)
    newest = [letter[0] for letter in letters]
    assert newest == sorted(newest)


def test_a_letter_that_does_not_fit_is_refused(mailbox):
    with pytest.raises(ValueError, match="501 numbers does not fit"):
        mailbox.write(np.zeros(501))
