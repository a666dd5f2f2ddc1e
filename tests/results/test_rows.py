"""What a declared row is about."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.results.metrics import SUCCESS, goals_met, percent, verdicts
from benchmarks.results.rows import Row, Section, load_rows
from franka_wm import conf
from franka_wm.errors import UserError


@pytest.mark.parametrize(
    ("ours", "alone", "said"),
    [
        (
            {"success": 0.9, "return": 5.0},
            {"success": 0.8, "return": 6.0},
            "1 of 1 seeds; its return is no lower on 0",
        ),
        (
            {"success": 0.8, "return": 7.0},
            {"success": 0.9, "return": 6.0},
            "0 of 1 seeds; worse on 3 (80, policy 90 %); its return is no lower on 1",
        ),
        (
            {"success": 0.86, "return": 7.0},
            {"success": 0.9, "return": 6.0},
            "1 of 1 seeds; worse, but within the policy's interval, on 3 (86, policy 90 %); its return is no lower "
            "on 1",
        ),
        ({"return": 7.0}, {"return": 6.0}, "1 of 1 seeds"),
        ({"return": 610.0}, {"return": 975.0}, "0 of 1 seeds; worse on 3 (610, policy 975)"),
    ],
)
def test_planning_that_does_harm_is_told_by_success_or_return(ours, alone, said) -> None:
    """Without a distance; of every row that evaluated both, and was to be about the planner."""
    policies = {
        name: {key: {"mean": v, "low": 0.95 * v, "high": 1.05 * v} for key, v in found.items()}
        for name, found in (("planner", ours), ("policy", alone))
    }
    row = Row(name="walker", section=Section(title="One GPU"), title="Walker", wanted={})
    records = [{"seed": 3, "policies": policies}]
    ((_, reached, enough),) = verdicts(row, records)
    assert reached == said and enough is said.startswith("1")
    assert verdicts(replace(row, policy="policy"), records) == []
    assert verdicts(replace(row, script="benchmarks/env.py"), [{"rows": [{"worlds": 8}]}]) == []


def test_a_row_may_be_about_the_policy_alone() -> None:
    """DreamerV3 acts by its actor; a planner is evaluated beside it."""
    policies = {
        name: {"return": {"mean": mean, "low": mean, "high": mean}}
        for name, mean in (("planner", 950.0), ("policy", 100.0))
    }
    section = Section(title="One GPU")
    for policy, reached in (("", "950"), ("policy", "100")):
        row = Row(name="walker", section=section, title="Walker", policy=policy, wanted={"return": 900})
        verdict = "return ≥ 900 on average", reached, reached == "950"
        assert verdicts(row, [{"seed": 0, "policies": policies}])[0] == verdict
    assert {
        name for name, row in load_rows().items() if "its actor" in row.model and row.policy != "policy"
    } == set()


LINES = [
    {"case": "lift", "worlds": 16, "speed": 2800.0, "start [s]": 3.0},
    {"case": "lift", "worlds": 64, "speed": 900.0, "start [s]": 5.5},
    {"case": "push", "worlds": 16, "speed": None, "start [s]": 1.0},
]


@pytest.mark.parametrize(
    ("goal", "told"),
    [
        (
            {"case": "lift", "worlds": 16, "speed": "≥ 2700"},
            ("case lift, worlds 16: speed ≥ 2,700", "2,800", True),
        ),
        ({"case": "lift", "speed": "≥ 900.5"}, ("case lift: speed ≥ 900", "900", False)),
        ({"start [s]": "≤ 5.5"}, ("start [s] ≤ 5.5", "5.5", True)),
        ({"case": "lift", "start [s]": "≤ 5"}, ("case lift: start [s] ≤ 5", "5.5", False)),
    ],
)
def test_a_benchmark_is_judged_by_its_worst_line(goal, told) -> None:
    row = Row(name="env", section=Section(title="A GPU"), title="", script="x.py", goals=[goal])
    assert goals_met(row, LINES) == [told]


@pytest.mark.parametrize(
    "goal", [{"case": "none", "speed": "≥ 1"}, {"case": "push", "speed": "≥ 1"}, {"x": "≤ 1"}]
)
def test_a_goal_of_no_line_or_number_is_refused(goal) -> None:
    row = Row(name="env", section=Section(title="A GPU"), title="", script="x.py", goals=[goal])
    with pytest.raises(UserError, match="row env: no line has"):
        goals_met(row, LINES)


def test_of_several_tasks_each_is_judged_by_its_worst_seed() -> None:
    row = replace(load_rows()["multitask-gpu"], wanted={"success_of": {"push": 90, "peg": 84}})
    records = [
        {"seed": k, "policies": {"planner": {"task_success": {"push": {"mean": 0.9}, "peg": {"mean": rate}}}}}
        for k, rate in enumerate((0.95, 0.83))
    ]
    assert verdicts(row, records) == [
        ("worst seed ≥ 90 % of push", "90.0 %", True),
        ("worst seed ≥ 84 % of peg", "83.0 %", False),
    ]


TRAINED = {
    name: row
    for name, row in load_rows().items()
    if not row.script and "model.observations" in str(row.words)
}


@pytest.mark.parametrize("name", TRAINED)
def test_a_rows_model_reads_images_that_its_arm_has(name) -> None:
    cfg = conf.compose(*TRAINED[name].words)
    images = [key for key in cfg.model.observations if key.startswith("pixels")]
    there = ["pixels", *(f"pixels_{camera}" for camera in cfg.env.cameras[1:])]
    assert images and set(images) <= set(there), (images, there)


def test_a_list_that_nobody_reads_to_its_end_ends_quietly(root: Path, tmp_path: Path) -> None:
    """`python -m benchmarks.results | head`."""
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as stream:
        command = [sys.executable, "-m", "benchmarks.results", "list", f"--results={tmp_path}"]
        done = subprocess.run(command, cwd=root, stdout=stream, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1 and done.stderr == ""


@pytest.mark.parametrize(
    ("rate", "shown"),
    [
        (0, "0"),
        (0.02, "0.1"),
        (0.5, "0.5"),
        (50, "50"),
        (99.4, "99"),
        (99.61, "99.6"),
        (99.99, "99.9"),
        (100, "100"),
    ],
)
def test_a_rate_that_is_not_all_or_none_does_not_look_so(rate: float, shown: str) -> None:
    assert percent(rate) == shown and SUCCESS.show(rate, rate).startswith(f"{shown} ({shown}")
