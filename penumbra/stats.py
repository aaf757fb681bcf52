"""Counters and seconds of a run: what every result carries, and what scaling plots are drawn from."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from penumbra.memory import peak_bytes

# Present in every result, so that a consumer need not ask which backend made it.
_ALWAYS = (
    "pairs_tested",
    "nodes_visited",
    "bytes_read",
    "bytes_skipped",
    "escalated_f64",
    "escalated_exact",
)


@dataclass
class Stats:
    """Counters (integers) and seconds by stage of one run, or of several added up."""

    backend: str
    counters: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    """By stage; stages do not overlap, so that their sum is the time of all."""
    step_seconds: dict[str, float] = field(default_factory=dict)
    """By step, `<stage>_<step>`: parts of `seconds[stage]`, never to be added to it."""
    most: dict[str, int] = field(default_factory=dict)

    def count(self, name: str, amount: int) -> None:
        """Add to a counter."""
        self.counters[name] = self.counters.get(name, 0) + int(amount)

    def count_most(self, name: str, amount: int) -> None:
        """Raise a counter to an amount; `merge` keeps the larger one of two."""
        self.most[name] = max(self.most.get(name, 0), int(amount))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of the body to `seconds[stage]`."""
        began = time.perf_counter()
        try:
            yield
        finally:
            _add(self.seconds, stage, time.perf_counter() - began)

    @contextmanager
    def timed_step(self, stage: str, step: str) -> Iterator[None]:
        """Add the wall time of the body, which is inside of `timed(stage)`, to a step of the stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            _add(self.step_seconds, f"{stage}_{step}", time.perf_counter() - began)

    def merge(self, other: "Stats") -> None:
        """Add the counters and seconds of another run."""
        for name, amount in other.counters.items():
            self.count(name, amount)
        for name, amount in other.most.items():
            self.count_most(name, amount)
        for stage, seconds in other.seconds.items():
            _add(self.seconds, stage, seconds)
        for step, seconds in other.step_seconds.items():
            _add(self.step_seconds, step, seconds)

    def as_dict(self) -> dict[str, Any]:
        """One flat dictionary: backend, seconds of stages and steps, counters, peak_bytes of the process."""
        flat: dict[str, Any] = {"backend": self.backend}
        times = self.seconds | self.step_seconds
        flat |= {f"seconds_{name}": round(seconds, 6) for name, seconds in times.items()}
        flat |= dict.fromkeys(_ALWAYS, 0) | self.counters | self.most
        return flat | {"peak_bytes": peak_bytes()}


def _add(times: dict[str, float], name: str, seconds: float) -> None:
    times[name] = times.get(name, 0.0) + seconds
