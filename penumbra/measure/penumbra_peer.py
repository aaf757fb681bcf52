"""Our own side of a comparison: a child process that ingests meshes and casts a case on them.

Run as `python -m penumbra.measure.penumbra_peer`; `peer_process` talks to it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

import penumbra
from penumbra.arrays import UInt64Array
from penumbra.compile_ahead import compile_ahead
from penumbra.io.blocker_store import BlockerStore
from penumbra.measure.peer_case import CastCase
from penumbra.measure.peer_process import Answer, costed, serve
from penumbra.progress import NullProgress
from penumbra.scene import MeshRef

# Receivers of the pass that loads the kernels; it is not timed.
_FEW = 64


class PenumbraPeer:
    """Our side: `penumbra.ingest` and `penumbra.cast`, as any caller has them."""

    _store: BlockerStore | None = None
    _masks: UInt64Array | None = None

    def build(self, meshes: Sequence[Answer], store: str) -> Answer:
        """Ingest meshes (the fields of `MeshRef`) into a store, or open the store that they name."""
        compile_ahead(NullProgress())
        if self._store is not None:
            self._store.close()
        refs = [MeshRef(Path(mesh["path"]), mesh["transform"], mesh["up"]) for mesh in meshes]
        if len(refs) == 1 and refs[0].is_store:
            self._store = penumbra.open_store(refs[0].path)
            return self._counts(refs[0].path)

        def work() -> Answer:
            self._store = penumbra.ingest(refs, store)
            return self._counts(Path(store))

        return costed(work)

    def _counts(self, store: Path) -> Answer:
        assert self._store is not None
        return {
            "store": str(store),
            "store_bytes": store.stat().st_size,
            "triangles": self._store.n_triangles,
            "dropped": self._store.n_dropped,
        }

    def case(self, folder: str) -> Answer:
        """Load receivers and light."""
        self._case = CastCase.read(Path(folder))
        return {"receivers": len(self._case.points)}

    def cast(self, threads: int, backend: str, few: bool = False) -> Answer:
        """Cast all receivers once; `few`: only some, which loads the kernels."""
        case, rows = self._case, slice(_FEW if few else None)
        # What the last cast found would hide a part of what this one needs.
        self._masks = None

        def work() -> Answer:
            """Cast, and keep the bits."""
            result = penumbra.cast(
                case.points[rows],
                self._store,
                case.light,
                normals=case.normals[rows],
                own=case.own[rows],
                index=case.index[rows],
                backend=backend,
                threads=threads,
            )
            self._masks = result.masks
            return {"stats": result.stats.as_dict()}

        return costed(work)

    def masks(self, path: str) -> Answer:
        """Save the bits of the last cast, uint64 (R, n_words)."""
        assert self._masks is not None
        np.save(path, self._masks)
        return {}


def main() -> None:
    """Answer commands until stdin ends."""
    peer = PenumbraPeer()
    serve({"build": peer.build, "case": peer.case, "cast": peer.cast, "masks": peer.masks})


if __name__ == "__main__":
    main()
