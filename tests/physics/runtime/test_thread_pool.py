# SPDX-License-Identifier: Apache-2.0
"""Threads that share sequences of launches: each is run once, errors are told, and the threads end."""

import gc
import threading
import time

import numpy as np
import pytest
import warp as wp

from warpmpc.physics.runtime.launch import CapturedLaunches, Launcher
from warpmpc.physics.runtime.thread_pool import ThreadPool

launch = Launcher("cpu")


@wp.kernel
def work_kernel(
    # inputs
    part: int,
    rounds: int,
    # outputs
    count: wp.array[int],
    sink: wp.array[float],
):
    """Count one part, after some work."""
    x = float(part)
    for _ in range(rounds):
        x = wp.sin(x) + 1.0
    sink[part] = x
    count[part] = count[part] + 1


class Parts:
    """Parts that count how often they were run; one of them may take longer."""

    def __init__(self, parts: int, *, slow: int | None = None):
        self.count = wp.zeros(parts, dtype=int, device="cpu")
        sink = wp.zeros(parts, dtype=float, device="cpu")

        def sequence(part: int):
            inputs = [part, 3_000_000 if part == slow else 1000]
            return lambda: launch(work_kernel, 1, inputs, [self.count, sink])

        self.replays = [CapturedLaunches(sequence(part)) for part in range(parts)]


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("parts", [1, 3, 40])
def test_every_part_is_done_once(threads, parts):
    pool, work = ThreadPool(threads, parts), Parts(parts)
    for n in range(1, 50):
        pool.run(work.replays)
        np.testing.assert_array_equal(work.count.numpy(), n)
        assert np.all((pool.thread >= 0) & (pool.thread < threads))
    pool.close()


def test_a_slow_part_does_not_hold_up_the_rest():
    pool, work = ThreadPool(2, 21), Parts(21, slow=0)
    for _ in range(3):
        pool.run(work.replays)
    assert np.sum(pool.thread == pool.thread[0]) < 11
    np.testing.assert_array_equal(work.count.numpy(), 3)
    pool.close()


@pytest.mark.parametrize("threads", [1, 3])
def test_other_sequences_may_be_handed_over(threads):
    pool, first, second = ThreadPool(threads, 6), Parts(6), Parts(6)
    for n in range(1, 6):
        pool.run(first.replays)
        pool.run(second.replays)
        np.testing.assert_array_equal(first.count.numpy(), n)
        np.testing.assert_array_equal(second.count.numpy(), n)
    pool.close()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_an_error_in_a_part_is_raised_and_the_pool_goes_on(threads):
    pool, work = ThreadPool(threads, 8), Parts(8)

    def fail() -> None:
        raise ZeroDivisionError("part three")

    replays = [*work.replays[:3], CapturedLaunches(fail), *work.replays[4:]]
    for _ in range(3):
        with pytest.raises(ZeroDivisionError, match="part three"):
            pool.run(replays)
    before = work.count.numpy().copy()
    for _ in range(3):
        pool.run(work.replays)
    assert work.count.numpy()[7] == before[7] + 3
    assert work.count.numpy()[3] == 3
    pool.close()


@pytest.mark.parametrize("close", [True, False], ids=["closed", "dropped"])
def test_the_threads_end_with_the_pool(close):
    before = set(threading.enumerate())
    pool = ThreadPool(5, 10)
    mine = set(threading.enumerate()) - before
    assert len(mine) == 4
    work = Parts(10)
    for _ in range(3):
        pool.run(work.replays)
    if close:
        pool.close()
        pool.close()
    else:
        del pool
        gc.collect()
    end = time.perf_counter() + 5.0
    while any(thread.is_alive() for thread in mine) and time.perf_counter() < end:
        time.sleep(0.01)
    assert not any(thread.is_alive() for thread in mine)
