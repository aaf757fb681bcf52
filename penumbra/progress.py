"""How long work reports how far it is: nowhere, as a bar on a terminal, or as lines in a log."""

import sys
import threading
import time
from abc import ABC, abstractmethod
from typing import Protocol, TextIO

from penumbra.memory import format_bytes

_BAR_CELLS = 24
_BAR_INTERVAL = 0.1
_LOG_INTERVAL = 10.0


class Progress(Protocol):
    """What library code calls; `advance` may come from any thread."""

    def stage(self, name: str, total: float | None, unit: str) -> None:
        """Begin a stage of `total` units (None: unknown), ending the last one.

        A unit is such as "B" (bytes) or "triangles"; "" is for stages that count nothing.
        """

    def advance(self, amount: float) -> None:
        """So many more units of the stage are done."""

    def close(self) -> None:
        """End the last stage."""


class NullProgress:
    """Reports nothing."""

    def stage(self, name: str, total: float | None, unit: str) -> None:
        """Report nothing."""
        return

    def advance(self, amount: float) -> None:
        """Report nothing."""
        return

    def close(self) -> None:
        """Report nothing."""
        return


class RepeatedStage:
    """Work that is done `n_times` over, shown as one stage of so many times the amount."""

    def __init__(self, progress: Progress, n_times: int) -> None:
        self._progress = progress
        self._n_times = n_times
        self._begun = False

    def stage(self, name: str, total: float | None, unit: str) -> None:
        """Begin the stage, the first time."""
        if not self._begun:
            self._begun = True
            self._progress.stage(name, None if total is None else total * self._n_times, unit)

    def advance(self, amount: float) -> None:
        """Pass on."""
        self._progress.advance(amount)

    def close(self) -> None:
        """Pass on."""
        self._progress.close()


class _StreamProgress(ABC):
    """Keeps count of the current stage and writes about it at most every `_interval` seconds."""

    _interval: float

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._lock = threading.Lock()
        self._name: str | None = None
        self._total: float | None = None
        self._unit = ""
        self._done = 0.0
        self._began = self._written = 0.0

    def stage(self, name: str, total: float | None, unit: str) -> None:
        """Begin a stage, ending the last one."""
        with self._lock:
            self._end()
            self._name, self._total, self._unit, self._done = name, total, unit, 0.0
            self._began = self._written = time.monotonic()
            self._write_running()

    def advance(self, amount: float) -> None:
        """Count, and write if it is time to."""
        with self._lock:
            self._done += amount
            now = time.monotonic()
            if self._name is not None and now - self._written >= self._interval:
                self._written = now
                self._write_running()

    def close(self) -> None:
        """End the last stage."""
        with self._lock:
            self._end()

    def abandon(self) -> None:
        """Leave the last stage without a word that it ended: the work has failed."""
        with self._lock:
            if self._name is not None:
                self._write_abandoned()
                self._name = None

    def _end(self) -> None:
        if self._name is not None:
            amount = f"{self._amount()}, " if self._unit else ""
            self._write_ended(f"{self._name}: {amount}{time.monotonic() - self._began:.1f} s")
            self._name = None

    def _fraction(self) -> float | None:
        return min(self._done / self._total, 1.0) if self._total else None

    def _amount(self) -> str:
        return format_amount(self._done, self._unit)

    @abstractmethod
    def _write_running(self) -> None:
        """Write where the stage is now."""

    @abstractmethod
    def _write_ended(self, line: str) -> None:
        """Write that the stage is over; `line` says what was done in which time."""

    @abstractmethod
    def _write_abandoned(self) -> None:
        """Leave the stream fit for an error message."""

    def _put(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class TerminalProgress(_StreamProgress):
    """One bar that is redrawn in place, and one line left behind for each stage."""

    _interval = _BAR_INTERVAL

    def _write_running(self) -> None:
        fraction = self._fraction()
        bar = ""
        if fraction is not None:
            bar = f"[{'#' * round(fraction * _BAR_CELLS):<{_BAR_CELLS}}] {fraction:4.0%} "
        self._put(f"\r\x1b[K{self._name} {bar}{self._amount() if self._unit else ''}")

    def _write_ended(self, line: str) -> None:
        self._put(f"\r\x1b[K{line}\n")

    def _write_abandoned(self) -> None:
        self._put("\n")


class LogProgress(_StreamProgress):
    """One line when a stage begins and ends, and one every ten seconds between."""

    _interval = _LOG_INTERVAL

    def _write_running(self) -> None:
        fraction = self._fraction()
        share = "" if fraction is None else f" {fraction:.1%}"
        self._put(f"progress: {self._name}{share}\n")

    def _write_ended(self, line: str) -> None:
        self._put(f"done: {line}\n")

    def _write_abandoned(self) -> None:
        return


def format_amount(amount: float, unit: str) -> str:
    """An amount with its unit: bytes ("B") in binary multiples, everything else as a whole number."""
    return format_bytes(int(amount)) if unit == "B" else f"{amount:,.0f} {unit}".rstrip()
