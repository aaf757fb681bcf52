"""Plots of measurements as PNG; matplotlib is imported when they are drawn."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.errors import PenumbraError
from penumbra.io.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

    from penumbra.measure.error_report import ErrorReport, Pattern

# Light samples, x, y.
Point = tuple[int, float, float]
Lines = list[tuple[str, list[Point]]]

# Okabe and Ito's palette: told apart with any kind of colour vision, and by lightness in grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P")
STYLES = ("-", "--", ":", "-.")
_GREY = "#666666"
_PIXELS_PER_INCH = 100
_MARKER_PIXELS = 5.0
_USED = ("matplotlib", "matplotlib.backends.backend_agg", "matplotlib.figure", "matplotlib.ticker")
# Labels of ticks stand no closer than this part of the axis.
_TICK_DISTANCE = 1 / 14
# Where the number of a point may stand, in points from it, with its alignment.
_PLACES = (
    (5, 4, "left", "bottom"),
    (-5, -4, "right", "top"),
    (5, -4, "left", "top"),
    (-5, 4, "right", "bottom"),
    (8, 0, "left", "center"),
    (-8, 0, "right", "center"),
    (0, 7, "center", "bottom"),
    (0, -7, "center", "top"),
)


def require_matplotlib() -> None:
    """Raise PenumbraError, before any work, when no plot could be drawn."""
    advice = "pip install 'penumbra-render[bench]', or leave out -o to draw none"
    for name in _USED:
        try:
            import_module(name)
        except Exception as problem:
            if isinstance(problem, ModuleNotFoundError) and problem.name == "matplotlib":
                raise PenumbraError(
                    f"drawing the plot needs matplotlib, which is not installed: {advice}"
                ) from None
            # A build for another numpy, or half an installation, fails with an error of any type.
            what = f"{type(problem).__name__}: {problem}".strip().splitlines()[0]
            raise PenumbraError(
                f"drawing the plot needs matplotlib, which is installed but broken ({what}): {advice}"
            ) from problem


def draw_error(report: "ErrorReport", path: Path) -> None:
    """Draw RMS error against samples, with fits and theory, and against processor time for each backend."""
    figure, (by_samples, by_seconds) = new_figure(2)
    width, height = report.resolution
    figure.suptitle(
        f"{report.scene}, light {report.light}: {report.n_receivers:,} receivers at {width} × {height}, "
        f"{report.penumbra_share:.1%} in penumbra"
    )
    units = ("light samples", "processor seconds of a cast, all threads together")
    for axes, unit in zip((by_samples, by_seconds), units, strict=True):
        axes.set(xscale="log", yscale="log", xlabel=unit, ylabel="RMS error of visibility")
        axes.grid(True, which="major", color="#DDDDDD", linewidth=0.8)
    if not any(row.metrics.rms > 0 for row in report.rows):
        by_samples.set_title("no error: all samples agree with the reference", fontsize=9)
    else:
        _draw_by_samples(by_samples, report)
        _number_points(figure, by_seconds, _draw_by_seconds(by_seconds, report))
    save_figure(figure, path)


def _draw_by_samples(axes: "Axes", report: "ErrorReport") -> None:
    """Draw measured errors, the fitted laws, the slopes of theory and the error of the reference."""
    samples = sorted({row.samples for row in report.rows})
    for (pattern, law), look in zip(report.slopes, _looks(), strict=False):
        colour, marker = look
        label = str(pattern)
        if law.slope is not None:
            error = "" if law.standard_error is None else f" ± {law.standard_error:.2f}"
            label += f": slope {law.slope:.2f}{error}".replace("-", "−")
            axes.plot(samples, law.at(samples), color=colour, linewidth=1.2)
        points = _points(report, pattern, report.backends[0])
        axes.plot([k for k, _, _ in points], [rms for _, _, rms in points], marker, color=colour, label=label)
    _draw_theory(axes, report, samples)
    if report.reference_rms > 0:
        label = "error of the reference itself"
        axes.axhline(report.reference_rms, color=_GREY, linewidth=0.9, linestyle="-.", label=label)
    ticks = _apart(samples)
    axes.set_xticks(ticks, [str(k) for k in ticks])
    axes.minorticks_off()
    axes.legend(fontsize=8, framealpha=1)


def _apart(values: Sequence[int]) -> list[int]:
    """Values, ascending, without those too close to one before on a logarithmic axis to have a label each."""
    least = max((values[-1] / values[0]) ** _TICK_DISTANCE, 1.0)
    kept: list[int] = []
    for value in values:
        if not kept or value >= least * kept[-1]:
            kept.append(value)
    return kept


def _draw_theory(axes: "Axes", report: "ErrorReport", samples: list[int]) -> None:
    """Draw lines of slope -1/2 and -3/4 through the largest error, to compare directions with."""
    top = max(row.metrics.rms for row in report.rows if row.samples == samples[0])
    if len(samples) < 2 or top <= 0:
        return
    for exponent, text, style in ((-0.5, "random: −1/2", ":"), (-0.75, "stratified: −3/4", "--")):
        # A little above the points, so that lines of the same slope do not cover each other.
        values = [1.25 * top * (k / samples[0]) ** exponent for k in samples]
        axes.plot(samples, values, style, color=_GREY, linewidth=1, label=f"theory, {text}")


def _draw_by_seconds(axes: "Axes", report: "ErrorReport") -> Lines:
    """Draw one line for each pattern (colour) and backend (line, filled or hollow marker)."""
    lines: Lines = []
    for (pattern, _), (colour, marker) in zip(report.slopes, _looks(), strict=False):
        for number, backend in enumerate(report.backends):
            line = _points(report, pattern, backend)
            axes.plot(
                [seconds for _, seconds, _ in line],
                [rms for _, _, rms in line],
                STYLES[number % len(STYLES)],
                marker=marker,
                markersize=5,
                color=colour,
                markerfacecolor="white" if number % 2 else colour,
                linewidth=1.2,
                label=f"{backend}, {pattern}",
            )
            lines.append((colour, line))
    _label_seconds(axes)
    axes.legend(fontsize=8, title="small numbers: light samples", title_fontsize=8, framealpha=1)
    return lines


def _label_seconds(axes: "Axes") -> None:
    """Write plain numbers at the axis, the more of a decade the fewer decades there are."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    low, high = axes.get_xlim()
    if high < 10 * low:
        axes.xaxis.set_major_locator(MaxNLocator(6))
    else:
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.minorticks_off()


def _number_points(figure: "Figure", axes: "Axes", lines: Lines) -> None:
    """Write samples beside the points of lines, where no label, marker, line or legend is in the way.

    Neighbours tell the number of a point that has no room for it.
    """
    figure.draw_without_rendering()
    legend = axes.get_legend()
    taken = [legend.get_window_extent()] if legend is not None else []
    for _, points in lines:
        taken += _boxes_along(axes.transData.transform([(x, y) for _, x, y in points]))
    for colour, points in lines:
        for samples, x, y in points:
            for right, up, side, edge in _PLACES:
                label = axes.annotate(
                    str(samples),
                    (x, y),
                    (right, up),
                    textcoords="offset points",
                    ha=side,
                    va=edge,
                    fontsize=7,
                    color=colour,
                )
                box = label.get_window_extent()
                if _inside(axes.bbox, box) and not any(box.overlaps(other) for other in taken):
                    taken.append(box)
                    break
                label.remove()


def _boxes_along(places: Float64Array) -> "list[Bbox]":
    """Boxes that cover a line through places (n, 2), in pixels, and the markers at them."""
    from matplotlib.transforms import Bbox

    def square(place: Float64Array, half: float) -> Bbox:
        return Bbox([place - half, place + half])

    boxes = [square(place, _MARKER_PIXELS) for place in places]
    for begin, end in zip(places, places[1:], strict=False):
        n = int(np.abs(end - begin).max() // 2) + 1
        boxes += [square(begin + (end - begin) * k / n, 1.0) for k in range(n)]
    return boxes


def _inside(outer: "Bbox", inner: "Bbox") -> bool:
    return bool(
        outer.x0 <= inner.x0 and inner.x1 <= outer.x1 and outer.y0 <= inner.y0 and inner.y1 <= outer.y1
    )


def _points(report: "ErrorReport", pattern: "Pattern", backend: str) -> list[Point]:
    """Samples, processor seconds and RMS error of a pattern and backend, where there is an error."""
    return [
        (row.samples, row.cost.cpu_seconds, row.metrics.rms)
        for row in report.rows
        if row.pattern == pattern and row.backend == backend and row.metrics.rms > 0
    ]


def _looks() -> Iterator[tuple[str, str]]:
    return zip(COLOURS, MARKERS, strict=True)


def new_figure(n_panels: int) -> "tuple[Figure, list[Axes]]":
    """Make a figure with panels side by side, drawn by Agg and known to no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6 * n_panels, 4.6), dpi=_PIXELS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [figure.add_subplot(1, n_panels, panel + 1) for panel in range(n_panels)]


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
