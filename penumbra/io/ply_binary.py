"""The data part of a binary PLY file: vertices, faces and strips, read block by block."""

from collections.abc import Callable, Iterator
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Int64Array, UInt8Array
from penumbra.errors import MeshError
from penumbra.io.faces import LARGEST_FACE, PAGE_FACES, FacePage
from penumbra.io.ply_header import Element, Header, Property, Truncated, index_list
from penumbra.io.ply_strips import StripStream
from penumbra.kernels.index_codes import UNREADABLE_INDEX

# Damaged files claim lists of any length; no honest element comes near this.
_LARGEST_ELEMENT_BYTES = 64 << 20

_KINDS = {"u": 0, "i": 1, "f": 2}  # as `kernels.ply_lists` numbers them


class _Found(NamedTuple):
    """What a block of the file gave."""

    content: Any
    n_elements: int
    n_bytes: int  # of these elements
    needed: int  # bytes that the element behind them is known to need


class BinaryPly:
    """The elements of a binary PLY file; where an element begins is found when it is asked for."""

    def __init__(self, path: Path, header: Header, size_bytes: int, block_bytes: int) -> None:
        self.bytes_done = 0
        self._path = path
        self._header = header
        self._size_bytes = size_bytes
        self._block_bytes = block_bytes
        self._starts = [header.data_offset]
        self._file = FileIO(path)
        self._buffer: UInt8Array = np.empty(block_bytes, np.uint8)

    def place(self, where: int) -> str:
        """Name a face, or a strip, by its number."""
        name, number = ("strip", -1 - where) if where < 0 else ("face", where)
        return f"{name} {number} (counted from 0)"

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def vertices(self) -> Iterator[NDArray[np.floating]]:
        """Coordinates of the vertices, shape (n, 3), in the order of the file."""
        position = self._header.vertex_position
        element = self._header.elements[position]
        axes = [element.position_of(axis) for axis in "xyz"]
        dtype = np.float32 if self._header.has_float32_vertices else np.float64

        def read_fixed(data: UInt8Array, done: int) -> _Found:
            record = self._record(element)
            n_rows = min(len(data) // record.itemsize, element.count - done)
            rows = data[: n_rows * record.itemsize].view(record)
            out = np.empty((n_rows, 3), dtype)
            for axis, number in enumerate(axes):
                out[:, axis] = rows[f"value{number}"]
            return _Found(out, n_rows, n_rows * record.itemsize, record.itemsize)

        def read_scattered(data: UInt8Array, done: int) -> _Found:
            found, offsets, _ = self._find(element, data, done, axes, -1)
            out = np.empty((found.n_elements, 3), dtype)
            for axis, number in enumerate(axes):
                value_type = self._stored(element.properties[number].value_type)
                spans = offsets[:, axis, None] + np.arange(value_type.itemsize)
                out[:, axis] = data[spans].view(value_type)[:, 0]
            return found._replace(content=out)

        yield from self._blocks(position, read_scattered if element.has_lists else read_fixed)

    def faces(self, position: int) -> Iterator[FacePage]:
        """Faces of the 'face' element with this number."""
        element = self._header.elements[position]
        n_lists = sum(p.count_type is not None for p in element.properties)

        def read(data: UInt8Array, done: int) -> _Found:
            found = self._uniform_faces(element, data, done) if n_lists == 1 else None
            return found or self._mixed_faces(element, data, done)

        yield from self._blocks(position, read)

    def strips(self, position: int) -> Iterator[FacePage]:
        """Triangles of the 'tristrips' element with this number; its lists may be as long as the file."""
        element = self._header.elements[position]
        offset = self._start_of(position)
        stream = StripStream()
        for done in range(element.count):
            for number, stored in enumerate(element.properties):
                n_values = 1
                value_type = self._stored(stored.value_type)
                if stored.count_type is not None:
                    n_values = self._read_count(element, stored, done, offset)
                    offset += stored.count_type.itemsize
                end = offset + n_values * value_type.itemsize
                if end > self._size_bytes:
                    raise self._truncated(element, done)
                while number == index_list(element) and offset < end:
                    n_entries = min((end - offset) // value_type.itemsize, PAGE_FACES)
                    data = self._read_at(offset, n_entries * value_type.itemsize)
                    offset += len(data)
                    # A negative number tells `place` that it is one of a strip.
                    if page := stream.feed(_as_indices(data.view(value_type)), -1 - done):
                        yield page
                offset = end
            stream.end_list()
        self._set_end(position, offset)

    def _read_count(self, element: Element, stored: Property, done: int, offset: int) -> int:
        assert stored.count_type is not None
        data = self._read_at(offset, stored.count_type.itemsize)
        if len(data) < stored.count_type.itemsize:
            raise self._truncated(element, done)
        count = int(_as_indices(data.view(self._stored(stored.count_type)))[0])
        if count < 0:
            raise self._bad_count(element, done)
        return count

    def _stored(self, dtype: np.dtype) -> np.dtype:
        return dtype.newbyteorder(">" if self._header.byte_order == ">" else "<")

    def _record(self, element: Element, list_size: int = 0) -> np.dtype:
        """Type of one element whose lists all have `list_size` values."""
        fields: list[tuple[Any, ...]] = []
        for number, stored in enumerate(element.properties):
            shape: tuple[int, ...] = ()
            if stored.count_type is not None:
                fields.append((f"count{number}", self._stored(stored.count_type)))
                shape = (list_size,)
            fields.append((f"value{number}", self._stored(stored.value_type), shape))
        return np.dtype(fields)

    def _read_at(self, offset: int, n_bytes: int) -> UInt8Array:
        """At most `n_bytes` at `offset`, valid until the next call."""
        if n_bytes > len(self._buffer):
            self._buffer = np.empty(n_bytes, np.uint8)
        self._file.seek(offset)
        view = self._buffer[:n_bytes].data
        n_read = 0
        while n_read < n_bytes and (fresh := self._file.readinto(view[n_read:])):
            n_read += fresh
        self.bytes_done = offset + n_read
        return self._buffer[:n_read]

    def _start_of(self, position: int) -> int:
        """Offset of the element with this number; elements with lists before it are walked over."""
        while len(self._starts) <= position:
            previous = len(self._starts) - 1
            element = self._header.elements[previous]
            if element.has_lists:
                for _ in self._blocks(previous, partial(self._skip, element)):
                    pass
            else:
                self._set_end(previous, self._starts[-1] + element.count * self._record(element).itemsize)
        return self._starts[position]

    def _skip(self, element: Element, data: UInt8Array, done: int) -> _Found:
        return self._find(element, data, done, [], -1)[0]

    def _set_end(self, position: int, offset: int) -> None:
        if len(self._starts) == position + 1:
            self._starts.append(offset)

    def _blocks(self, position: int, read: Callable[[UInt8Array, int], _Found]) -> Iterator[Any]:
        """What `read` makes of the blocks of an element, given the bytes and the number of elements done."""
        element = self._header.elements[position]
        offset = self._start_of(position)
        done = 0
        n_bytes = self._block_bytes
        while done < element.count:
            data = self._read_at(offset, n_bytes)
            found = read(data, done)
            if found.n_elements == 0:
                n_bytes = self._larger_block(element, done, offset, len(data), found.needed)
                continue
            yield found.content
            done += found.n_elements
            offset += found.n_bytes
            n_bytes = self._block_bytes
        self._set_end(position, offset)

    def _larger_block(self, element: Element, done: int, offset: int, n_read: int, needed: int) -> int:
        """Size of a block that may hold the element at `offset`, which did not fit; raises when none can."""
        if offset + max(needed, n_read + 1) > self._size_bytes:
            raise self._truncated(element, done)
        if needed > _LARGEST_ELEMENT_BYTES:
            raise MeshError(
                f"{self._path}, byte {offset}: '{element.name}' element {done} takes {needed} bytes, "
                f"more than the {_LARGEST_ELEMENT_BYTES} that one element may take."
            )
        return max(needed, n_read) + self._block_bytes

    def _truncated(self, element: Element, done: int) -> Truncated:
        return Truncated(
            f"{self._path}, byte {self._size_bytes}: the file ends after {done} of the {element.count} "
            f"'{element.name}' elements that its header promises.",
            element.count - done,
        )

    def _bad_count(self, element: Element, done: int) -> MeshError:
        return MeshError(
            f"{self._path}, '{element.name}' element {done} (counted from 0): "
            "the length of a list is negative, too large or not whole."
        )

    def _find(
        self, element: Element, data: UInt8Array, done: int, wanted: list[int], lists: int
    ) -> tuple[_Found, Int64Array, Int64Array]:
        """Complete elements in `data`: how many, offsets of the `wanted` properties, lengths of `lists`."""
        from penumbra.kernels import ply_lists

        properties = np.zeros((len(element.properties), ply_lists.N_COLUMNS), np.int64)
        for number, stored in enumerate(element.properties):
            column = wanted.index(number) if number in wanted else -1
            properties[number, ply_lists.VALUE_SIZE] = stored.value_type.itemsize
            properties[number, ply_lists.OUT_COLUMN] = column
            if stored.count_type is not None:
                properties[number, ply_lists.COUNT_SIZE] = stored.count_type.itemsize
                properties[number, ply_lists.COUNT_KIND] = _KINDS[stored.count_type.kind]
        n_room = min(element.count - done, PAGE_FACES)
        offsets = np.empty((n_room, max(1, len(wanted))), np.int64)
        sizes = np.zeros(n_room, np.int64)
        state = np.zeros(ply_lists.STATE_SIZE, np.int64)
        is_big = self._header.byte_order == ">"
        ply_lists.find_elements(data, len(data), properties, lists, is_big, state, offsets, sizes)
        n_found = int(state[ply_lists.N_ELEMENTS])
        if n_found == 0 and state[ply_lists.BAD_COUNT]:
            raise self._bad_count(element, done)
        found = _Found(None, n_found, int(state[ply_lists.CONSUMED]), int(state[ply_lists.NEEDED]))
        return found, offsets[:n_found], sizes[:n_found]

    def _mixed_faces(self, element: Element, data: UInt8Array, done: int) -> _Found:
        """Faces of any sizes, with any lists beside the indices."""
        from penumbra.kernels import ply_lists

        number = index_list(element)
        found, offsets, sizes = self._find(element, data, done, [number], number)
        if len(sizes) and sizes.max() > LARGEST_FACE:
            face = done + int(sizes.argmax())
            raise MeshError(f"{self._path}, {self.place(face)}: a face has more than {LARGEST_FACE} corners.")
        stored = element.properties[number]
        assert stored.count_type is not None
        corners = np.empty(int(sizes.sum()), np.int64)
        first_values = offsets[:, 0] + stored.count_type.itemsize
        kind = _KINDS[stored.value_type.kind]
        is_big = self._header.byte_order == ">"
        ply_lists.read_indices(data, first_values, sizes, stored.value_type.itemsize, kind, is_big, corners)
        where = np.arange(done, done + len(sizes))
        return found._replace(content=FacePage(sizes, corners, where))

    def _uniform_faces(self, element: Element, data: UInt8Array, done: int) -> _Found | None:
        """Faces with the same number of corners, read as numpy records; None if they are not such a run."""
        number = index_list(element)
        record = self._record(element)
        if len(data) < record.itemsize:
            return None
        size = int(_as_indices(data[: record.itemsize].view(record)[f"count{number}"])[0])
        record = self._record(element, size) if 3 <= size <= 4 else record
        n_rows = min(len(data) // record.itemsize, element.count - done, PAGE_FACES)
        rows = data[: n_rows * record.itemsize].view(record)
        if not 3 <= size <= 4 or n_rows == 0 or (rows[f"count{number}"] != size).any():
            return None
        corners = _as_indices(rows[f"value{number}"].reshape(-1))
        page = FacePage(np.full(n_rows, size), corners, np.arange(done, done + n_rows))
        return _Found(page, n_rows, n_rows * record.itemsize, record.itemsize)


def _as_indices(values: NDArray[Any]) -> Int64Array:
    """Stored numbers of any type as int64; UNREADABLE_INDEX for those that are not whole."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    with np.errstate(invalid="ignore"):  # signalling NaNs
        values = values.astype(np.float64)
    is_whole = (values == np.floor(values)) & (np.abs(values) < 2.0**62)
    return np.where(is_whole, np.where(is_whole, values, 0.0).astype(np.int64), UNREADABLE_INDEX)
