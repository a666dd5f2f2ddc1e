"""Tables as HTML and numbers; Markdown is in test_report.py."""

from __future__ import annotations

import json

import pytest

from franka_wm.report.document import table
from franka_wm.report.table import (
    Table,
    data_frame,
    evaluation_tables,
    markdown,
    nested_table,
)
from tests.report.conftest import interval, policy


def test_markdown_cells_cannot_break_the_table() -> None:
    assert markdown(Table(["a|b", "c"], [["d", "e\nf"]])).splitlines() == [
        r"| a\|b | c |",
        "|---|---:|",
        "| d | e f |",
    ]


def test_html_escapes_and_puts_intervals_below() -> None:
    text = table(Table(["policy", "x"], [["<b>", "2.0 (1.0 – 3.0)"]]), kind="texts")
    assert "&lt;b&gt;" in text and "<b>" not in text
    assert "<td>2.0<small>(1.0 – 3.0)</small></td>" in text and 'class="texts"' in text


def test_more_entries_become_columns_in_a_fixed_order() -> None:
    more = policy(0.02) | {
        "path_length": interval(0.4),
        "success_once": {"0.05": interval(0.9)},
        "note": "text",
    }
    outcome, motion = evaluation_tables({"planner": more, "noop": policy(0.2)})
    assert outcome.header == [
        "policy",
        "final distance [cm]",
        "success at 5 cm [%]",
        "success at 2.5 cm [%]",
        "success at 1 cm [%]",
        "return",
        "episodes",
    ]
    assert motion.header == ["policy", "once within 5 cm [%]", "path [cm]"]
    assert motion.rows[0][2] == "40.0 (36.0 – 44.0)" and motion.rows[1][1:] == ["–", "–"]
    assert evaluation_tables({"noop": policy(0.2)})[1].rows == []


def test_other_environments_have_no_goal_to_be_away_from() -> None:
    cartpole = {"planner": {"return": interval(200.0), "length": interval(200.0), "episodes": 8}}
    outcome, motion = evaluation_tables(cartpole)
    assert outcome.header == ["policy", "return", "episodes"] and motion.header == ["policy", "steps"]


def test_any_dict_of_dicts_is_a_table() -> None:
    table = nested_table(
        {"tool": {"ridge": 0.98765, "knn": None, "alpha": 1}, "goal": {"ridge": True, "deep": {"x": "a"}}},
        first="quantity",
        skip=("alpha",),
    )
    assert table.header == ["quantity", "ridge", "knn", "deep / x"]
    assert table.rows == [["tool", "0.988", "–", "–"], ["goal", "yes", "–", "a"]]
    assert nested_table({"a": 1.5}).rows == [["a", "1.5"]]


def test_numbers_are_kept_plain_for_machines() -> None:
    frame = data_frame({"planner": policy(0.02), "noop": policy(0.25)})
    first = frame.iloc[0]
    assert first["policy"] == "planner" and first["final_distance"] == 0.02
    assert first["final_distance/low"] == pytest.approx(0.018) and first["success/0.05"] == 0.5
    assert list(frame["policy"]) == ["planner", "noop"] and frame["final_distance"].max() == 0.25
    assert r"\begin{tabular}" in frame.to_latex() and json.loads(frame.to_json(orient="records"))
