"""How far estimates are from a reference, and how fast that falls: plain numpy, no scene."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.arrays import Float64Array


class ErrorMetrics(NamedTuple):
    """Errors of visibility, estimate minus reference, over R receivers; 0 where there are none."""

    rms: float
    """Root of the mean square."""
    rms_penumbra: float
    """The same over the receivers in penumbra alone."""
    mean_absolute: float
    bias: float
    """Mean with its sign: above 0 the estimate is too bright."""
    p99: float
    """Absolute error that 99 % of the receivers stay below."""
    maximum: float
    """Largest absolute error."""


class PowerLaw(NamedTuple):
    """y = scale * x ** slope, fitted to points by least squares on logarithms."""

    slope: float | None
    """None where fewer than two points can be fitted."""
    standard_error: float | None
    """Of the slope; None below three points, which a line meets or nearly meets whatever they are."""
    scale: float | None
    n_points: int

    def at(self, x: ArrayLike) -> Float64Array:
        """Values of the law at x; only where there is a slope."""
        if self.slope is None or self.scale is None:
            raise ValueError("no law was fitted: there are fewer than two points")
        values: Float64Array = self.scale * np.asarray(x, np.float64) ** self.slope
        return values


def error_metrics(
    visibility: NDArray[np.floating], reference: Float64Array, in_penumbra: NDArray[np.bool_]
) -> ErrorMetrics:
    """Errors of visibility (R,) against a reference (R,); `in_penumbra` (R,) marks those receivers."""
    if not len(reference):
        return ErrorMetrics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    error = visibility.astype(np.float64) - reference
    absolute = np.abs(error)
    return ErrorMetrics(
        rms=root_mean_square(error),
        rms_penumbra=root_mean_square(error[in_penumbra]),
        mean_absolute=float(absolute.mean()),
        bias=float(error.mean()),
        p99=float(np.percentile(absolute, 99)),
        maximum=float(absolute.max()),
    )


def root_mean_square(values: Float64Array) -> float:
    """Root of the mean square; 0 for no values."""
    return math.sqrt(float(np.mean(np.square(values)))) if len(values) else 0.0


def without_floor(rms: float, floor: float) -> float:
    """RMS error against the truth, from that against a reference whose own, independent error is `floor`.

    The squares of independent errors add up; 0 where the reference is no better than the estimate.
    """
    return math.sqrt(max(0.0, rms * rms - floor * floor))


def fit_power_law(x: ArrayLike, y: ArrayLike) -> PowerLaw:
    """Fit a line to log y over log x by least squares; points with y <= 0 have no logarithm and are left out.

    The standard error of the slope is that of ordinary least squares, from the spread about the line.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    log_x, log_y = np.log(x[y > 0]), np.log(y[y > 0])
    n_points = len(log_x)
    spread = float(np.sum((log_x - log_x.mean()) ** 2)) if n_points else 0.0
    if spread == 0.0:
        return PowerLaw(None, None, None, n_points)
    slope = float(np.sum((log_x - log_x.mean()) * log_y)) / spread
    offset = float(log_y.mean() - slope * log_x.mean())
    residual = float(np.sum((log_y - offset - slope * log_x) ** 2))
    standard_error = math.sqrt(residual / (n_points - 2) / spread) if n_points > 2 else None
    return PowerLaw(slope, standard_error, math.exp(offset), n_points)
