"""Progress of work inside other work."""

from penumbra.progress import Progress


class Prefixed:
    """Passes on what it is told, with a few words before the name of every stage."""

    def __init__(self, progress: Progress, prefix: str) -> None:
        self._progress = progress
        self._prefix = prefix

    def stage(self, name: str, total: float | None, unit: str) -> None:
        """Begin a stage."""
        self._progress.stage(f"{self._prefix}: {name}", total, unit)

    def advance(self, amount: float) -> None:
        """Pass on."""
        self._progress.advance(amount)

    def close(self) -> None:
        """Pass on."""
        self._progress.close()
