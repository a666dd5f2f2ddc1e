"""Tables of an evaluation: Markdown, LaTeX, JSON, a terminal's, from the dict that `evaluation.json` holds.

`evaluation_table` and `nested_table` make a `Table` of texts; `markdown`, `latex` and `html` write any of them.
`records` and `data_frame` give the numbers themselves.
"""

import html as escaping
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.report.style import BLACK, centimetres, policy_colour, policy_name

if TYPE_CHECKING:
    from pandas import DataFrame
    from rich.table import Table as RichTable

# {policy: {"final_distance": interval, "success": {distance: interval}, "return": interval, "episodes": n}},
# where an interval is {"mean", "low", "high"}; a policy may hold more numbers and intervals. Of tasks whose success is
# not a distance to a goal there is none, "success" is one interval, and "measures" holds those of the task's own.
type Evaluation = Mapping[str, Mapping[str, Any]]

REQUIRED = ("final_distance", "success", "return", "episodes")
OUTCOME = (*REQUIRED, "measures")

# key -> (title, factor to that unit, digits). Keys of rates by distance have the distance after them.
TITLES: dict[str, tuple[str, float, int]] = {
    "final_distance": ("final distance [cm]", 100, 2),
    "success": ("success at {} [%]", 100, 0),
    "success_once": ("once within {} [%]", 100, 0),
    "return": ("return", 1, 2),
    "path_length": ("path [cm]", 100, 1),
    "action_change": ("change of action²", 1, 3),
    "jerk": ("jerk [m/s³]", 1, 1),
    "change": ("change [cm]", 100, 2),
    "episodes": ("episodes", 1, 0),
    "length": ("steps", 1, 1),
}


@dataclass(frozen=True)
class Table:
    """Texts in rows and columns; the first column names the rows."""

    header: list[str]
    rows: list[list[str]]


# -- making ----------------------------------------------------------------------------------------------


def evaluation_table(evaluation: Evaluation) -> Table:
    """One row per policy, `mean (low – high)` in every cell; distances [m] in centimetres, rates in percent.

    Columns beside the `REQUIRED` ones come from whatever numbers and intervals the policies hold.

    Raises:
        UserError: a policy lacks one of the `REQUIRED` entries, or an interval one of its numbers.
    """
    header, rows = _cells(evaluation)
    return Table(header, [[policy_name(policy), *cells] for policy, cells in rows])


def evaluation_tables(evaluation: Evaluation) -> tuple[Table, Table]:
    """`evaluation_table` in two that are less wide: how episodes ended, and what was measured on the way.

    Policies may lack entries; the second table has no rows where nothing more was measured.
    """
    tables = []
    for outcome in (True, False):
        header, rows = _cells(evaluation, strict=False, keep=lambda name, o=outcome: (name in OUTCOME) is o)
        named = [[policy_name(policy), *cells] for policy, cells in rows] if len(header) > 1 else []
        tables.append(Table(header, named))
    return tables[0], tables[1]


def nested_table(
    values: Mapping[str, Any], *, first: str = "", skip: Sequence[str] = (), digits: int = 3
) -> Table:
    """Any dict of dicts: outer keys are rows; numbers, intervals and texts inside are columns.

    Deeper keys are joined with ` / `. Where an outer value is not a dict, it fills the column `value`.

    Args:
        first: title of the first column.
        skip: inner keys that are left out.
        digits: significant digits of numbers without a known unit.
    """
    flat = {
        str(name): {
            path: leaf
            for path, leaf in _leaves(value if isinstance(value, Mapping) else {"value": value})
            if path[0] not in skip
        }
        for name, value in values.items()
    }
    paths = list(dict.fromkeys(path for row in flat.values() for path in row))
    header = [first, *(_title(path) for path in paths)]
    rows = [
        [name, *(_text(path, row[path], digits) if path in row else "–" for path in paths)]
        for name, row in flat.items()
    ]
    return Table(header, rows)


# -- writing ---------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """As Markdown, numbers to the right."""
    lines = [table.header, *table.rows]
    text = [
        "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |" for row in lines
    ]
    text.insert(1, "|---|" + "---:|" * (len(table.header) - 1))
    return "\n".join(text) + "\n"


def latex(table: Table, *, caption: str | None = None, label: str | None = None) -> str:
    """As a LaTeX `tabular` with the rules of booktabs; inside a `table` if there is a caption or a label.

    What LaTeX would take for a command is escaped.
    """
    lines = [" & ".join(map(latex_escape, row)) + r" \\" for row in (table.header, *table.rows)]
    body = "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * (len(table.header) - 1)}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
        ]
    )
    if caption is None and label is None:
        return body + "\n"
    around = [r"\begin{table}", r"\centering"]
    around += [] if caption is None else [rf"\caption{{{latex_escape(caption)}}}"]
    around += [] if label is None else [rf"\label{{{label}}}"]
    return "\n".join([*around, body, r"\end{table}"]) + "\n"


def latex_escape(text: str) -> str:
    """Text that LaTeX prints as it is: `50 % of a_b` → `50 \\% of a\\_b`."""
    special = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "–": "--",
        "−": "$-$",
        "×": r"$\times$",
        "²": r"$^2$",
        "±": r"$\pm$",
    }
    special |= {one: f"\\{one}" for one in "&%$#_{}"}
    return "".join(special.get(one, one) for one in text)


def html(table: Table, *, kind: str = "") -> str:
    """As an HTML `<table>`; an interval in brackets goes on a line of its own, so that a phone has room for it."""
    head = "".join(f'<th scope="col">{escaping.escape(cell)}</th>' for cell in table.header)
    body = "".join(
        f'<tr><th scope="row">{escaping.escape(name)}</th>{"".join(map(_html_cell, cells))}</tr>'
        for name, *cells in table.rows
    )
    attribute = f' class="{kind}"' if kind else ""
    return f"<table{attribute}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def markdown_table(evaluation: Evaluation) -> str:
    """`evaluation_table` as Markdown.

    Raises:
        UserError: a policy lacks one of the entries.
    """
    return markdown(evaluation_table(evaluation))


def latex_table(evaluation: Evaluation, *, caption: str | None = None, label: str | None = None) -> str:
    """`evaluation_table` as LaTeX; see `latex`.

    Raises:
        UserError: a policy lacks one of the entries.
    """
    return latex(evaluation_table(evaluation), caption=caption, label=label)


def write_tables(evaluation: Evaluation, folder: str | Path, *, name: str = "evaluation") -> list[Path]:
    """Write `name.md`, `name.tex` and `name.csv` (plain numbers) into a folder.

    Raises:
        UserError: a policy lacks one of the entries, or a file cannot be written.
    """
    texts = {
        "md": markdown_table(evaluation),
        "tex": latex_table(evaluation),
        "csv": data_frame(evaluation).to_csv(index=False),
    }
    paths = []
    for ending, text in texts.items():
        path = Path(folder) / f"{name}.{ending}"
        with atomic_write(path) as temporary:
            temporary.write_text(text)
        paths.append(path)
    return paths


# -- numbers ---------------------------------------------------------------------------------------------


def records(values: Mapping[str, Any], *, first: str = "policy") -> list[dict[str, Any]]:
    """Any dict of dicts as flat records with plain numbers, in SI units as they were measured.

    An interval becomes three entries: `name`, `name/low`, `name/high`.
    """
    out = []
    for name, value in values.items():
        record: dict[str, Any] = {first: name}
        for path, leaf in _leaves(value if isinstance(value, Mapping) else {"value": value}):
            key = "/".join(path)
            if isinstance(leaf, Mapping):
                record |= {
                    key if part == "mean" else f"{key}/{part}": number for part, number in leaf.items()
                }
            else:
                record[key] = leaf
        out.append(record)
    return out


def json_table(values: Mapping[str, Any], *, first: str = "policy") -> str:
    """`records` as JSON. Numbers that JSON does not know (NaN, infinity) become null."""
    clean = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
        for record in records(values, first=first)
    ]
    return json.dumps(clean, indent=2, allow_nan=False) + "\n"


def data_frame(values: Mapping[str, Any], *, first: str = "policy") -> "DataFrame":
    """`records` as a pandas table, for what a spreadsheet or a notebook does next."""
    from pandas import DataFrame

    return DataFrame(records(values, first=first))


# -- the terminal ------------------------------------------------------------------------------------------


def terminal_table(evaluation: Evaluation, title: str | None = None) -> "RichTable":
    """`evaluation_table` as a `rich` table, to be printed by the caller's console.

    Raises:
        UserError: a policy lacks one of the entries.
    """
    from rich.markup import escape
    from rich.table import Table as RichTable

    header, rows = _cells(evaluation)
    table = RichTable(title=title)
    table.add_column(header[0])
    for name in header[1:]:
        table.add_column(escape(name), justify="right")  # [cm] would be taken for a style
    for policy, cells in rows:
        # Black, "doing nothing", would be invisible on most terminals.
        colour = policy_colour(policy)
        name = escape(policy_name(policy))
        table.add_row(name if colour == BLACK else f"[{colour}]{name}[/]", *cells)
    return table


# -- cells -----------------------------------------------------------------------------------------------


def is_interval(value: Any) -> bool:
    """Whether something is ``{"mean": …, "low": …, "high": …}``."""
    return isinstance(value, Mapping) and {"mean", "low", "high"} <= value.keys()


def _cells(
    evaluation: Evaluation, *, strict: bool = True, keep: Callable[[str], bool] = lambda name: True
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Column titles, and the cells of every policy without its name."""
    reaches = any("final_distance" in result for result in evaluation.values())
    required = REQUIRED if reaches else REQUIRED[2:]  # elsewhere there is no goal to be away from
    flat = {}
    for policy, result in evaluation.items():
        for name in required if strict else ():
            if name not in result:
                raise UserError(
                    f"the evaluation lacks {name!r}; every policy needs {', '.join(required[:-1])} and "
                    f"{required[-1]}, every interval mean, low and high."
                )
        leaves = _leaves(result)
        flat[policy] = {path: leaf for path, leaf in leaves if not isinstance(leaf, str) and keep(path[0])}
    found = dict.fromkeys(path for row in flat.values() for path in row)
    # What is required frames the rest: distance and success first, return and the number of episodes last.
    places = {"final_distance": 0, "success": 1, "success_once": 2, "return": 4, "episodes": 5}
    paths = sorted(found, key=lambda path: (places.get(path[0], 3), *_by_distance(path)))
    rows = [
        (policy, [_text(path, row[path], 3) if path in row else "–" for path in paths])
        for policy, row in flat.items()
    ]
    return ["policy", *map(_title, paths)], rows


def _by_distance(path: tuple[str, ...]) -> tuple[float, ...]:
    """Largest distance first, the order in which they get harder; other entries stay as they came."""
    try:
        return (-float(path[-1]),)
    except ValueError:
        return (0.0,)


def _leaves(values: Mapping[str, Any], above: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """Numbers, texts and intervals with their paths; lists are no leaves of a table."""
    out: list[tuple[tuple[str, ...], Any]] = []
    for name, value in values.items():
        path = (*above, str(name))
        if isinstance(value, Mapping) and not is_interval(value):
            out += _leaves(value, path)
        elif value is None or isinstance(value, (Mapping, int, float, str)):
            out.append((path, value))
    return out


def _title(path: tuple[str, ...]) -> str:
    title, _, _ = TITLES.get(path[0], ("", 1, 0))
    if "{}" in title and len(path) == 2 and _is_number(path[1]):
        return title.format(centimetres(path[1]))
    if title and len(path) == 1:
        return title.replace(" at {}", "").replace(" within {}", "")
    path = path[1:] if path[0] == "measures" else path
    return " / ".join(part.replace("_", " ") for part in path)


def _text(path: tuple[str, ...], value: Any, digits: int) -> str:
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    known = TITLES.get(path[0])
    numbers = [value[part] for part in ("mean", "low", "high")] if isinstance(value, Mapping) else [value]
    if any(number is None for number in numbers):
        return "–"
    if known is not None:
        _, scale, places = known
        mean, *ends = (f"{scale * number:.{places}f}" for number in numbers)
    else:
        mean, *ends = (
            f"{number:.{digits}g}" if isinstance(number, float) else str(number) for number in numbers
        )
    return f"{mean} ({ends[0]} – {ends[1]})" if ends else mean


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _html_cell(text: str) -> str:
    mean, bracket, interval = text.partition(" (")
    small = f"<small>{escaping.escape(bracket.strip() + interval)}</small>" if bracket else ""
    return f"<td>{escaping.escape(mean)}{small}</td>"
