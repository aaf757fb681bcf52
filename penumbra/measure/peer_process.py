"""A peer in a process of its own: asked by lines of JSON on stdin, answering by lines on stdout.

Each side of a comparison gets its own process, so that its processor time and peak memory are its own and
Embree's floating-point modes stay with Embree.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from penumbra.errors import BackendError, PenumbraError
from penumbra.measure.cost import measured

Answer = dict[str, Any]


class PeerProcess:
    """A child that runs a module's `serve` loop; leaving the `with` ends it."""

    def __init__(self, module: str) -> None:
        """Start `python -m module`; its errors go to our stderr."""
        self._module = module
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        # -P: a folder named penumbra where the user stands must not be taken for this package.
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )

    def __enter__(self) -> "PeerProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if value is not None:
            self._child.kill()
        for stream in (self._child.stdin, self._child.stdout):
            assert stream is not None
            # What a dead child has not read is of no use to anybody.
            with contextlib.suppress(BrokenPipeError):
                stream.close()
        self._child.wait()

    def ask(self, command: str, **arguments: Any) -> Answer:
        """Run a command in the child and return what it answers.

        Raises BackendError with the child's message when it fails or ends.
        """
        assert self._child.stdin is not None and self._child.stdout is not None
        try:
            print(json.dumps({"command": command, **arguments}), file=self._child.stdin, flush=True)
            line = self._child.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            code = self._child.wait()
            raise BackendError(
                f"the process of {self._module} ended with code {code} while asked to {command}"
            )
        answer: Answer = json.loads(line)
        if "error" in answer:
            raise BackendError(answer["error"])
        return answer


def serve(commands: Mapping[str, Callable[..., Answer]]) -> None:
    """Answer commands until stdin ends; what fails is answered as `error`."""
    # What a library prints must not end up among the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = commands[request.pop("command")](**request)
        except (PenumbraError, OSError, MemoryError) as problem:
            answer = {"error": str(problem) or type(problem).__name__}
        print(json.dumps(answer), file=answers, flush=True)


def costed(work: Callable[[], Answer]) -> Answer:
    """What `work` answers, with what it cost: the fields of `Cost`."""
    answer, cost = measured(work)
    return answer | cost._asdict()
