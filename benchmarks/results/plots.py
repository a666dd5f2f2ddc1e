"""Pictures of a benchmark's rows, for docs/results.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.results.rows import Row
from franka_wm.files import atomic_write
from franka_wm.report.figure import finish_axes, new_figure
from franka_wm.report.style import BLUE, GREY, LIGHT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 3


def draw(row: Row, record: Mapping[str, Any]) -> Figure:
    """A panel for each value of the column ``panels``, with the columns ``x`` and ``y`` on logarithmic scales.

    A grey line shows what would grow in proportion, through the last point.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    assert row.plot is not None
    panels, x, y = (row.plot[key] for key in ("panels", "x", "y"))
    names = list(dict.fromkeys(one[panels] for one in record["rows"]))
    columns = min(COLUMNS, len(names))
    figure, grid = new_figure(rows=-(-len(names) // columns), columns=columns, width=3.2, height=2.6)
    for axes in grid[len(names) :]:
        axes.remove()
    for axes, name in zip(grid, names, strict=False):
        points = [(one[x], one[y]) for one in record["rows"] if one[panels] == name]
        sizes, values = zip(*points, strict=True)
        proportional = [values[-1] * size / sizes[-1] for size in sizes]
        axes.plot(sizes, proportional, color=LIGHT.colour(GREY), linewidth=0.8, linestyle="--")
        axes.plot(sizes, values, color=LIGHT.colour(BLUE), marker="o", markersize=4)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(min(values) / 2, max(values) * 2)
        for axis, subs in ((axes.xaxis, (1.0,)), (axes.yaxis, (1.0, 2.0, 5.0))):
            axis.set_major_locator(LogLocator(subs=subs))
            axis.set_major_formatter(lambda value, _: f"{value:,.10g}")
            axis.set_minor_formatter(NullFormatter())
        finish_axes(axes, x=name, y=y, legend=False)
    return figure


def write(row: Row, record: Mapping[str, Any], place: Path) -> Path:
    """Draws a row's picture into the folder of the results; the same numbers give the same file."""
    import matplotlib

    path, figure = place / row.picture, draw(row, record)
    with (
        matplotlib.rc_context({"svg.hashsalt": row.name, "svg.fonttype": "none"}),
        atomic_write(path) as temporary,
    ):
        figure.savefig(temporary, format="svg", metadata={"Date": None}, facecolor=figure.get_facecolor())
    return path
