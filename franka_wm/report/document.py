"""One self-contained HTML file: images and videos inside, one style, light and dark, phone and desktop.

The page's own policy forbids every request, so that a forgotten link to elsewhere fails instead of being followed.
"""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.report.figure import inline_svg
from franka_wm.report.style import DARK, LIGHT, NAMES, Theme
from franka_wm.report.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST = 24 * 2**20
"""A larger file stays beside the page [bytes]: browsers on phones give up on pages of that size."""

KINDS = {".png": "image/png", ".gif": "image/gif", ".jpg": "image/jpeg", ".mp4": "video/mp4"}

# What may load: styles written here, and images and videos that the page itself carries.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"


@dataclass(frozen=True)
class Section:
    """A part of the page, with an entry in its navigation."""

    key: str
    title: str
    body: str


def document(
    title: str, *, subtitle: str, sections: Iterable[Section], above: str = "", below: str = ""
) -> str:
    """The whole page. Titles and `below` are texts; `above` (under the headline) and bodies are HTML."""
    return (
        _templates()
        .get_template("page.html")
        .render(
            title=title,
            subtitle=subtitle,
            sections=[section for section in sections if section.body],
            above=above,
            below=below,
            policy=POLICY,
            light=_colours(LIGHT),
            dark=_colours(DARK),
        )
    )


def write_document(text: str, path: str | Path) -> Path:
    """Write a page whole.

    Raises:
        UserError: the path does not end in .html, or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise UserError(f"cannot write {path.name}: the page must end in .html.")
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


# -- parts: `templates/parts.html` -----------------------------------------------------------------------


def chart(figure: "Figure | None", label: str, note: str = "") -> Markup:
    """A figure drawn in `LIGHT` as a card that follows the page's theme; nothing for None."""
    return Markup() if figure is None else card(inline_svg(figure, label), note)


def card(content: str, note: str = "", *, kind: str = "") -> Markup:
    """HTML on a card of its own, with a line of text below.

    Args:
        kind: `wide` (the whole width), `single` (no wider than an image should be), `strip` (scrolls sideways).
    """
    return _part("card", content, note, kind) if content else Markup()


def cards(*content: str) -> Markup:
    """Cards beside each other, as many as the width has room for."""
    return _part("cards", content) if any(content) else Markup()


def tiles(values: Iterable[tuple[str, str, str]]) -> Markup:
    """Large numbers: name, value, and a small remark."""
    return _part("tiles", values)


def table(values: Table, *, kind: str = "") -> Markup:
    """A table on the page; scrolls sideways by itself where it is too wide. Cells are texts, or parts of a page.

    An interval in brackets goes on a line of its own, so that a phone has room for it.
    """
    return _part("table", values.header, values.rows, kind)


def facts(values: Iterable[tuple[str, str]]) -> Markup:
    """Names and texts in two columns."""
    values = list(values)
    return _part("facts", values) if values else Markup()


def warning(text: str) -> Markup:
    """A line that must not be overlooked."""
    return _part("warning", text)


def paragraph(text: str, kind: str = "") -> Markup:
    """A text; with `kind="note"` a small one. Nothing for an empty one."""
    return _part("paragraph", text, kind) if text else Markup()


def headed(title: str, content: str) -> Markup:
    """HTML below a headline of its own; nothing without content."""
    return _part("headed", title, content) if content else Markup()


def commands(lines: Sequence[str]) -> Markup:
    """Lines for a shell."""
    return _part("commands", lines)


def folded(title: str, content: str) -> Markup:
    """HTML that opens on a click; nothing without content."""
    return _part("folded", title, content) if content else Markup()


def image(path: Path, label: str) -> Markup:
    """An image inside the page."""
    source = data_url(path)
    return left_out(path) if source is None else _part("image", source, label)


def video(path: Path, label: str, *, poster: Path | None = None) -> Markup:
    """A video inside the page; it waits to be started."""
    source = data_url(path)
    if source is None:
        return left_out(path)
    return _part("video", source, label, data_url(poster) if poster is not None else None)


def left_out(path: Path) -> Markup:
    """What stands in a large file's place."""
    size = path.stat().st_size / 2**20
    return paragraph(
        f"{path.name} ({size:.0f} MiB) lies beside this page; it is too large to be in it.", "note"
    )


def data_url(path: Path) -> str | None:
    """A file as text for `src`; None if it is larger than `LARGEST`.

    Raises:
        UserError: it cannot be read.
    """
    try:
        if path.stat().st_size > LARGEST:
            return None
        return f"data:{KINDS[path.suffix.lower()]};base64,{base64.b64encode(path.read_bytes()).decode()}"
    except OSError as error:
        raise UserError(f"cannot read {path}: {error}; make the report again.") from error


def sparkline(values: Sequence[float], label: str) -> Markup:
    """A curve as small as a word; values that are not finite leave a gap."""
    width, height = 120, 26
    values = values[:: max(1, -(-len(values) // (2 * width)))]  # two to a pixel
    finite = [v for v in values if math.isfinite(v)]
    if not finite:
        return Markup()
    low, span = min(finite), max(finite) - min(finite)
    pieces: list[list[tuple[float, float]]] = [[]]
    for k, value in enumerate(values):
        if not math.isfinite(value):
            pieces.append([])
            continue
        x = width / 2 if len(values) == 1 else 2 + (width - 4) * k / (len(values) - 1)
        y = height / 2 if span == 0 else height - 3 - (height - 6) * (value - low) / span
        pieces[-1].append((x, y))
    lines = [piece for piece in pieces if len(piece) > 1]
    dots = [piece[0] for piece in pieces if len(piece) == 1]
    return _part("sparkline", lines, dots, label, width, height)


@cache
def _templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("franka_wm.report"),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    templates.tests["html"] = lambda value: isinstance(value, Markup)
    return templates


def _part(name: str, *values: object) -> Markup:
    return getattr(_templates().get_template("parts.html").module, name)(*values)


def _colours(theme: Theme) -> list[tuple[str, str]]:
    return [(name, theme.colour(light)) for light, name in NAMES.items()]
