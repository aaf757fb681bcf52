"""Sizes as users write them, and the switches of ingest and casting with their defaults."""

import math
import re
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal

from penumbra.errors import SceneError

_UNIT_BYTES = {"": 1, "b": 1} | {
    prefix + suffix: base**power
    for power, prefix in enumerate("kmgt", start=1)
    for suffix, base in (("b", 1000), ("ib", 1024))
}
_MOST_CELLS = 4096
_SIZE = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", re.IGNORECASE)


def parse_size(text: str | int | None) -> int | None:
    """Bytes of a size such as `512MiB` (2**20), `4GB` (10**9), `1.5GiB` or a plain number; None stays None.

    Raises `SceneError` for anything else, and for sizes below one byte.
    """
    if text is None:
        return None
    match = _SIZE.fullmatch(str(text)) if not isinstance(text, bool | float) else None
    unit_bytes = _UNIT_BYTES.get(match[2].lower()) if match else None
    if match is None or unit_bytes is None:
        raise SceneError(f"{text!r} is not a size: write a number of bytes, or one like 512MiB, 4GiB or 4GB")
    size_bytes = int(match[1]) * unit_bytes if match[1].isdigit() else int(float(match[1]) * unit_bytes)
    if size_bytes < 1:
        raise SceneError(f"{text!r} is not a size: it must be at least one byte")
    return size_bytes


@dataclass(frozen=True)
class IngestOptions:
    """How triangles are laid out in a blocker store; no choice changes a bit of any mask."""

    chunk_triangles: int = 65536
    """Triangles in one chunk, the unit of reading."""
    max_buckets: int = 16
    """Most area buckets a store may have."""
    sort: bool = True
    """Sort by area and place; False keeps one bucket in input order, to measure what sorting gains."""

    def __post_init__(self) -> None:
        _at_least("chunk_triangles", self.chunk_triangles, 1)
        _at_least("max_buckets", self.max_buckets, 1)


@dataclass(frozen=True)
class CastOptions:
    """Switches and sizes of the casting engines (Laine & Aila 2005; Wang et al. 2014); none changes a bit."""

    umbra_bits: bool = True
    """A: skip groups, receivers and nodes that are already fully in umbra."""
    active_planes: bool = True
    """B: while descending, test only the planes that a node still straddles."""
    lazy_volumes: bool = True
    """C: construct penumbra and hard shadow volumes when first needed."""
    lazy_masks: bool = True
    """D: allocate masks on demand and release them in full umbra."""
    sort: bool = True
    """Cast from large triangles to small; False: from small to large, to measure what the order gains."""
    group_size: int = 32
    """Light samples in one light sample group, 32 or 64."""
    tile_receivers: int = 8192
    """Receivers in one tile, the unit of work of a thread."""
    leaf_receivers: int = 16
    """Receivers in one leaf of the receiver BVH, at most."""
    joint_triangles: int = 0
    """Blockers from which on the hierarchies of receivers and blockers are descended together; fewer are
    cast one at a time, which is what the switches above are about."""
    rebuild_fraction: float = 0.25
    """Rebuild the receiver BVH once this fraction of its receivers is in umbra since it was built."""

    grid_resolution: int = 128
    """gears: cells along each axis of the grid (GEARS section 4.3)."""
    grid_spacing: Literal["quantile", "regular"] = "quantile"
    """gears: columns and rows that hold equally many receivers each, or of equal width, as in the paper."""
    grid_eye: float = 0.5
    """gears: distance of the grid's eye from the light, in diagonals of the light (GEARS section 3.1)."""
    correct_extrusion: bool = True
    """gears: extrude shadow volumes only to the farthest receiver of the cells they touch (section 3.1)."""
    pair_bytes: int = 16 << 20
    """gears: memory for the blockers of all cells, which decides how many blockers are taken at a time."""

    def __post_init__(self) -> None:
        _at_least("group_size", self.group_size, 32)
        if self.group_size not in (32, 64):
            raise SceneError(f"group_size is {self.group_size}: a light sample group has 32 or 64 samples")
        _at_least("grid_resolution", self.grid_resolution, 1)
        _at_least("pair_bytes", self.pair_bytes, 4)
        if self.grid_resolution > _MOST_CELLS:
            raise SceneError(f"grid_resolution is {self.grid_resolution}: it may be {_MOST_CELLS} at most")
        if self.grid_spacing not in ("quantile", "regular"):
            raise SceneError(f"grid_spacing is {self.grid_spacing!r}: give 'quantile' or 'regular'")
        if not (_is_finite(self.grid_eye) and self.grid_eye >= 0):
            raise SceneError(
                f"grid_eye is {self.grid_eye!r}: it must be a number of light diagonals, 0 or more"
            )
        _at_least("tile_receivers", self.tile_receivers, 1)
        _at_least("leaf_receivers", self.leaf_receivers, 1)
        _at_least("joint_triangles", self.joint_triangles, 0)
        if not (_is_finite(self.rebuild_fraction) and self.rebuild_fraction > 0):
            raise SceneError(
                f"rebuild_fraction is {self.rebuild_fraction!r}: it must be a number above 0 "
                "(1 or more: never rebuild)"
            )


def _at_least(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise SceneError(f"{name} is {value!r}: it must be a whole number, at least {least}")


def _is_finite(value: float) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
