"""Text files as a sliding buffer of bytes for the scanning kernels, in bounded memory."""

import codecs
from collections.abc import Iterable
from io import FileIO
from pathlib import Path

import numpy as np

from penumbra.arrays import Float64Array, Int64Array, UInt8Array
from penumbra.errors import MeshError

# A word that does not fit is no number and no index; the limit keeps a text without blanks from
# being read into memory as one word.
_LONGEST_WORD_BYTES = 1 << 20

# Two newlines close the last statement of a text that ends without one, even after a final `\`.
_CLOSING = b"\n\n"
N_CLOSING_LINES = len(_CLOSING)

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


class TextBlocks:
    """A window that slides over a text: `buffer[:end]`, refilled in place.

    Single-byte text (ASCII, Latin-1, UTF-8) passes unchanged. UTF-16, known by its byte-order mark,
    becomes Latin-1, with `?` for what Latin-1 lacks: only names and comments hold such characters.
    """

    def __init__(self, path: Path, start: int = 0, block_bytes: int = 1 << 20) -> None:
        """Open `path` at byte `start`; `block_bytes` is the size of the buffer. Raises OSError."""
        self.path = path
        self.end = 0
        self.bytes_done = start
        self._block_bytes = max(1, block_bytes)
        self.buffer: UInt8Array = np.empty(self._block_bytes + len(_CLOSING), np.uint8)
        self._file = FileIO(path)
        self._decoder: codecs.IncrementalDecoder | None = None
        self._closed_text = False
        self._file.seek(start)
        if start == 0:
            self._skip_byte_order_mark()

    def _skip_byte_order_mark(self) -> None:
        head = self._file.read(4)
        mark, encoding = next(((m, e) for m, e in _BYTE_ORDER_MARKS if head.startswith(m)), (b"", ""))
        self._file.seek(len(mark))
        self.bytes_done = len(mark)
        if encoding.startswith("utf-16"):
            self._decoder = codecs.getincrementaldecoder(encoding)(errors="replace")

    def refill(self, consumed: int) -> bool:
        """Drop `buffer[:consumed]`, move the rest to the front, read on behind it.

        Returns False at the end of the text. Raises MeshError for an endless word, OSError.
        """
        left = self.end - consumed
        self.buffer[:left] = self.buffer[consumed : self.end]
        self.end = left
        if left >= self._block_bytes:
            self._grow()
        if self._closed_text:
            return False
        fresh = self._read(self._block_bytes - left)
        if fresh == 0:
            self.buffer[left : left + len(_CLOSING)] = np.frombuffer(_CLOSING, np.uint8)
            fresh = len(_CLOSING)
            self._closed_text = True
        self.end = left + fresh
        return True

    def _grow(self) -> None:
        if self._block_bytes > _LONGEST_WORD_BYTES:
            raise MeshError(
                f"{self.path}, before byte {self.bytes_done}: a word is longer than {_LONGEST_WORD_BYTES} "
                "bytes, so this is not a mesh in text form."
            )
        self._block_bytes *= 2
        larger = np.empty(self._block_bytes + len(_CLOSING), np.uint8)
        larger[: self.end] = self.buffer[: self.end]
        self.buffer = larger

    def _read(self, room: int) -> int:
        """Read at most `room` bytes of text behind `end`; 0 at the end of the file."""
        if self._decoder is None:
            n_bytes = self._file.readinto(self.buffer[self.end : self.end + room].data)
            self.bytes_done += n_bytes
            return n_bytes
        while True:
            raw = self._file.read(room)
            self.bytes_done += len(raw)
            text = self._decoder.decode(raw, final=not raw).encode("latin-1", errors="replace")
            if text or not raw:
                self.buffer[self.end : self.end + len(text)] = np.frombuffer(text, np.uint8)
                return len(text)

    def offset_of(self, pos: int) -> int:
        """Byte offset in the file of `buffer[pos]`, for text that is not UTF-16."""
        closing = len(_CLOSING) if self._closed_text else 0
        return self.bytes_done - (self.end - closing - pos)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_undecided(text: UInt8Array, spans: Int64Array, out: Float64Array) -> None:
    """Read what a scanning kernel left undecided: rows (row, column, begin, end) into `out[row, column]`."""
    rows: Iterable[list[int]] = spans.tolist()
    for row, column, begin, end in rows:
        out[row, column] = _read_word(text[begin:end].tobytes().decode("latin-1"))


def _read_word(word: str) -> float:
    """Value of a decimal or hexadecimal word, NaN when it is neither."""
    try:
        return float.fromhex(word) if "x" in word.lower() else float(word)
    except OverflowError:
        return float("inf")
    except ValueError:
        return float("nan")
