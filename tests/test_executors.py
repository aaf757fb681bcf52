"""One function over many items: the same results for any number of threads, errors and stops included."""

import os
import threading
import time

import pytest

from penumbra.executors.threads import resolve_threads, run_tasks


@pytest.mark.parametrize("threads", [0, 1, 2, 7])
def test_results_are_in_order(threads):
    def square(number):
        time.sleep(0.001 * (number % 3))
        return number * number

    assert run_tasks(square, iter(range(20)), threads) == [number * number for number in range(20)]


@pytest.mark.parametrize("threads", [1, 3])
def test_nothing_to_do(threads):
    assert run_tasks(str, [], threads) == []


def test_one_thread_is_the_calling_thread():
    assert run_tasks(lambda _: threading.current_thread(), [0, 1], 1) == [threading.current_thread()] * 2


def test_several_threads_work_at_once():
    together = threading.Barrier(3, timeout=20)
    assert run_tasks(lambda _: together.wait() >= 0, range(3), 3) == [True] * 3


@pytest.mark.parametrize("threads", [1, 2])
def test_the_first_error_drops_what_is_queued(threads):
    done = []

    def work(number):
        if number == 2:
            raise ValueError("item 2")
        time.sleep(0.01)
        done.append(number)

    with pytest.raises(ValueError, match="item 2"):
        run_tasks(work, range(500), threads)
    assert len(done) < 50


def test_the_earliest_of_several_errors_is_raised():
    together = threading.Barrier(2, timeout=20)

    def work(number):
        together.wait()
        raise ValueError(f"item {number}")

    with pytest.raises(ValueError, match="item 0"):
        run_tasks(work, range(2), 2)


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_stops_at_the_next_item(threads):
    started = []

    def work(number):
        started.append(number)
        if number == 1:
            # What the signal handler does in the main thread, which waits for the tasks meanwhile.
            os.kill(os.getpid(), 2)
        time.sleep(0.02)

    with pytest.raises(KeyboardInterrupt):
        run_tasks(work, range(200), threads)
    assert len(started) < 50
    deadline = time.monotonic() + 20
    while any(thread.name.startswith("penumbra") for thread in threading.enumerate()):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_resolve_threads():
    assert resolve_threads(3) == 3
    assert resolve_threads(100_000) <= 1024
    assert resolve_threads(0) == len(os.sched_getaffinity(0))
    with pytest.raises(ValueError, match="threads is -1"):
        resolve_threads(-1)
