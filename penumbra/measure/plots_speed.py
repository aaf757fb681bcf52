"""Plots of speed: us beside Embree, and cost against size."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from penumbra.measure.plots import COLOURS, MARKERS, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axis import Axis

    from penumbra.measure.peers_report import PeerReport
    from penumbra.measure.scaling_report import ScalingReport

_AXIS_LABELS = {
    "triangles": "triangles of the same surface",
    "resolution": "receivers",
    "samples": "light samples",
    "area": "area of the light",
}


def draw_peers(report: "PeerReport", path: Path) -> None:
    """Draw processor seconds of both sides, scene by scene, and the ratio with its spread."""
    figure, (seconds, ratios) = new_figure(2)
    place = np.arange(len(report.rows))
    names = [row.name for row in report.rows]
    for side, label, colour, marker in (
        ("ours", "penumbra", COLOURS[0], "o"),
        ("embree", "Embree", COLOURS[1], "s"),
    ):
        values = [np.median([one.cpu_seconds for one in getattr(row.rounds, side)]) for row in report.rows]
        seconds.plot(values, place, marker, color=colour, label=label)
    seconds.set(xscale="log", xlabel="processor seconds of a pass, all threads")
    seconds.legend(fontsize=8)
    for at, row in zip(place, report.rows, strict=True):
        ratio = row.rounds.ratio("cpu_seconds")
        ratios.plot([ratio.low, ratio.high], [at, at], color=COLOURS[0], linewidth=1.5)
        ratios.plot(ratio.median, at, "o", color=COLOURS[0])
    ratios.axvline(1.0, color="#666666", linewidth=0.9)
    ratios.set(xscale="log", xlabel="Embree's processor time over ours")
    for axes in (seconds, ratios):
        axes.set_yticks(place, names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        _plain_ticks(axes.xaxis)
        axes.grid(True, axis="x", which="major", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
    save_figure(figure, path)


def draw_scaling(report: "ScalingReport", path: Path) -> None:
    """Draw processor seconds along every axis: a colour for each scene, Embree hollow and dashed."""
    axes_names = list(dict.fromkeys(row.axis for row in report.rows))
    scenes = list(dict.fromkeys(row.scene for row in report.rows))
    exponents = {(e.scene, e.axis, e.quantity): str(e) for e in report.exponents}
    figure, panels = new_figure(len(axes_names))
    for axes, axis in zip(panels, axes_names, strict=True):
        for number, scene in enumerate(scenes):
            along = [row for row in report.rows if (row.scene, row.axis) == (scene, axis)]
            colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
            for quantity, side, style, face in (
                ("our_cpu_seconds", "penumbra", "-", colour),
                ("embree_cpu_seconds", "Embree", "--", "white"),
            ):
                values = [(row.x, row.quantity(quantity)) for row in along]
                points = [(x, seconds) for x, seconds in values if seconds is not None]
                if points:
                    axes.plot(
                        [x for x, _ in points],
                        [seconds for _, seconds in points],
                        style,
                        marker=marker,
                        color=colour,
                        markerfacecolor=face,
                        label=f"{scene}, {side}: {exponents[scene, axis, quantity]}",
                    )
        axes.set(xscale="log", yscale="log", xlabel=_AXIS_LABELS[axis])
        _plain_ticks(axes.xaxis)
        _plain_ticks(axes.yaxis)
        axes.grid(True, which="major", color="#DDDDDD", linewidth=0.8)
        axes.legend(fontsize=7, title="exponent", title_fontsize=7)
    # One scale of seconds: slopes are then compared by eye.
    lowest, highest = zip(*(axes.get_ylim() for axes in panels), strict=True)
    for axes in panels:
        axes.set_ylim(min(lowest), max(highest))
    panels[0].set_ylabel("processor seconds of a pass, all threads")
    save_figure(figure, path)


def _plain_ticks(axis: "Axis") -> None:
    """Label 1, 2 and 5 of every decade of a logarithmic axis, as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")
