"""Figures in one style: made, finished, saved as a file or as SVG inside a page.

A function that draws takes data and gives a `Figure`; `save_figure` writes it. Figures are made without
pyplot: no global state, no window, whatever backend the user has set.
"""

import hashlib
import io
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape, quoteattr

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.report.style import FAINT, GREY, INK, LIGHT, NAMES, PAPER, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("pdf", "png", "svg")
WIDTH, HEIGHT = 4.6, 3.1
"""Size of one panel [inch]: still readable across a phone."""
MOST_IN_COLUMN = 16
"""Entries of a legend."""
LONGEST = 40
"""Characters of a run's name beside its bar or curve."""

_VARIABLES = {light.lower(): f"var(--{name})" for light, name in NAMES.items()}


def new_figure(
    *,
    rows: int = 1,
    columns: int = 1,
    width: float = WIDTH,
    height: float = HEIGHT,
    theme: Theme = LIGHT,
    sharex: bool = False,
) -> tuple["Figure", list["Axes"]]:
    """An empty figure in the theme's colours, and its panels row by row; `width`, `height` of one [inch]."""
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(columns * width, rows * height), layout="constrained", facecolor=theme.colour(PAPER)
    )
    grid: Any = figure.subplots(rows, columns, sharex=sharex, squeeze=False)
    panels = list(grid.flat)
    for axes in panels:
        axes.set_facecolor(theme.colour(PAPER))
        axes.tick_params(colors=theme.colour(INK), labelsize=8.5)
        for side in axes.spines.values():
            side.set_color(theme.colour(GREY))
        axes.xaxis.label.set_color(theme.colour(INK))
        axes.yaxis.label.set_color(theme.colour(INK))
    return figure, panels


def finish_axes(
    axes: "Axes",
    *,
    x: str = "",
    y: str = "",
    title: str = "",
    theme: Theme = LIGHT,
    legend: bool = True,
    grid: str = "both",
) -> None:
    """Labels, light grid, no box; a legend if anything is labelled. A panel without data says so."""
    ink = theme.colour(INK)
    axes.set_xlabel(x, color=ink, fontsize=9)
    axes.set_ylabel(y, color=ink, fontsize=9)
    axes.set_title(as_label(title), color=ink, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    if grid:
        axes.grid(axis=grid, color=theme.colour(FAINT), linewidth=0.6)  # pyright: ignore[reportArgumentType]
    if not axes.has_data():
        grey = theme.colour(GREY)
        axes.text(0.5, 0.5, "nothing logged", transform=axes.transAxes, ha="center", color=grey)
    elif legend and (count := len(axes.get_legend_handles_labels()[1])):
        small, columns = count > 10, 1 + (count - 1) // MOST_IN_COLUMN
        drawn = axes.legend(frameon=False, fontsize=6 if small else 8, labelcolor=ink, ncols=columns)
        drawn.set_in_layout(False)  # else a long one leaves the curves no room


def shortened(names: Iterable[str]) -> list[str]:
    """Names of runs without the middle of long ones; those that look the same then are numbered."""
    out: list[str] = []
    for name in names:
        text = name if len(name) <= LONGEST else f"{name[: LONGEST // 2 - 2]}…{name[1 - LONGEST // 2 :]}"
        same = sum(one == text or one.startswith(f"{text} (") for one in out)
        out.append(f"{text} ({same + 1})" if same else text)
    return out


def as_label(text: str) -> str:
    """A name that others chose, as matplotlib shows it unchanged: no formula, and not left out of the legend."""
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def check_format(path: str | Path) -> str:
    """The format that a path's ending asks for.

    Raises:
        UserError: another one than `FORMATS`.
    """
    path = Path(path)
    kind = path.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise UserError(f"cannot draw {path.name}: the file must end in .{', .'.join(FORMATS)}.")
    return kind


def save_figure(figure: "Figure", path: str | Path) -> Path:
    """Write a figure; its folder is made.

    Returns:
        `path`.

    Raises:
        UserError: an ending other than .pdf, .png, .svg, or the file cannot be written.
    """
    kind = check_format(path)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=150, facecolor=figure.get_facecolor())
    return Path(path)


def inline_svg(figure: "Figure", label: str) -> str:
    """The figure as an `<svg>` element for a page that gives the colours as CSS variables.

    Draw it in `LIGHT`: every named colour becomes `var(--its-name)`, so that one image follows the page's
    light and dark theme. Text stays text, in the page's font. The same figure gives the same element.

    Args:
        label: what a screen reader says.
    """
    import matplotlib

    buffer = io.StringIO()
    # Ids of clip paths and markers must differ between the images of one page, and not between two runs.
    salt = hashlib.sha256(label.encode()).hexdigest()[:12]
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    # Names of groups ("axes_1") repeat in every image and nothing refers to them.
    svg = re.sub(r' id="[\w.]+_\d+"', "", svg)
    svg = re.sub(
        r"(fill|stroke): (#[0-9a-f]{6})\b",
        lambda found: f"{found[1]}: {_VARIABLES.get(found[2], found[2])}",
        svg,
    )
    # Older versions of matplotlib write the short form.
    svg = re.sub(r"(font-family:|font: [^;\"]*?px) [^;\"]+", r"\1 var(--font)", svg)
    size = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    assert size is not None  # matplotlib always writes one
    head = (
        f'<svg class="chart" role="img" aria-label={quoteattr(label)} viewBox="{size[0][9:-1]}" '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
        f"<title>{escape(label)}</title>"
    )
    return head + svg[svg.index(">") + 1 :].strip()
