"""Run one function over many items, on the calling thread or on several; the kernels release the GIL."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from typing import TypeVar

from penumbra.errors import SceneError

# More gain nothing anywhere, and systems refuse to start thousands.
_MOST_THREADS = 1024

Item = TypeVar("Item")
Result = TypeVar("Result")


def resolve_threads(threads: int) -> int:
    """Number of threads to use: `threads`, or every core this process may use when it is 0.

    Raises SceneError when `threads` is negative.
    """
    if threads < 0:
        raise SceneError(f"threads is {threads}: use 0 for all cores, or a positive number")
    if threads:
        return min(threads, _MOST_THREADS)
    # The affinity mask and not cpu_count: under SLURM or `taskset` the machine has more than we may use.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_tasks(task: Callable[[Item], Result], items: Iterable[Item], threads: int) -> list[Result]:
    """Return `[task(item) for item in items]`, computed by `threads` threads (0: all cores).

    Items are taken from one queue in order, so uneven ones balance. The first error drops what is
    still queued, waits for what runs, and is raised (the one of the earliest item if several failed);
    so does an exception in the waiting thread itself, such as KeyboardInterrupt.
    """
    work = list(items)
    threads = min(resolve_threads(threads), len(work))
    if threads <= 1:
        return [task(item) for item in work]
    with ThreadPoolExecutor(max_workers=threads, thread_name_prefix="penumbra") as pool:
        futures: list[Future[Result]] = []
        try:
            futures.extend(pool.submit(task, item) for item in work)
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            # Without this, leaving the `with` would first run everything that is still queued.
            pool.shutdown(wait=False, cancel_futures=True)
    for future in futures:
        if not future.cancelled() and (error := future.exception()) is not None:
            raise error
    return [future.result() for future in futures]
