"""What can go wrong, as exceptions; every message is one sentence: what, where, what to do.

PenumbraError                       exit code 1
 +-- SceneError(ValueError)         a scene file or an argument is not usable
 +-- MeshError(ValueError)          a mesh file cannot be read
 +-- BlockerStoreError(OSError)     a blocker store cannot be read or written
 +-- OutputError(OSError)           an output cannot be written
 +-- BackendError(RuntimeError)     the casting backend cannot do what was asked
 +-- MemoryLimitError(MemoryError)  the plan does not fit the memory limit; exit code 3
 +-- Interrupted                    stopped by a signal; exit code 75 (SIGTERM) or 130 (Ctrl-C)
"""


class PenumbraError(Exception):
    """Root of all errors that penumbra raises on purpose."""

    exit_code = 1


class SceneError(PenumbraError, ValueError):
    """A scene file or an argument is not usable."""


class MeshError(PenumbraError, ValueError):
    """A mesh file cannot be read: the message names the file and the line or byte."""


class BlockerStoreError(PenumbraError, OSError):
    """A blocker store is missing, foreign, damaged or of another version."""


class OutputError(PenumbraError, OSError):
    """An output cannot be written, or is already there."""


class BackendError(PenumbraError, RuntimeError):
    """The casting backend cannot do what was asked."""


class MemoryLimitError(PenumbraError, MemoryError):
    """The plan does not fit the memory limit; the message says which limit would do."""

    exit_code = 3

    def __init__(self, message: str, enough_bytes: int | None = None) -> None:
        """`enough_bytes`: the limit that would do, where it is known."""
        super().__init__(message)
        self.enough_bytes = enough_bytes


class Interrupted(PenumbraError):
    """A signal stopped the run; `exit_code` says which (75: SIGTERM, 130: Ctrl-C)."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code
