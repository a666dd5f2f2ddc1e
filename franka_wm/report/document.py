"""One self-contained HTML file: pictures and videos inside, one style, light and dark, phone and desktop.

The page's own policy forbids every request, so that a forgotten link to elsewhere fails instead of being followed.
"""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.report.figure import inline_svg
from franka_wm.report.style import DARK, LIGHT, NAMES, Theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST = 24 * 2**20
"""A larger file stays beside the page [bytes]: browsers on phones give up on pages of that size."""

KINDS = {".png": "image/png", ".gif": "image/gif", ".jpg": "image/jpeg", ".mp4": "video/mp4"}

# What may load: styles written here, and pictures and videos that the page itself carries.
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
    """The whole page. `title` and `subtitle` are texts; `above` (under the headline), `below` and bodies are HTML."""
    parts = [section for section in sections if section.body]
    links = "".join(f'<a href="#{s.key}">{escape(s.title)}</a>' for s in parts)
    body = "".join(f'<section id="{s.key}"><h2>{escape(s.title)}</h2>{s.body}</section>\n' for s in parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{stylesheet()}</style></head>\n<body>"
        f'<header><h1>{escape(title)}</h1><p class="sub">{escape(subtitle)}</p>{above}</header>\n'
        f"<nav>{links}</nav>\n<main>{body}</main>\n<footer>{below}</footer></body></html>\n"
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


# -- parts -----------------------------------------------------------------------------------------------


def chart(figure: "Figure | None", label: str, note: str = "") -> str:
    """A figure drawn in `LIGHT` as a card that follows the page's theme; nothing for None."""
    if figure is None:
        return ""
    return card(inline_svg(figure, label), note)


def card(content: str, note: str = "", *, kind: str = "") -> str:
    """HTML on a card of its own, with a line of text below.

    Args:
        kind: `wide` (the whole width), `single` (no wider than a picture should be), `strip` (scrolls sideways).
    """
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    return f'<figure class="{f"card {kind}".strip()}">{content}{caption}</figure>' if content else ""


def cards(*content: str) -> str:
    """Cards beside each other, as many as the width has room for."""
    filled = [one for one in content if one]
    return f'<div class="cards">{"".join(filled)}</div>' if filled else ""


def tiles(values: Iterable[tuple[str, str, str]]) -> str:
    """Large numbers: name, value, and a small remark."""
    return (
        '<dl class="tiles">'
        + "".join(
            f"<div><dt>{escape(name)}</dt><dd>{escape(value)}"
            f"{f'<small>{escape(note)}</small>' if note else ''}</dd></div>"
            for name, value, note in values
        )
        + "</dl>"
    )


def scrolling(table: str) -> str:
    """A table that scrolls sideways by itself where the page is too narrow for it."""
    return f'<div class="scroll" tabindex="0">{table}</div>'


def facts(values: Iterable[tuple[str, str]]) -> str:
    """Names and texts in two columns."""
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in values)
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def warning(text: str) -> str:
    """A line that must not be overlooked."""
    return f'<p class="warning" role="alert">{escape(text)}</p>'


def commands(lines: Sequence[str]) -> str:
    """Lines for a shell."""
    return f"<pre><code>{escape(chr(10).join(lines))}</code></pre>"


def folded(title: str, content: str) -> str:
    """HTML that opens on a click."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def picture(path: Path, label: str) -> str:
    """A picture inside the page."""
    source = data_url(path)
    if source is None:
        return left_out(path)
    return f'<img alt="{escape(label, quote=True)}" src="{source}">'


def video(path: Path, label: str, *, poster: Path | None = None) -> str:
    """A video inside the page; it waits to be started."""
    source = data_url(path)
    if source is None:
        return left_out(path)
    still = data_url(poster) if poster is not None else None
    shown = f' poster="{still}"' if still else ""
    return (
        f'<video controls loop muted playsinline preload="metadata" aria-label="{escape(label, quote=True)}"{shown} '
        f'src="{source}"></video>'
    )


def left_out(path: Path) -> str:
    """What stands in a large file's place."""
    size = path.stat().st_size / 2**20
    name = escape(path.name)
    return f'<p class="note">{name} ({size:.0f} MiB) lies beside this page; it is too large to be in it.</p>'


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


def sparkline(values: Sequence[float], label: str) -> str:
    """A curve as small as a word; values that are not finite leave a gap."""
    width, height = 120.0, 26.0
    finite = [v for v in values if math.isfinite(v)]
    if not finite:
        return ""
    low, span = min(finite), max(finite) - min(finite)
    pieces: list[list[str]] = [[]]
    for k, value in enumerate(values):
        if not math.isfinite(value):
            pieces.append([])
            continue
        x = width / 2 if len(values) == 1 else 2 + (width - 4) * k / (len(values) - 1)
        y = height / 2 if span == 0 else height - 3 - (height - 6) * (value - low) / span
        pieces[-1].append(f"{x:.1f},{y:.1f}")
    lines = "".join(f'<polyline points="{" ".join(piece)}"/>' for piece in pieces if len(piece) > 1)
    dots = "".join(
        f'<circle cx="{piece[0].split(",")[0]}" cy="{piece[0].split(",")[1]}" r="2.5"/>'
        for piece in pieces
        if len(piece) == 1
    )
    return (
        f'<svg class="spark" role="img" aria-label="{escape(label, quote=True)}" viewBox="0 0 {width:.0f} '
        f'{height:.0f}">{lines}{dots}</svg>'
    )


# -- style -----------------------------------------------------------------------------------------------


def stylesheet() -> str:
    """The page's CSS; its colours are those of the figures."""
    dark = f":root{{{_variables(DARK)}--page:#0d1117;--shade:#21262d;--alert:#3b2300}}"
    light = f":root{{{_variables(LIGHT)}--page:#f6f8fa;--shade:#eef1f4;--alert:#fff1e5;--font:{_FONT}}}"
    return f"{light}@media (prefers-color-scheme:dark){{{dark}}}{_RULES}"


def _variables(theme: Theme) -> str:
    return "".join(f"--{name}:{theme.colour(light)};" for light, name in NAMES.items())


_FONT = "system-ui,-apple-system,'Segoe UI',Roboto,'Helvetica Neue','DejaVu Sans',sans-serif"

_RULES = """
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;scroll-behavior:smooth}
@media (prefers-reduced-motion:reduce){html{scroll-behavior:auto}}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.5 var(--font)}
header,main,footer{max-width:1120px;margin:0 auto;padding:0 20px}
header{padding-top:36px}
h1{margin:0;font-size:30px;line-height:1.2;letter-spacing:-.01em;overflow-wrap:anywhere}
h2{margin:0 0 12px;font-size:20px}
h3{margin:20px 0 8px;font-size:16px}
.sub{margin:6px 0 0;opacity:.75;overflow-wrap:anywhere}
nav{position:sticky;top:0;z-index:2;background:var(--page);border-bottom:1px solid var(--faint);margin:24px 0 0;
padding:0 max(20px,calc((100% - 1080px)/2));display:flex;gap:18px;overflow-x:auto;white-space:nowrap;
scrollbar-width:none}
nav a{color:var(--ink);text-decoration:none;padding:10px 0;font-size:14px;opacity:.8}
nav a:hover,nav a:focus{opacity:1;box-shadow:inset 0 -2px var(--blue)}
section{padding:28px 0 4px;scroll-margin-top:40px}
.cards{display:grid;gap:16px;grid-template-columns:repeat(auto-fit,minmax(min(100%,340px),1fr));align-items:start;
margin:12px 0}
.cards>.card{margin:0}
.cards>.card:only-child:not(.wide){max-width:620px}
.card{background:var(--paper);border:1px solid var(--faint);border-radius:10px;padding:12px;margin:12px 0;min-width:0}
.card.wide{grid-column:1/-1}
.card img,.card video{display:block;width:100%;height:auto;border-radius:6px}
.card.single{max-width:620px}
.card.strip{overflow-x:auto}
.card.strip img{min-width:620px}
/* matplotlib leaves black fills out: they inherit */
.chart{fill:var(--black);display:block;width:100%;height:auto;max-width:560px;margin:0 auto}
figcaption,.note{font-size:14px;opacity:.8;margin:8px 2px 0}
section>p{margin:0 0 12px;max-width:70ch}
.tiles{display:grid;gap:12px;grid-template-columns:repeat(auto-fit,minmax(142px,1fr));margin:22px 0 0}
.tiles div{background:var(--paper);border:1px solid var(--faint);border-radius:10px;padding:10px 14px}
.tiles dt{font-size:13px;opacity:.75}
.tiles dd{margin:0;font-size:24px;font-weight:600;font-variant-numeric:tabular-nums;line-height:1.3}
.tiles small{display:block;font-size:12px;font-weight:400;opacity:.7}
/* a shadow at the side where there is more to scroll to; it moves off at the end */
.scroll{overflow-x:auto;scrollbar-width:thin;background:
linear-gradient(to right,var(--paper) 40%,transparent) left/48px 100% no-repeat local,
linear-gradient(to left,var(--paper) 40%,transparent) right/48px 100% no-repeat local,
linear-gradient(to right,var(--grey),transparent) left/16px 100% no-repeat,
linear-gradient(to left,var(--grey),transparent) right/16px 100% no-repeat,var(--paper);
border:1px solid var(--faint);border-radius:10px;margin:12px 0}
table{border-collapse:collapse;width:100%;font-size:14px;font-variant-numeric:tabular-nums}
th,td{padding:8px 12px;text-align:right;border-bottom:1px solid var(--faint);vertical-align:top}
tbody tr:last-child>*{border-bottom:0}
th:first-child{text-align:left;position:sticky;left:0;background:var(--paper);z-index:1}
thead th{font-weight:600;vertical-align:bottom;font-size:13px}
tbody th{font-weight:500;overflow-wrap:anywhere;min-width:100px}
td{white-space:nowrap}
td small{display:block;opacity:.65;font-size:12px}
table.texts td{text-align:left;white-space:normal;overflow-wrap:anywhere}
table.texts th{text-align:left}
.facts{display:grid;grid-template-columns:fit-content(58%) minmax(0,1fr);gap:4px 20px;margin:0 0 12px;font-size:15px}
.facts dt{opacity:.7}
.facts dd{margin:0;overflow-wrap:anywhere}
.warning{background:var(--alert);border-left:4px solid var(--vermilion);border-radius:6px;padding:10px 14px;
margin:16px 0 0;max-width:none}
pre{background:var(--shade);border-radius:8px;padding:12px 14px;overflow-x:auto;font-size:13px;line-height:1.5;
margin:8px 0}
details{margin:10px 0}
summary{cursor:pointer;font-size:15px}
.spark{width:120px;height:26px;vertical-align:middle}
.spark polyline{fill:none;stroke:var(--blue);stroke-width:1.6;stroke-linejoin:round}
.spark circle{fill:var(--blue)}
footer{padding-top:20px;padding-bottom:48px;font-size:13px;opacity:.7}
@media (max-width:600px){
header,main,footer{padding-left:14px;padding-right:14px}
header{padding-top:22px}
nav{padding-left:14px;padding-right:14px}
h1{font-size:24px}
.tiles{grid-template-columns:1fr 1fr;gap:8px}
.tiles dd{font-size:20px}
th,td{padding:7px 9px}
.facts{gap:4px 14px;font-size:14px}
.card{padding:8px}
}
@media print{nav{display:none}.card,.scroll{break-inside:avoid}}
"""
