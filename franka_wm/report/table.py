"""The table at the end of a run, from the dict that `evaluation.json` holds."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from franka_wm.errors import UserError
from franka_wm.report.style import BLACK, centimetres, policy_colour, policy_name

if TYPE_CHECKING:
    from rich.table import Table

# {policy: {"final_distance": interval, "success": {distance: interval}, "return": interval, "episodes": n}},
# where an interval is {"mean", "low", "high"}.
type Evaluation = Mapping[str, Mapping[str, Any]]


def markdown_table(evaluation: Evaluation) -> str:
    """The evaluation as a Markdown table, one row per policy, `mean (low – high)` in every cell.

    Distances [m] are shown in centimetres, success rates in percent.

    Raises:
        UserError: a policy lacks one of the entries.
    """
    header, rows = _cells(evaluation)
    lines = ["| " + " | ".join(header) + " |", "|---|" + "---:|" * (len(header) - 1)]
    lines += ["| " + " | ".join([policy_name(policy), *cells]) + " |" for policy, cells in rows]
    return "\n".join(lines) + "\n"


def terminal_table(evaluation: Evaluation, title: str | None = None) -> "Table":
    """The same as a `rich` table, to be printed by the caller's console.

    Raises:
        UserError: a policy lacks one of the entries.
    """
    from rich.markup import escape
    from rich.table import Table

    header, rows = _cells(evaluation)
    table = Table(title=title)
    table.add_column(header[0])
    for name in header[1:]:
        table.add_column(escape(name), justify="right")  # [cm] would be taken for a style
    for policy, cells in rows:
        # Black, "doing nothing", would be invisible on most terminals.
        colour = policy_colour(policy)
        name = escape(policy_name(policy))
        table.add_row(name if colour == BLACK else f"[{colour}]{name}[/]", *cells)
    return table


def _cells(evaluation: Evaluation) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Column titles, and the cells of every policy without its name."""
    try:
        # Largest first, the order in which they get harder; policies may have different ones.
        distances = sorted(
            {d for result in evaluation.values() for d in result["success"]}, key=float, reverse=True
        )
        rows = [
            (
                policy,
                [
                    _interval(result["final_distance"], 100, 2),
                    *(
                        _interval(result["success"][d], 100, 0) if d in result["success"] else "–"
                        for d in distances
                    ),
                    _interval(result["return"], 1, 2),
                    str(result["episodes"]),
                ],
            )
            for policy, result in evaluation.items()
        ]
    except KeyError as error:
        raise UserError(
            f"the evaluation lacks {error}; every policy needs final_distance, success, return and episodes, "
            "every interval mean, low and high."
        ) from error
    successes = [f"success at {centimetres(d)} [%]" for d in distances]
    return ["policy", "final distance [cm]", *successes, "return", "episodes"], rows


def _interval(interval: Mapping[str, float], scale: float, digits: int) -> str:
    mean, low, high = (f"{scale * interval[name]:.{digits}f}" for name in ("mean", "low", "high"))
    return f"{mean} ({low} – {high})"
