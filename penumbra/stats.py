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
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began

    def merge(self, other: "Stats") -> None:
        """Add the counters and seconds of another run."""
        for name, amount in other.counters.items():
            self.count(name, amount)
        for name, amount in other.most.items():
            self.count_most(name, amount)
        for stage, seconds in other.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    def as_dict(self) -> dict[str, Any]:
        """One flat dictionary: backend, seconds_<stage>, the counters, peak_bytes of the process."""
        flat: dict[str, Any] = {"backend": self.backend}
        flat |= {f"seconds_{stage}": round(seconds, 6) for stage, seconds in self.seconds.items()}
        flat |= dict.fromkeys(_ALWAYS, 0) | self.counters | self.most
        return flat | {"peak_bytes": peak_bytes()}
