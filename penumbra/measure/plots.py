"""Plots of measurements as PNG; matplotlib is imported when they are drawn."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from penumbra.errors import PenumbraError
from penumbra.io.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from penumbra.measure.error_report import ErrorReport, Pattern

# Okabe and Ito's palette: told apart with any kind of colour vision, and by lightness in grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P")
STYLES = ("-", "--", ":", "-.")
_GREY = "#666666"
_PIXELS_PER_INCH = 100


def require_matplotlib() -> None:
    """Raise PenumbraError, before any work, when no plot could be drawn."""
    if find_spec("matplotlib") is None:
        raise PenumbraError(
            "drawing the plot needs matplotlib, which is not installed: pip install 'penumbra-render[bench]'"
        )


def draw_error(report: "ErrorReport", path: Path) -> None:
    """Draw RMS error against samples, with fits and theory, and against seconds for each backend."""
    figure, (by_samples, by_seconds) = new_figure(2)
    width, height = report.resolution
    figure.suptitle(
        f"{report.scene}, light {report.light}: {report.n_receivers:,} receivers at {width} × {height}, "
        f"{report.penumbra_share:.1%} in penumbra"
    )
    for axes, unit in ((by_samples, "light samples"), (by_seconds, "wall seconds of a cast")):
        axes.set(xscale="log", yscale="log", xlabel=unit, ylabel="RMS error of visibility")
        axes.grid(True, which="major", color="#DDDDDD", linewidth=0.8)
    if not any(row.metrics.rms > 0 for row in report.rows):
        by_samples.set_title("no error: nothing is in penumbra", fontsize=9)
    else:
        _draw_by_samples(by_samples, report)
        _draw_by_seconds(by_seconds, report)
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
        axes.axhline(report.reference_rms, color=_GREY, linewidth=0.9, linestyle="-.")
        axes.annotate(
            "error of the reference itself",
            (0.02, report.reference_rms),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            fontsize=8,
            color=_GREY,
        )
    axes.set_xticks(samples, [str(k) for k in samples])
    axes.minorticks_off()
    axes.legend(fontsize=8)


def _draw_theory(axes: "Axes", report: "ErrorReport", samples: list[int]) -> None:
    """Draw lines of slope -1/2 and -3/4 through the largest error, to compare directions with."""
    top = max(row.metrics.rms for row in report.rows if row.samples == samples[0])
    if len(samples) < 2 or top <= 0:
        return
    for exponent, text, style in ((-0.5, "random: −1/2", ":"), (-0.75, "stratified: −3/4", "--")):
        # A little above the points, so that lines of the same slope do not cover each other.
        values = [1.25 * top * (k / samples[0]) ** exponent for k in samples]
        axes.plot(samples, values, style, color=_GREY, linewidth=1, label=f"theory, {text}")


def _draw_by_seconds(axes: "Axes", report: "ErrorReport") -> None:
    """Draw one line for each pattern (colour) and backend (line, filled or hollow marker).

    Of patterns that differ in their sets only, the last: sets change the time little, and more lines would
    hide each other.
    """
    last = {slope.pattern.pattern: slope.pattern for slope in report.slopes}
    for (pattern, _), (colour, marker) in zip(report.slopes, _looks(), strict=False):
        if pattern not in last.values():
            continue
        for number, backend in enumerate(report.backends):
            points = _points(report, pattern, backend)
            axes.plot(
                [seconds for _, seconds, _ in points],
                [rms for _, _, rms in points],
                STYLES[number % len(STYLES)],
                marker=marker,
                color=colour,
                markerfacecolor="white" if number % 2 else colour,
                linewidth=1.2,
                label=f"{backend}, {pattern}",
            )
            # To the right of one backend's points and to the left of the other's.
            offset, side = ((5, 4), "left") if number % 2 else ((-5, -9), "right")
            for samples, seconds, rms in points:
                place = (seconds, rms), offset
                axes.annotate(
                    str(samples), *place, textcoords="offset points", ha=side, fontsize=7, color=_GREY
                )
    _label_seconds(axes)
    axes.legend(fontsize=8, title="small numbers: light samples", title_fontsize=8)


def _label_seconds(axes: "Axes") -> None:
    """Write plain numbers at the axis, the more of a decade the fewer decades there are."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7) if high < 10 * low else (1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.minorticks_off()


def _points(report: "ErrorReport", pattern: "Pattern", backend: str) -> list[tuple[int, float, float]]:
    """Samples, seconds and RMS error of a pattern and backend, where there is an error."""
    return [
        (row.samples, row.cost.seconds, row.metrics.rms)
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
