"""Tables as LaTeX, JSON, HTML and numbers; Markdown and the terminal's are in test_report.py."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest

from franka_wm.errors import UserError
from franka_wm.report.table import (
    Table,
    data_frame,
    evaluation_table,
    evaluation_tables,
    html,
    json_table,
    latex,
    latex_escape,
    latex_table,
    markdown,
    nested_table,
    records,
    write_tables,
)
from tests.report.conftest import interval, policy


def test_latex_prints_what_is_meant() -> None:
    assert latex_escape(r"50 % of a_b & {c} $1 #2 \x ~ ^ – R²") == (
        r"50 \% of a\_b \& \{c\} \$1 \#2 \textbackslash{}x \textasciitilde{} \textasciicircum{} -- R$^2$"
    )
    lines = latex_table({"my_planner": policy(0.02)}, caption="100 % & more", label="tab:a").splitlines()
    assert lines[0] == r"\begin{table}" and lines[-1] == r"\end{table}"
    assert r"\caption{100 \% \& more}" in lines and r"\label{tab:a}" in lines
    assert r"\begin{tabular}{lrrrrrr}" in lines
    row = next(line for line in lines if line.startswith(r"my\_planner"))
    assert row.startswith(r"my\_planner & 2.00 (1.80 -- 2.20) & 50 (45 -- 55)") and row.endswith(r"100 \\")
    assert latex(Table(["a"], [["b"]])).startswith(r"\begin{tabular}")


def test_markdown_cells_cannot_break_the_table() -> None:
    assert markdown(Table(["a|b", "c"], [["d", "e\nf"]])).splitlines() == [
        r"| a\|b | c |",
        "|---|---:|",
        "| d | e f |",
    ]


def test_html_escapes_and_puts_intervals_below() -> None:
    text = html(Table(["policy", "x"], [["<b>", "2.0 (1.0 – 3.0)"]]), kind="texts")
    assert "&lt;b&gt;" in text and "<b>" not in text
    assert "<td>2.0<small>(1.0 – 3.0)</small></td>" in text and 'class="texts"' in text


def test_more_entries_become_columns_in_a_fixed_order() -> None:
    more = policy(0.02) | {
        "path_length": interval(0.4),
        "success_once": {"0.05": interval(0.9)},
        "note": "text",
    }
    table = evaluation_table({"planner": more, "noop": policy(0.2)})
    assert table.header == [
        "policy",
        "final distance [cm]",
        "success at 5 cm [%]",
        "success at 2.5 cm [%]",
        "success at 1 cm [%]",
        "once within 5 cm [%]",
        "path [cm]",
        "return",
        "episodes",
    ]
    assert table.rows[0][6] == "40.0 (36.0 – 44.0)" and table.rows[1][5:7] == ["–", "–"]
    outcome, motion = evaluation_tables({"planner": more, "noop": policy(0.2)})
    assert outcome.header == [h for h in table.header if not h.startswith(("once", "path"))]
    assert motion.header == ["policy", "once within 5 cm [%]", "path [cm]"]
    assert evaluation_tables({"noop": policy(0.2)})[1].rows == []


def test_other_environments_have_no_goal_to_be_away_from() -> None:
    cartpole = {"planner": {"return": interval(200.0), "length": interval(200.0), "episodes": 8}}
    assert evaluation_table(cartpole).header == ["policy", "steps", "return", "episodes"]
    with pytest.raises(UserError, match="lacks 'return'"):
        evaluation_table({"planner": {"episodes": 8}})


def test_any_dict_of_dicts_is_a_table() -> None:
    table = nested_table(
        {"tool": {"ridge": 0.98765, "knn": None, "alpha": 1}, "goal": {"ridge": True, "deep": {"x": "a"}}},
        first="quantity",
        skip=("alpha",),
    )
    assert table.header == ["quantity", "ridge", "knn", "deep / x"]
    assert table.rows == [["tool", "0.988", "–", "–"], ["goal", "yes", "–", "a"]]
    assert nested_table({"a": 1.5}).rows == [["a", "1.5"]]


def test_numbers_are_kept_plain_for_machines(tmp_path: Path) -> None:
    evaluation = {"planner": policy(0.02), "noop": policy(0.25)}
    record = records(evaluation)[0]
    assert record["policy"] == "planner" and record["final_distance"] == 0.02
    assert record["final_distance/low"] == pytest.approx(0.018) and record["success/0.05"] == 0.5
    assert json.loads(json_table({"a": {"x": math.nan, "y": 1.0}})) == [{"policy": "a", "x": None, "y": 1.0}]
    frame = data_frame(evaluation)
    assert list(frame["policy"]) == ["planner", "noop"] and frame["final_distance"].max() == 0.25

    paths = write_tables(evaluation, tmp_path / "new")
    assert [path.name for path in paths] == ["evaluation.md", "evaluation.tex", "evaluation.csv"]
    rows = list(csv.DictReader(paths[2].open()))
    assert float(rows[1]["final_distance"]) == 0.25
    assert paths[0].read_text().startswith("| policy | final distance [cm]")
    assert not list((tmp_path / "new").glob("*.writing"))
