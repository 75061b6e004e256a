# SPDX-License-Identifier: Apache-2.0
"""Threads that share parts of the worlds: each part once, errors are told, and the threads end."""

import threading
import time
from collections import Counter

import pytest

from warpmpc.engine.crew import Crew


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("parts", [0, 1, 3, 40])
def test_every_part_is_done_once(threads, parts):
    crew = Crew(threads)
    for _ in range(20):
        done, lock = [], threading.Lock()

        def work(part: int, thread: int, done=done, lock=lock) -> None:
            assert 0 <= thread < threads
            with lock:
                done.append(part)

        crew.run(parts, work)
        assert Counter(done) == Counter(range(parts))
    crew.close()


def test_a_slow_part_does_not_hold_up_the_rest():
    crew, who = Crew(3), {}

    def work(part: int, thread: int) -> None:
        who[part] = thread
        time.sleep(0.3 if part == 0 else 0.005)

    start = time.perf_counter()
    crew.run(21, work)
    assert time.perf_counter() - start < 0.4
    assert list(who.values()).count(who[0]) < 7
    crew.close()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_an_error_in_a_part_is_raised_and_the_crew_goes_on(threads):
    crew = Crew(threads)

    def fail(part: int, thread: int) -> None:
        if part == 3:
            raise ZeroDivisionError("part three")

    done = []
    for n in range(1, 4):
        with pytest.raises(ZeroDivisionError, match="part three"):
            crew.run(8, fail)
        crew.run(8, lambda part, _: done.append(part))
        assert sorted(done) == sorted(n * list(range(8)))
    crew.close()


def test_close_ends_the_threads():
    before = set(threading.enumerate())
    crew = Crew(5)
    mine = set(threading.enumerate()) - before
    assert len(mine) == 4
    crew.run(10, lambda part, thread: None)
    crew.close()
    for thread in mine:
        thread.join(timeout=5.0)
    assert not any(thread.is_alive() for thread in mine)
