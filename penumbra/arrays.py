"""The arrays that pass between stages and into kernels, one NamedTuple per structure. numpy only.

Space is world space and the unit is the scene's own, unless a line says otherwise. All arrays are
C-contiguous; they are checked and cast where they enter the library, kernels never check.

name            field        shape, dtype               meaning
TriangleBatch   vertices     (n, 3, 3) f4 | f8          triangles as read, in file order
                ids          (n,) i8                    triangle index (after fan triangulation)
BlockerChunk    vertices     (n, 3, 3) f8               blockers in casting order
                ids          (n,) i8                    triangle index
                boxes_16     (ceil(n/16), 2, 3) f8      bounds of runs of 16 blockers, min and max
                boxes_256    (ceil(n/256), 2, 3) f8     bounds of runs of 256
                boxes_4096   (ceil(n/4096), 2, 3) f8    bounds of runs of 4096
ChunkInfo       bucket, first, count, n_bytes  ints     where a chunk stands in its store
                box          (2, 3) f8                  bounds of the chunk
Receivers       points       (n, 3) f8                  receiver points
                normals      (n, 3) f8 or (0, 3)        unit normals; empty: no facing test
                own          (n,) i8                    triangle each point lies on, -1 for none
                index        (n,) i8                    what the sample set is hashed from
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Int32Array = NDArray[np.int32]
UInt64Array = NDArray[np.uint64]
UInt8Array = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]


class TriangleBatch(NamedTuple):
    """A run of triangles as a mesh reader yields them."""

    vertices: NDArray[np.floating]
    ids: Int64Array


class BlockerChunk(NamedTuple):
    """A run of blockers in casting order, with the boxes of its runs of 16, 256 and 4096."""

    vertices: Float64Array
    ids: Int64Array
    boxes_16: Float64Array
    boxes_256: Float64Array
    boxes_4096: Float64Array


class ChunkInfo(NamedTuple):
    """Where a chunk stands in its store, and its bounds: enough to decide not to read it."""

    bucket: int
    first: int
    count: int  # type: ignore[assignment]  # hides tuple.count
    n_bytes: int
    box: Float64Array


class Receivers(NamedTuple):
    """Points that ask which light samples they see."""

    points: Float64Array
    normals: Float64Array
    own: Int64Array
    index: Int64Array  # type: ignore[assignment]  # hides tuple.index


class LightSamples(NamedTuple):
    """A planar light as casting sees it: light, groups, samples (HPC section 3.1).

    K samples in G groups of `group_size` consecutive bits, S sets; P = G * group_size, the last group
    padded with copies of the last sample.
    """

    corner: Float64Array  # (3,) corner of the light, world space
    origin: Float64Array  # (3,) its centre
    edge_u: Float64Array  # (3,) and
    edge_v: Float64Array  # (3,): a sample is origin + s * edge_u + t * edge_v, within `residual`
    parameters: Float32Array  # (S, 2, P) s and t, in [-1/2, 1/2]
    points: Float64Array  # (S, P, 3) the samples themselves, world space
    corners: Float64Array  # (1 + G, 4, 3) bounding polygons: the whole light, then each group; all sets
    n_samples: int  # K
    full_groups: UInt64Array  # (G,) the bits of a group that stand for samples, lowest bit first
    residual: float  # largest distance per axis of a sample from its parametric position


class ReceiverBvh(NamedTuple):
    """Receiver hierarchy of one tile; N nodes, n receivers in leaf order ("slots")."""

    boxes: Float64Array  # (N, 6) min and max of the receivers below a node
    first: Int32Array  # (N,) first slot below a node
    n_slots: Int32Array  # (N,) slots below a node
    child: Int32Array  # (N,) left child, the right one follows; -1: a leaf
    umbra: UInt64Array  # (N, ceil(G / 64)) group-umbra bits: group blocked for all receivers below
    points: Float64Array  # (n, 3) receiver points by slot
    own: Int64Array  # (n,) triangle each lies on
    sample_set: UInt8Array  # (n,)
    row: Int32Array  # (n,) the receiver's row in the tile


class MaskPool(NamedTuple):
    """Masks of a tile's m receivers, taken from a pool on demand (HPC section 3.3 D)."""

    place: Int32Array  # (m,) row of `masks`, MASK_NONE (all samples visible) or MASK_UMBRA (none)
    masks: UInt64Array  # (capacity, n_words) blocked samples
    free: Int32Array  # (capacity,) stack of unused rows of `masks`
    state: Int64Array  # (2,) how many of `free` are left; receivers that reached full umbra so far
    full: UInt64Array  # (n_words,) mask with every sample blocked


class CastScratch(NamedTuple):
    """Working memory of one casting task; D levels, G groups."""

    stack: Int32Array  # (2 * D + 2, 2) node and level to visit; node < 0: ~node is to be left
    light_planes: Int64Array  # (D,) active plane set of the whole light, by level
    n_active: Int64Array  # (D,) active groups, by level
    active_group: Int32Array  # (D, G)
    active_planes: Int64Array  # (D, G) active plane set of each active group
    light_volume: Float64Array  # (4, 8) penumbra volume of the whole light
    group_volumes: Float64Array  # (G, 4, 8)
    group_found: Int64Array  # (G,) which of the eight planes a group's volume has
    choices: Int64Array  # (2, 7) corners the planes went through: of the light, of the group in hand
    normal: Float64Array  # (6,) normal of the blocker and its componentwise permanent
    edges: Float32Array  # (4, 4) edge functions over the light: A, B, C, bound


class PointScratch(NamedTuple):
    """Working memory of one casting task of a point light; D levels."""

    stack: Int32Array  # (2 * D + 2, 2) node and its active planes to visit; node < 0: ~node is to be left
    volume: Float64Array  # (5, 8) hard shadow volume: rows nx, ny, nz, d, and the bound of their rounding


class Shaft(NamedTuple):
    """All segments between a tile's receivers and the light lie inside: what can be culled at once."""

    box: Float64Array  # (6,) min and max
    planes: Float64Array  # (12, 4) n . p <= d inside
    extent: float  # largest coordinate of tile and light
    reach: float  # longest segment


class Blocker(NamedTuple):
    """The blocker in hand, as casting passes it down."""

    corners: Float64Array  # (3, 3)
    id: int
    side: int  # side of its plane on which the whole light lies for certain, or 0
    extent: float  # largest coordinate of blocker, tile and light
    amplify: float  # reach of a shadow over the gap to the light; inf: they may touch


class GridCamera(NamedTuple):
    """Camera C of GEARS section 3.1, in the frame of a light: z is the depth below the light."""

    axes: Float64Array  # (3, 3) rows x, y, z: coordinates are axes . (p - origin), within `error`
    origin: Float64Array  # (3,) world space
    eye: Float64Array  # (3,) in the frame, behind the light
    light: Float64Array  # (6,) box of all light samples in the frame, min and max, padded by `error`
    error: float  # largest rounding of a coordinate, of any point that is given to the camera


class ReceiverGrid(NamedTuple):
    """Receivers binned to cells of the image plane; nx * ny cells, and a last one for the others."""

    lines_x: Float64Array  # (nx + 1,) cell boundaries in the image plane, ascending
    lines_y: Float64Array  # (ny + 1,)
    far: Float64Array  # (n_cells,) depth of the farthest receiver of a cell, -inf where there is none
    first: Int64Array  # (n_cells + 2,) where a cell's run of `rows` begins; the last run is of receivers
    rows: Int64Array  # (n,) outside the image, which every blocker is tested against
    box: Float64Array  # (6,) bounds of light and receivers in the frame, padded
    depth: float  # depth of the farthest receiver of the grid
    nearest: float  # least distance of a receiver of the image from the plane through the eye
    slack: float  # largest error of a receiver's place in the image plane


class Raster(NamedTuple):
    """What is rasterised onto: R receivers and their masks, for all blockers alike."""

    points: Float64Array  # (R, 3)
    own: Int64Array  # (R,) triangle each lies on
    sample_sets: UInt8Array  # (R,)
    masks: UInt64Array  # (R, n_words) blocked samples
    full: UInt64Array  # (n_words,) mask with every sample blocked
    group_boxes: Float32Array  # (4, n) centres s, t and half widths of the groups, n a multiple of 16
    group_size: int
    extent: float  # largest coordinate of receivers, blockers and light
    skip_blocked: bool  # pass over what is blocked already


class RasterScratch(NamedTuple):
    """Working memory of one rasterising task."""

    lanes: Float64Array  # (N_ROWS, BLOCK) blockers of a cell, set up
    found: Float64Array  # (3, 4, N_LANES) edge functions of eight blockers: A, B, C, bound
    edges: Float32Array  # (4, 4) edge functions of the blocker in hand
    normal: Float64Array  # (6,) its normal and the permanents


class CastSwitches(NamedTuple):
    """Optimizations A to D of HPC section 3.3, as kernels read them."""

    umbra_bits: bool
    active_planes: bool
    lazy_volumes: bool
    lazy_masks: bool


class LightSpace(NamedTuple):
    """A light for the joint descent: an affine map that takes it to the square |s|, |t| <= 1/2 at z = 0.

    K samples in B blocks of 256 consecutive bits, S sets. A table holds, for each of 128 bins of a block's
    extent along s or t, the samples in that bin or beyond: [set][block][kind][bin] is four words, kind
    0: s from this bin on, 1: s up to this bin, 2 and 3: the same of t. Set S stands for all sets.
    """

    matrix: Float64Array  # (3, 3) and
    origin: Float64Array  # (3,): light space = matrix (world - origin); z > 0 on the receivers' side
    handedness: float  # 1 where the map keeps right-handed triples so, otherwise -1
    parameters: Float32Array  # (S, B, 2, 256) s and t of the samples; copies of the last one fill up
    tables: UInt64Array  # (S + 1, B, 4, 128, 4)
    extents: Float32Array  # (B, 6) least s, least t, greatest s, greatest t of all sets; bins per s, per t
    points: Float64Array  # (S, 256 B, 3) the samples themselves, world space
    full: UInt64Array  # (B, 4) bits that stand for samples
    n_words: int  # words of a mask
    slack: float  # how far a receiver, a blocker or a sample may be from its float32 place in light space
    doubt: float  # 2**24 times how far it may be from its place as the sum of two float32
    residual: float  # how far a sample may be from (s, t, 0), beyond the rounding of s and t
    border: float  # what is added to an interval over the light for the rounding of its ends


class ReceiverLeaves(NamedTuple):
    """Receivers in leaves of 16, in the order of a curve: one lane each. N leaves, n receivers."""

    places: Float32Array  # (N, 3, 16) light space
    offsets: Float32Array  # (N, 3, 16) from the centre, which is not rounded to a float32 first
    centres: Float32Array  # (N, 6) centre as a float32, and what that leaves out
    reaches: Float32Array  # (N, 2) largest offset, largest distance from a sample (sums of absolute values)
    boxes: Float32Array  # (N, 6) min and max of `places`
    count: Int32Array  # type: ignore[assignment]  # (N,) receivers; lanes beyond are copies of the last
    is_done: UInt8Array  # (N,) nothing is left to block
    row: Int64Array  # (16 N,) row of the receiver in points, masks, ...
    points: Float64Array  # (R, 3) world space, by row
    own: Int64Array  # (R,)
    sample_set: UInt8Array  # (R,)
    masks: UInt64Array  # (R, n_words)


class BlockerTree(NamedTuple):
    """A chunk in light space: clusters of 16 blockers, one a lane, under nodes of 16 children."""

    lanes: Float32Array  # (C, 17, 16) see kernels/light_space.py
    lane_ids: Int32Array  # (C, 16) low half of the triangle index
    fast: Int32Array  # (C,) bit per lane: may be decided in light space
    straddling: Int32Array  # (C,) bit per lane: of those, may reach the plane of the light or beyond
    careful: Int32Array  # (C,) bit per lane: must be decided in world space
    nodes: Float32Array  # (M, 6, 16) boxes of 16 children; levels one after the other, clusters first
    first_node: Int64Array  # (4,) first node of levels 0, 1, 2 (children of 16, 256, 4096 blockers); M
    vertices: Float64Array  # (n, 3, 3) the chunk's
    ids: Int64Array  # (n,)


class JointScratch(NamedTuple):
    """Working memory of one thread of the joint descent."""

    open: UInt64Array  # (17, 4) samples of the block not blocked yet, of 16 receivers and of any of them
    wanted: UInt64Array  # (17, 4) samples in question, of each receiver that has any
    slots: Int64Array  # (17,) which receivers of the leaf those are
    tables: Int64Array  # (16,) where in LightSpace.tables the sample set of each receiver begins
    unsure: UInt64Array  # (4,) samples that float32 leaves open
    bins: Int32Array  # (4, 4, 16) by level, the last of a leaf: first and last bin of s, and of t
    cluster: Float32Array  # (5, 16) first corners from the centre of the leaf; bounds of plane, of edges
    coefficients: Float32Array  # (15, 16) A, B, C of three edges, bound; A, B, C of the plane, bound; turn
    normal: Float64Array  # (6,)
