"""What a piece of work costs: wall and processor seconds, and the memory that it needs at its peak."""

import time
from collections.abc import Callable
from typing import NamedTuple, ParamSpec, TypeVar

from penumbra.memory import give_back, peak_bytes, reset_peak, resident_bytes

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")


class Cost(NamedTuple):
    """The cost of one call."""

    seconds: float
    """Wall time."""
    cpu_seconds: float
    """Processor time of all threads."""
    peak_bytes: int
    """Highest resident memory of the process during the call; since its start if `peak_is_own` is False."""
    added_bytes: int | None
    """How far the peak rose above what was resident before the call; None where the peak is not its own."""
    peak_is_own: bool
    """Whether the system could start the peak anew for this call."""


def measured(
    work: Callable[Arguments, Value], *arguments: Arguments.args, **named: Arguments.kwargs
) -> tuple[Value, Cost]:
    """Call `work` and return what it returns with what it cost."""
    # What an earlier call freed and malloc kept would hide part of what this one needs.
    give_back()
    peak_is_own = reset_peak()
    before = resident_bytes()
    cpu_began, began = time.process_time(), time.perf_counter()
    value = work(*arguments, **named)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
    peak = peak_bytes()
    added = max(0, peak - before) if peak_is_own else None
    return value, Cost(seconds, cpu_seconds, peak, added, peak_is_own)
