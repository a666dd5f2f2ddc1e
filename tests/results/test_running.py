"""Runs of docs/results.md: spread over cores and devices, collected when they finish."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.results import __main__ as command_line
from benchmarks.results import records, running
from benchmarks.results.__main__ import main
from benchmarks.results.rows import Row, Section, load_rows
from benchmarks.results.state import state
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError

ROW = Row(
    name="reach",
    section=Section(title="Two CPU cores", arguments="scale=smoke device=cpu", threads=2),
    title="One fixed goal",
    model="TD-MPC2, MPPI",
    arguments="env=reach_fixed",
    seeds=(100, 101),
)


def test_runs_on_cores_have_them_alone() -> None:
    with pytest.raises(UserError, match="cores"):
        running.Machine(jobs=len(os.sched_getaffinity(0)) + 1, threads=1).slots(ROW)
    ((before, after, environment),) = running.Machine(threads=1).slots(ROW)
    assert before[:2] == ["taskset", "-c"] and len(before[2].split(",")) == 1 and not after
    assert environment["OMP_NUM_THREADS"] == "1"


def test_runs_on_gpus_are_spread_over_them() -> None:
    row = replace(ROW, section=Section(title="One GPU", arguments="scale=gpu"))
    slots = running.Machine(jobs=2, devices=("cuda:0", "cuda:1"), commit="abc").slots(row)
    assert [after for _, after, _ in slots] == [["device=cuda:0"], ["device=cuda:1"]] * 2
    assert all(environment["FRANKA_WM_COMMIT"] == "abc" for _, _, environment in slots)
    assert all("OMP_NUM_THREADS" not in environment for _, _, environment in slots)


def test_packages_are_found_where_this_process_finds_them(monkeypatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"/some/site{os.pathsep}/another")
    ((_, _, environment),) = running.Machine(threads=1).slots(ROW)
    assert environment["PYTHONPATH"].split(os.pathsep) == [str(running.ROOT), "/some/site", "/another"]


def test_arguments_beside_the_rows_change_no_number() -> None:
    extra = ("evaluation.video_episodes=0", "logger=none")
    for row in (ROW, GPU):
        ((_, after, _),) = running.Machine(threads=1, extra=extra).slots(row)
        assert tuple(after) == extra
    for wrong in ("trainer.updates=5", "seed=3", "logger"):
        with pytest.raises(UserError, match=f"--extra {wrong}: may be logger=…, evaluation"):
            running.Machine(extra=(wrong,))
    with pytest.raises(UserError, match="--extra: reach: benchmarks have no arguments"):
        running.run(
            [(replace(ROW, script="benchmarks/env.py"), [])], running.Machine(extra=extra), out=Path()
        )


def test_a_run_that_fails_is_told_and_leaves_no_file(tmp_path) -> None:
    row = replace(ROW, arguments="env=reach_fixed trainer.updatez=1")
    failed = running.run(
        [(row, [100])], running.Machine(threads=1), out=tmp_path / "out", place=tmp_path / "place"
    )
    assert len(failed) == 1 and "trainer.updatez" in failed[0]
    assert not (tmp_path / "place").exists()


@pytest.mark.parametrize(
    "before",
    [
        "franka-wm collect",
        "python x.py out=a",
        "franka-wm collect out=a out=b",
        "franka-wm collect out=a\nls",
    ],
)
def test_what_a_row_needs_first_is_a_folder_of_each_command(before) -> None:
    with pytest.raises(UserError, match="before must be"):
        _ = replace(ROW, before=before).prepares


def gathered(dataset: Path, *commands: str) -> None:
    (dataset / PROVENANCE).parent.mkdir(parents=True, exist_ok=True)
    (dataset / PROVENANCE).write_text(json.dumps({"sessions": [{"command": one} for one in commands]}))


def test_what_a_row_needs_first_is_made_once(tmp_path, monkeypatch) -> None:
    called = []

    def made(command, **_):
        called.append(command[1:])
        return subprocess.CompletedProcess(command, 1, "", "first\nthe disk is full\n")

    monkeypatch.setattr(running.subprocess, "run", made)
    row = replace(ROW, before="franka-wm collect out=push episodes=2")
    assert "the disk is full" in (running.prepare(row, tmp_path, tmp_path) or "")
    (failed,) = running.run([(row, [100])], running.Machine(threads=1), out=tmp_path / "out")
    assert "the disk is full" in failed and not (tmp_path / "out").exists()
    assert called == [["-m", "franka_wm", "collect", "out=push", "episodes=2"]] * 2
    gathered(tmp_path / "push", "franka-wm collect out=push episodes=2")
    assert running.prepare(row, tmp_path, tmp_path) is None and len(called) == 2
    assert running.prepare(ROW, tmp_path, tmp_path) is None
    two = replace(row, before=row.before + "\nfranka-wm collect out=lift\n")
    assert "the disk is full" in (running.prepare(two, tmp_path, tmp_path) or "")
    assert called[2:] == [["-m", "franka_wm", "collect", "out=lift"]]


def test_a_dataset_of_another_command_is_not_taken(tmp_path) -> None:
    own, other = (f"franka-wm collect out=push episodes={number}" for number in (2, 3))
    row = replace(ROW, before=own)
    (tmp_path / "push").mkdir()
    said = "push was gathered otherwise (it does not say how); move it away"
    assert running.prepare(row, tmp_path, tmp_path) == said
    for commands in ([other], [own, other]):
        gathered(tmp_path / "push", *commands)
        said = f"push was gathered otherwise ({other}); move it away"
        assert running.prepare(row, tmp_path, tmp_path) == said
    (tmp_path / "push" / PROVENANCE).write_text("{")
    assert "push was gathered otherwise" in (running.prepare(row, tmp_path, tmp_path) or "")


def test_what_runs_beside_is_recorded_with_the_times(tmp_path, monkeypatch) -> None:
    """`--jobs` of them at a time, no more than there are seeds, and `--beside` others."""
    told = []

    def recorded(row: Row, folder: Path, *, jobs: int) -> dict[str, object]:
        told.append(jobs)
        return {"row": row.name, "seed": folder.name, "code": {}}

    monkeypatch.setattr(running, "_call", lambda *_: None)
    monkeypatch.setattr(running, "record_run", recorded)
    name = next(iter(load_rows()))
    for words in (["--beside", "2"], []):
        seeds = ["--seeds", "100", "--threads", "1", "--out", str(tmp_path / "out")]
        assert main(["run", name, *words, *seeds, "--results", str(tmp_path / "place")]) == 0
    assert told == [3, 1]


GPU = replace(ROW, section=Section(title="One GPU", arguments="scale=gpu"))


def test_several_rows_wait_in_one_line(tmp_path, monkeypatch) -> None:
    """A device that is free takes the next run, of whichever row; each row's files are in its own folder."""
    ran, both = [], threading.Barrier(2, timeout=20)

    def call(command, environment, log):
        both.wait()  # two at a time, one of each row: each is the last of its row
        ran.append((log.parent.parent.name, log.stem, command[-3]))

    told = []
    monkeypatch.setattr(running, "_call", call)
    monkeypatch.setattr(
        running,
        "record_run",
        lambda row, folder, *, jobs: told.append(jobs) or {"row": row.name, "seed": folder.name, "code": {}},
    )
    work = [(replace(GPU, name="a"), [1]), (replace(GPU, name="b"), [1])]
    machine = running.Machine(devices=("cuda:0", "cuda:1"))
    assert running.run(work, machine, out=tmp_path, place=tmp_path / "place") == []
    assert sorted(name for name, _, _ in ran) == ["a", "b"] and told == [1, 1]
    assert {device for _, _, device in ran} == {"device=cuda:0", "device=cuda:1"}
    with pytest.raises(UserError, match="run them apart"):
        running.run([(GPU, [1]), (ROW, [1])], machine, out=tmp_path)


def test_no_run_begins_when_the_time_is_over(tmp_path, monkeypatch) -> None:
    now = iter([0.0, 59.0, 61.0])
    monkeypatch.setattr(running.time, "monotonic", lambda: next(now))
    monkeypatch.setattr(running, "_call", lambda *_: None)
    monkeypatch.setattr(running, "record_run", lambda row, folder, **_: {"row": "x", "seed": 1, "code": {}})
    failed = running.run([(GPU, [1, 2])], running.Machine(), out=tmp_path, place=tmp_path / "p", minutes=1)
    assert failed == ["reach, seed 2: not begun, 1 minutes were over"]


def test_benchmarks_keep_to_the_time_and_one_that_fails_leaves_the_others(tmp_path, monkeypatch) -> None:
    now = iter([0.0, 30.0, 59.0, 61.0])
    monkeypatch.setattr(running.time, "monotonic", lambda: next(now))
    monkeypatch.setattr(running, "_call", lambda *_: None)
    written = []

    def recorded(row: Row, file: Path, **_: object) -> dict[str, object]:
        if row.name == "first":
            raise UserError("first: no lines")
        return {"row": row.name}

    monkeypatch.setattr(running, "record_benchmark", recorded)
    monkeypatch.setattr(running, "write", lambda record, place: written.append(record["row"]))
    work = [
        (replace(GPU, name=name, script="benchmarks/env.py"), []) for name in ("first", "second", "third")
    ]
    failed = running.run(work, running.Machine(), out=tmp_path, place=tmp_path / "p", minutes=1)
    assert failed == ["first: no lines", "third: not begun, 1 minutes were over"] and written == ["second"]


def test_only_what_is_missing_is_run(tmp_path, monkeypatch) -> None:
    records_of = [{"seed": 100}]
    monkeypatch.setattr(records, "read", lambda row, place: records_of)
    for kind, seeds in (("part", [101]), ("stale", [100, 101]), ("missing", [100, 101])):
        monkeypatch.setattr(command_line, "state", lambda row, found, kind=kind: (kind, []))
        assert command_line.to_measure(ROW, ROW.seeds, tmp_path) == seeds
    records_of.append({"seed": 101})
    monkeypatch.setattr(command_line, "state", lambda row, found: ("fresh", []))
    assert command_line.to_measure(ROW, ROW.seeds, tmp_path) == []


def test_a_row_that_was_measured_anew_in_part_is_finished(tmp_path, monkeypatch) -> None:
    """Seeds of the code before and of today's are mixed: those of today's stay."""
    old, new = ({"seed": seed, "commit": str(seed)} for seed in (100, 101))

    def judge(row, found) -> tuple[str, list[str]]:
        return ("mixed" if len(found) > 1 else "stale" if found == [old] else "part"), []

    monkeypatch.setattr(command_line, "state", judge)
    monkeypatch.setattr(records, "read", lambda row, place: [old, new])
    assert command_line.to_measure(ROW, ROW.seeds, tmp_path) == [100]
    # Each by itself is today's, but they are of other packages.
    monkeypatch.setattr(records, "read", lambda row, place: [new, {"seed": 100}])
    assert command_line.to_measure(ROW, ROW.seeds, tmp_path) == [100, 101]


def test_a_benchmark_that_is_fresh_is_not_missing(tmp_path, monkeypatch) -> None:
    ran = []
    monkeypatch.setattr(running, "_benchmark", lambda row, *_: ran.append(row.name) or [])
    for kind in ("fresh", "stale", "missing"):
        monkeypatch.setattr(command_line, "state", lambda row, found, kind=kind: (kind, []))
        places = ["--results", str(tmp_path), "--out", str(tmp_path / "out")]
        assert main(["run", "search-gpu", "--missing", *places]) == 0
        assert ran == ([] if kind == "fresh" else ["search-gpu"])
        ran.clear()


@pytest.mark.slow
def test_a_row_is_run_and_collected(tmp_path, capsys) -> None:
    words = "env=reach_fixed evaluation.episodes=2 evaluation.video_episodes=0 logger=none"
    row = replace(ROW, arguments=words, seeds=(100,))
    place = tmp_path / "place"
    assert running.run([(row, [100])], running.Machine(threads=1), out=tmp_path / "out", place=place) == []
    (record,) = records.read(row, place)
    assert state(row, [record]) == ("fresh", [])
    files = record["code"]["files"]
    assert {"train.py", "franka_wm/models/tdmpc2.py", "franka_wm/envs/robots/fr3.urdf"} <= set(files)
    assert "franka_wm/models/lewm.py" not in files  # never imported
    assert record["training"]["updates"] == 30 and record["policies"]["planner"]["episodes"] == 2


def test_commands(tmp_path, capsys) -> None:
    assert main(["list", "--results", str(tmp_path)]) == 0
    assert "reach-cpu" in capsys.readouterr().out
    assert main(["run", "no-such-row"]) == 1
    assert main(["collect", "reach-cpu", str(tmp_path), "--jobs", "1", "--results", str(tmp_path)]) == 1
    err = capsys.readouterr().err
    assert "no row 'no-such-row'; there are reach-cpu" in err and "finished" in err
