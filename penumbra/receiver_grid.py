"""4: receivers binned to the cells of camera C's image plane (GEARS section 3.1, steps 3.1 and 3.2)."""

import numpy as np

from penumbra.arrays import Float64Array, GridCamera, Int64Array, LightSamples, ReceiverGrid
from penumbra.kernels.shadow_grid import any_cell_touched, bin_receivers, project_receivers

# Edges of a light this near to parallel give no frame: the sine of the angle between them.
_LEAST_SINE = 1e-6
# A line of sight from receivers to light that is flatter than this moves the eye no farther sideways.
_MOST_SLOPE = 1.0
# Roundings of a coordinate in the frame: two subtractions, products and sums of three terms, doubled.
_ROUNDINGS = 16.0 * 2.0**-53
_SUBNORMAL_ROUNDING = 1e-321


def make_grids(
    points: Float64Array,
    live: Int64Array,
    light: LightSamples,
    *,
    two_sided: bool,
    blocker_extent: float,
    resolution: int,
    eye_distance: float,
    spacing: str,
) -> list["ShadowGrid"]:
    """One grid for the receivers on each side of the light that has any; points (R, 3), live rows of it."""
    if not len(live):
        return []
    # Beyond the largest numbers nothing can be projected: the camera then sees no receiver.
    with np.errstate(over="ignore", invalid="ignore"):
        seen = points[live] - _middle(light)
        axes = _frame(light, seen.mean(axis=0))
        ahead = seen @ axes[2] >= 0.0
    of_light = [light.corners.reshape(-1, 3), light.origin, light.edge_u, light.edge_v]
    extent = max(float(np.abs(part).max()) for part in [points[live], *of_light])
    extent = max(extent, blocker_extent)
    sides = (
        [(axes, live[ahead]), (axes * [[1.0], [1.0], [-1.0]], live[~ahead])] if two_sided else [(axes, live)]
    )
    return [
        ShadowGrid(points, rows, light, side, extent, resolution, eye_distance, spacing)
        for side, rows in sides
        if len(rows)
    ]


class ShadowGrid:
    """Camera C of a light and some receivers, and its grid."""

    def __init__(
        self,
        points: Float64Array,
        rows: Int64Array,
        light: LightSamples,
        axes: Float64Array,
        extent: float,
        resolution: int,
        eye_distance: float,
        spacing: str,
    ) -> None:
        self.extent = extent
        self._points = points
        self._resolution = resolution
        self._spacing = spacing
        self._lines: list[Float64Array] = []
        self.camera = _camera(points[rows], light, axes, extent, eye_distance)
        self.bin(rows)

    def bin(self, rows: Int64Array) -> None:
        """Bin some rows of the points; the others are left out from now on, the cells stay the same."""
        image, depth, bounds = np.empty((len(rows), 2)), np.empty(len(rows)), np.empty(6)
        slack, nearest = project_receivers(self._points, rows, self.camera, image, depth, bounds)
        if not self._lines:
            self._lines = [_lines(image[:, k], self._resolution, self._spacing) for k in range(2)]
        x, y = self._lines
        n_cells = (len(x) - 1) * (len(y) - 1)
        light, error = self.camera.light, self.camera.error
        box = np.concatenate(
            [np.minimum(bounds[:3], light[:3]) - error, np.maximum(bounds[3:], light[3:]) + error]
        )
        far, first = np.empty(n_cells), np.empty(n_cells + 2, np.int64)
        sorted_rows, cell = np.empty(len(rows), np.int64), np.empty(len(rows), np.int32)
        bin_receivers(rows, image, depth, x, y, cell, far, first, sorted_rows)
        self.grid = ReceiverGrid(
            x, y, far, first, sorted_rows, box, float(far.max()), float(nearest), float(slack)
        )

    def touched_by(self, box: Float64Array, correct: bool) -> bool:
        """Whether blockers in a box (2, 3) may block something here."""
        return bool(
            any_cell_touched(np.require(box, np.float64, ["C", "W"]), self.camera, self.grid, correct)
        )


def _frame(light: LightSamples, towards: Float64Array) -> Float64Array:
    """Rows x, y, z (3, 3): z away from the light's plane, x and y such that its edges are axis-aligned boxes.

    towards: from the light to the receivers, which z follows where the light has no plane.
    """
    u, v = _unit(light.edge_u), _unit(light.edge_v)
    normal = np.cross(u, v)
    if np.linalg.norm(normal) > _LEAST_SINE:
        return np.array([_unit(np.cross(v, normal)), _unit(np.cross(normal, u)), _unit(normal)])
    along = u if np.abs(light.edge_u).max() >= np.abs(light.edge_v).max() else v
    depth = _unit(towards)
    depth = _unit(depth - (depth @ along) * along)
    if not depth.any():
        depth = _unit(np.cross(along, np.roll(along, 1) + [1.0, 0.0, 0.5])) if along.any() else np.eye(3)[2]
    if not along.any():
        along = _unit(np.cross(depth, np.eye(3)[np.abs(depth).argmin()]))
    return np.array([along, _unit(np.cross(depth, along)), depth])


def _camera(
    points: Float64Array, light: LightSamples, axes: Float64Array, extent: float, eye_distance: float
) -> GridCamera:
    """Camera C: parallel to the light, behind it on the line from the centre of all (GEARS section 3.1)."""
    row_sum = float(np.abs(axes).sum(axis=1).max())
    with np.errstate(over="ignore", invalid="ignore"):
        error = _ROUNDINGS * row_sum * 2.0 * extent + _SUBNORMAL_ROUNDING
        if not extent < 1e100:
            error = np.inf
        middle = _middle(light)
        lamp = (light.corners[0] - middle) @ axes.T
        reach = error + 4.0 * row_sum * light.residual
        lamp_low, lamp_high = lamp.min(axis=0), lamp.max(axis=0)
        lamp_box = np.concatenate([lamp_low - reach, lamp_high + reach])
        seen = (points - middle) @ axes.T
        centre = 0.5 * (np.minimum(seen.min(axis=0), lamp_low) + np.maximum(seen.max(axis=0), lamp_high))
        slope = np.ones(3)
        if centre[2] > 0.0:
            slope[:2] = np.clip(centre[:2] / centre[2], -_MOST_SLOPE, _MOST_SLOPE)
        distance = eye_distance * float(np.linalg.norm(lamp_high - lamp_low)) / float(np.linalg.norm(slope))
    return GridCamera(
        axes=np.ascontiguousarray(axes),
        origin=middle,
        eye=-slope * distance if np.isfinite(distance) else np.zeros(3),
        light=lamp_box,
        error=float(error),
    )


def _middle(light: LightSamples) -> Float64Array:
    """Middle of the samples: of one sample the sample itself, however large the light is."""
    with np.errstate(over="ignore", invalid="ignore"):
        middle: Float64Array = light.corners[0].mean(axis=0)
    return middle


def _lines(image: Float64Array, resolution: int, spacing: str) -> Float64Array:
    """Cell boundaries along one axis of the image."""
    seen = image[np.isfinite(image)]
    if not len(seen):
        return np.array([0.0, 1.0])
    if spacing == "regular":
        return np.linspace(seen.min(), seen.max(), resolution + 1)
    lines: Float64Array = np.quantile(seen, np.linspace(0.0, 1.0, resolution + 1), method="inverted_cdf")
    return lines


def _unit(vector: Float64Array) -> Float64Array:
    """Vector of length one, zeros for a vector of zeros; scaled first, so that no square overflows."""
    largest = float(np.abs(vector).max())
    if not largest > 0.0:
        return np.zeros(3)
    scaled = vector / largest
    unit: Float64Array = scaled / np.linalg.norm(scaled)
    return unit
