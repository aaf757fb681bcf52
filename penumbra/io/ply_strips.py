"""Triangle strips of PLY files, as a stream: a whole scan is often one single strip list."""

import numpy as np

from penumbra.arrays import Int64Array
from penumbra.io.faces import FacePage

_RESTART = -1


class StripStream:
    """Turn the entries of strips into triangles, however the entries are cut into runs.

    Entries a, b, c, d give the triangles (a, b, c) and (c, b, d): every second one is turned so that
    all face the same way. The entry -1 ends a strip and begins the next.
    """

    def __init__(self) -> None:
        self._carried: Int64Array = np.empty(0, np.int64)
        self._carried_place = 0

    def end_list(self) -> None:
        """The list ends here, and with it the strip."""
        self._carried = np.empty(0, np.int64)
        self._carried_place = 0

    def feed(self, entries: Int64Array, where: int) -> FacePage | None:
        """Triangles that `entries` complete, or None; `where` is the place to name in errors."""
        entries = np.concatenate([self._carried, entries])
        index = np.arange(len(entries))
        last_restart = np.maximum.accumulate(np.where(entries == _RESTART, index, -1))
        # Number of the entry in its strip; -1 for a restart.
        place = np.where(last_restart < 0, index + self._carried_place, index - last_restart - 1)
        self._carried = entries[-2:]
        self._carried_place = int(place[-2:][0]) if len(entries) else 0
        complete = np.flatnonzero(place[2:] >= 2)
        if len(complete) == 0:
            return None
        odd = place[complete] & 1
        corners = np.stack(
            [entries[complete + odd], entries[complete + 1 - odd], entries[complete + 2]], axis=1
        )
        n_triangles = len(complete)
        return FacePage(np.full(n_triangles, 3), corners.reshape(-1), np.full(n_triangles, where))
