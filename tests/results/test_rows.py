"""What a declared row is about."""

from __future__ import annotations

from benchmarks.results import render
from benchmarks.results.rows import Row, Section, load_rows


def test_a_row_may_be_about_the_policy_alone() -> None:
    """DreamerV3 acts by its actor; a planner is evaluated beside it."""
    policies = {name: {"return": {"mean": mean}} for name, mean in (("planner", 950.0), ("policy", 100.0))}
    section = Section(title="One GPU")
    for policy, reached in (("", "950"), ("policy", "100")):
        row = Row(name="walker", section=section, title="Walker", policy=policy, wanted={"return": 900})
        verdict = "return ≥ 900 on average", reached, reached == "950"
        assert render.verdicts(row, [{"policies": policies}]) == [verdict]
    assert {
        name for name, row in load_rows().items() if "its actor" in row.model and row.policy != "policy"
    } == set()
