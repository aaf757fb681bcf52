"""Plots of speed: us beside Embree, and cost against size."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from penumbra.measure.plots import COLOURS, new_figure, save_figure

if TYPE_CHECKING:
    from penumbra.measure.peers_report import PeerReport


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
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.tick_params(which="both", labelsize=7)
        axes.grid(True, axis="x", which="both", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
    save_figure(figure, path)
