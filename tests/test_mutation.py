"""The mutation run itself: what it changes, what it leaves, and its page."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

from franka_wm.errors import UserError
from scripts import mutation
from scripts.mutation import Changed, Mutant, Target, load_targets, mutants, not_executed, page, ranges

SEEDING = "franka_wm/seeding.py"


def test_every_target_is_there() -> None:
    """Files, functions and tests that mutation.yaml names; rename them there, too."""
    assert {SEEDING, "franka_wm/data/replay.py"} <= {target.path for target in load_targets()}


def test_names_that_are_not_there_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mutation.yaml"
    file.write_text(f"targets: {{{SEEDING}: {{tests: [tests/test_gone.py]}}}}")
    with pytest.raises(UserError, match=r"no tests/test_gone\.py"):
        load_targets(file)
    with pytest.raises(UserError, match="has no derive_tree"):
        ranges(Target(SEEDING, [], only=["derive_tree"]))


def test_annotations_and_messages_are_left_alone() -> None:
    code = (
        "def f(a: int | None) -> int | None:\n    b: int | None = a | 1\n    raise ValueError(f'{a - 1}')\n"
    )
    silent = list(not_executed(code))
    for begin in ((1, 9), (1, 26), (2, 7), (3, 10)):
        assert any(first <= begin < last for first, last in silent)
    assert not any(first <= (2, 22) < last for first, last in silent)  # a | 1 is code


def test_a_changed_module_is_imported_instead_of_its_file(tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "sums_of_two.py"
    file.write_text("def add(a, b):\n    return a + b\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(
        sys, "meta_path", [Changed("sums_of_two", file, file.read_text().replace("+", "-")), *sys.meta_path]
    )
    assert importlib.import_module("sums_of_two").add(3, 2) == 1
    del sys.modules["sums_of_two"]
    assert file.read_text().count("+") == 1 and not list(tmp_path.rglob("*.pyc"))


def test_mutants_are_one_mistake_each() -> None:
    pytest.importorskip("cosmic_ray")
    found = mutants(Target(SEEDING, []))
    changes = [one.change() for one in found]
    assert len(set(changes)) == len(found) > 3
    assert any("[:4]" in change and "[: 5]" in change for change in changes)
    assert all(isinstance(one, Mutant) and one.code() != one.target.code for one in found)


def test_the_page_counts_and_explains() -> None:
    target = Target(SEEDING, [], explained={"a → b": "b is a"})
    older = Target("franka_wm/console.py", [])
    survivors = [
        {"line": 1, "operator": "AddNot", "change": "a → b"},
        {"line": 2, "operator": "AddNot", "change": "c → d"},
    ]
    measured = {
        "mutants": 20, "tested": 10, "killed": 7, "timeout": 1, "survived": 2,
        "survivors": survivors, "hash": target.hash, "commit": "abc", "date": "2026-01-02",
    }  # fmt: skip
    results = {SEEDING: measured, older.path: {**measured, "survivors": [], "hash": "another"}}
    text = page([target, Target("franka_wm/errors.py", []), older], results)
    assert (
        "**20 of 40 mistakes were tried**, a sample; 1 of 2 files have changed since theirs were.\n\n|"
        in text
    )
    whole = {SEEDING: {**measured, "mutants": 10}}
    assert "**10 of 10 mistakes were tried**.\n" in page([target], whole)
    assert "| together, 1 of 3 files not run | 20 of 40 | 14 | 2 | 4 | 80 % | 84 % |  |" in text
    assert (
        "| `franka_wm/console.py` | 10 of 20 | 7 | 1 | 2 | 80 % | 80 % | abc, 2026-01-02, changed since |"
        in text
    )
    assert f"| `{SEEDING}` | 10 of 20 | 7 | 1 | 2 | 80 % | 88 % | abc, 2026-01-02 |" in text
    assert "| `franka_wm/errors.py` | | | | | | | not run yet |" in text
    assert "`a` → `b`: b is a" in text and "`c` → `d`: **no test notices it**" in text


def test_the_committed_page_is_what_was_measured() -> None:
    results = json.loads(mutation.RESULTS.read_text()) if mutation.RESULTS.is_file() else {}
    assert mutation.PAGE.read_text() == page(load_targets(), results), "run scripts/mutation.py --page"
