"""Tables of an evaluation, from the dict that `evaluation.json` holds.

`evaluation_tables` and `nested_table` make a `Table` of texts; `markdown` writes any of them.
`data_frame` gives the numbers themselves to pandas, which writes LaTeX, JSON, CSV and more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from franka_wm.evaluation.intervals import scaled
from franka_wm.report.style import centimetres, policy_name

if TYPE_CHECKING:
    from pandas import DataFrame

# {policy: {"final_distance": interval, "success": {distance: interval}, "return": interval, "episodes": n}},
# where an interval is {"mean", "low", "high"}; a policy may hold more numbers and intervals. Of tasks whose success is
# not a distance to a goal there is none, "success" is one interval, and "measures" holds those of the task's own.
type Evaluation = Mapping[str, Mapping[str, object]]

OUTCOME = ("final_distance", "success", "task_success", "return", "episodes", "measures")

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


def evaluation_tables(evaluation: Evaluation) -> tuple[Table, Table]:
    """One row per policy, `mean (low – high)` in every cell; distances [m] in centimetres, rates in percent.

    The first table says how episodes ended, the second what was measured on the way; it has no rows where nothing
    more was. Columns besides the `OUTCOME` come from whatever numbers and intervals the policies hold.
    """
    tables = []
    for outcome in (True, False):
        header, rows = _cells(evaluation, lambda name, o=outcome: (name in OUTCOME) is o)
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


# -- numbers ---------------------------------------------------------------------------------------------


def data_frame(values: Mapping[str, object], *, first: str = "policy") -> "DataFrame":
    """Any dict of dicts as a pandas table of plain numbers, in SI units as they were measured.

    An interval becomes three columns: `name`, `name/low`, `name/high`.
    """
    from pandas import DataFrame

    rows = []
    for name, value in values.items():
        row: dict[str, Any] = {first: name}
        for path, leaf in _leaves(value if isinstance(value, Mapping) else {"value": value}):
            key = "/".join(path)
            parts = leaf.items() if isinstance(leaf, Mapping) else [("mean", leaf)]
            row |= {key if part == "mean" else f"{key}/{part}": number for part, number in parts}
        rows.append(row)
    return DataFrame(rows)


# -- cells -----------------------------------------------------------------------------------------------


def is_interval(value: Any) -> bool:
    """Whether something is ``{"mean": …, "low": …, "high": …}``."""
    return isinstance(value, Mapping) and {"mean", "low", "high"} <= value.keys()


def _cells(
    evaluation: Evaluation, keep: Callable[[str], bool]
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Column titles, and the cells of every policy without its name, of the entries to keep."""
    flat = {}
    for policy, result in evaluation.items():
        leaves = _leaves(result)
        flat[policy] = {path: leaf for path, leaf in leaves if not isinstance(leaf, str) and keep(path[0])}
    found = dict.fromkeys(path for row in flat.values() for path in row)
    # The outcome frames the rest: distance and success first, return and the number of episodes last.
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


def _leaves(
    values: Mapping[str, object], above: tuple[str, ...] = ()
) -> list[tuple[tuple[str, ...], object]]:
    """Numbers, texts and intervals with their paths; lists are no leaves of a table."""
    out: list[tuple[tuple[str, ...], Any]] = []
    for name, value in values.items():
        path = (*above, str(name))
        if isinstance(value, Mapping) and not is_interval(value):
            out += _leaves(value, path)
        elif value is None or isinstance(value, (Mapping, int, float, str)):
            out.append((path, value))
    return out


def _unit(path: tuple[str, ...]) -> tuple[str, float, int] | None:
    """Title, factor and digits of what is known."""
    return (f"{path[1]} [%]", 100, 0) if path[0] == "task_success" else TITLES.get(path[0])


def _title(path: tuple[str, ...]) -> str:
    title, _, _ = _unit(path) or ("", 1, 0)
    if path[0] == "task_success":
        return title
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
    known = _unit(path)
    numbers = [value[part] for part in ("mean", "low", "high")] if isinstance(value, Mapping) else [value]
    if any(number is None for number in numbers):
        return "–"
    if known is not None:
        _, scale, places = known
        mean, *ends = (scaled(number, scale, places) for number in numbers)
    else:
        # What is left of rounding, such as -3.6e-16, is 0.
        rounded = [0 if abs(number) < 1e-12 else number for number in numbers]
        mean, *ends = (
            f"{number:.{digits}g}" if isinstance(number, float) else str(number) for number in rounded
        )
    return f"{mean} ({ends[0]} – {ends[1]})" if ends else mean


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
