"""Changed code that still does the same: what counts as the same, and for how long it holds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from benchmarks.results import confirm, records
from benchmarks.results.rows import Row, Section
from franka_wm import source
from franka_wm.errors import UserError

SECTION = Section(title="Two CPU cores", arguments="scale=laptop device=cpu", threads=2)
ROW = Row(name="reach", section=SECTION, title="One goal", arguments="env=reach_fixed", seeds=(100,))
POLICIES = {"planner": {"return": {"mean": 1.0}}}


def make_run(folder: Path, weights: dict[str, torch.Tensor], policies: dict[str, Any] = POLICIES) -> None:
    latest = folder / "checkpoints" / "latest"
    latest.mkdir(parents=True)
    save_file(weights, latest / "model.safetensors")
    (folder / "evaluation.json").write_text(json.dumps({"policies": policies}))
    files = {"train.py": source.code_hash("train.py", source.read(["train.py"])["train.py"])}
    (folder / "finished.json").write_text(json.dumps({"source": files}))


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """A folder of results in which the row was measured at commit abc1234."""
    record = {"row": "reach", "seed": 100, "commit": "abc1234", "policies": {}}
    command = "python train.py scale=laptop device=cpu env=reach_fixed seed=100"
    records.write(record | {"command": command, "code": {"files": {"gone.py": "0"}, "config": {}}}, tmp_path)
    return tmp_path


def play(monkeypatch: pytest.MonkeyPatch, before: torch.Tensor, now: torch.Tensor) -> None:
    """Short runs end with these weights; the later one under another name."""

    def run(top: Path, words: Sequence[str], folder: Path) -> None:
        old = folder.parent.name == "before"
        make_run(folder, {"old.weight" if old else "new.weight": before if old else now})

    monkeypatch.setattr(confirm, "_run", run)
    monkeypatch.setattr(confirm, "_git", lambda *words: None)


def test_a_short_run_has_the_rows_task_and_a_smoke_runs_sizes() -> None:
    row = Row(
        name="r",
        section=SECTION,
        title="t",
        arguments="env=reach 'env.cameras=[front,side]' trainer.updates=9 evaluation.episodes=128",
    )
    words = confirm.short(row)
    assert words[:2] == ["env=reach", "env.cameras=[front,side]"] and "scale=smoke" in words
    assert not {"scale=laptop", "trainer.updates=9", "evaluation.episodes=128"} & set(words)
    shown = replace(row, arguments="env=push replay.demos=set replay.demo_updates=2000 trainer.updates=4000")
    assert "replay.demo_updates=2000" not in (words := confirm.short(shown))
    assert "replay.demo_updates=10" in words and "replay.demos=set" in words
    guided = replace(row, arguments="env=reach planner.num_policy_samples=24")
    assert "planner.num_policy_samples=4" in confirm.short(guided)


def test_equal_runs_are_written_down_and_hold(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    play(monkeypatch, torch.ones(3), torch.ones(3))
    found = records.read(ROW, measured)
    assert confirm.confirmed(ROW, found, measured) is None
    path = confirm.confirm(ROW, measured)
    same = confirm.confirmed(ROW, found, measured)
    assert same is not None and same["measured"] == "abc1234"
    records.prune(measured)  # a confirmation names code, but is no record
    assert path.exists()
    assert {one.stem for one in (measured / "code").iterdir()} == {*same["code"]}
    assert confirm.confirmed(ROW, [{**found[0], "code": {"files": {}, "config": {}}}], measured) is None
    assert confirm.confirmed(ROW, [{**found[0], "commit": "other12"}], measured) is None
    for change in ({"files": {"train.py": "another hash"}}, {"config": {}}):
        kept = json.loads(path.read_text())
        path.write_text(json.dumps(kept | change))
        assert confirm.confirmed(ROW, found, measured) is None, change
        path.write_text(json.dumps(kept))


def test_a_confirmation_of_what_was_measured_again_is_removed(measured: Path, monkeypatch) -> None:
    play(monkeypatch, torch.ones(3), torch.ones(3))
    path = confirm.confirm(ROW, measured)
    (record,) = records.read(ROW, measured)
    records.write(record | {"commit": "def5678"}, measured)
    records.prune(measured)
    assert not path.exists()


def test_one_bit_of_difference_is_refused(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    play(monkeypatch, torch.ones(3), torch.tensor([1.0, 1.0, 1.0 + 2**-23]))
    with pytest.raises(UserError, match=r"reach: weights of a short run are not those of abc1234"):
        confirm.confirm(ROW, measured)
    assert not (measured / "confirmed").exists()


def test_another_value_in_the_commands_configuration_is_refused(measured: Path) -> None:
    """A smoke run would not show it: its scale has its own."""
    (record,) = records.read(ROW, measured)
    then = {"planner": {"max_std": 2.0, "gone": 1}}
    records.write(record | {"code": {"files": {"gone.py": "0"}, "config": then}}, measured)
    with pytest.raises(UserError, match=r"planner.max_std 2.0 → 0.1; measure it again"):
        confirm.confirm(ROW, measured)


def test_other_episodes_are_another_outcome(tmp_path: Path) -> None:
    make_run(tmp_path / "a", {"w": torch.ones(2)})
    make_run(tmp_path / "b", {"w": torch.ones(2)}, {"planner": {"return": {"mean": 1.5}}})
    a, b = confirm.outcome(tmp_path / "a"), confirm.outcome(tmp_path / "b")
    assert a["weights"] == b["weights"] and a["episodes"] != b["episodes"]


def test_a_row_of_two_commits_is_not_confirmed(measured: Path) -> None:
    record = records.read(ROW, measured)[0] | {"seed": 101, "commit": "def5678"}
    records.write(record, measured)
    with pytest.raises(UserError, match=r"only a row of train\.py that one commit measured"):
        confirm.confirm(ROW, measured)


def test_what_else_was_not_committed_counts_as_far_as_it_is_code(measured: Path, monkeypatch) -> None:
    """The results of a row's first seeds make the tree of the others one with changes."""
    play(monkeypatch, torch.ones(2), torch.ones(2))
    path = measured / "reach" / "seed-100.json"
    record = json.loads(path.read_text()) | {"commit": "abc1234+"}
    path.write_text(json.dumps(record))
    file = confirm.confirm(ROW, measured)
    kept = json.loads(file.read_text())
    assert kept["measured"] == "abc1234"
    assert confirm.confirmed(ROW, records.read(ROW, measured), measured)
    del kept["code"]  # of an earlier version, which says nothing of what "+" stands for
    file.write_text(json.dumps(kept))
    assert confirm.confirmed(ROW, records.read(ROW, measured), measured) is None
    path.write_text(json.dumps(record | {"commit": "abc1234"}))
    assert confirm.confirmed(ROW, records.read(ROW, measured), measured)
    path.write_text(json.dumps(record))
    code = {"files": {"train.py": "another"}, "config": {}}
    records.write(record | {"code": code}, measured)
    with pytest.raises(UserError, match=r"measured with another train\.py than that of abc1234"):
        confirm.confirm(ROW, measured)


def test_each_code_gathers_what_the_row_reads(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in datasets/ may be of the code that the row was measured with, which says nothing of today's."""
    play(monkeypatch, torch.ones(2), torch.ones(2))
    gathered = []
    monkeypatch.setattr(
        confirm, "prepare", lambda row, top, place, **_: gathered.append((row.prepares, top, place))
    )
    row = replace(
        ROW, before="franka-wm collect out=a env=lift episodes=400\nfranka-wm collect episodes=4 out=b"
    )
    confirm.confirm(row, measured)
    (few, _, before), (_, top, now) = gathered
    assert few == [
        (["collect", "out=a", "env=lift", "episodes=16"], "a"),
        (["collect", "episodes=16", "out=b"], "b"),
    ]
    assert top == source.ROOT and len({before, now, source.ROOT}) == 3
