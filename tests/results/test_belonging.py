"""Which runs a row's numbers are of: its own seeds, alike in all that counts, and what ran beside them."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.results import records, render, running, times
from benchmarks.results.__main__ import main, overview
from benchmarks.results.headlines import headlines
from benchmarks.results.rows import Row, load_rows
from benchmarks.results.state import composed, mixed, state
from franka_wm import source
from franka_wm.errors import UserError
from result_rows import CPU
from result_rows import ROW as TWO_SEEDS

ROW = replace(TWO_SEEDS, seeds=(100, 101, 102), wanted={"minutes": 1})
SPEED = Row(name="speed", section=CPU, title="Speed", script="benchmarks/x.py", readme=["batch"])
MACHINE = {
    "python": "3", "torch": "2", "newton": "1", "processor": "p", "cores": 2, "threads": 2,
    "device": "cpu", "started": "2026-01-02T03:04:05+00:00", "source": {},
}  # fmt: skip
INTERVAL = {"mean": 0.01, "low": 0.01, "high": 0.02}
POLICY = {
    "final_distance": INTERVAL,
    "success": dict.fromkeys(("0.05", "0.025", "0.01"), INTERVAL),
    "return": INTERVAL,
    "episodes": 128,
}


def record(seed: int, *typed: str, jobs: int = 1, **code: Any) -> dict[str, Any]:
    """What a run of the row left, 30 s and one for each seed above 100; ``code``: files and values of its own."""
    words = [*ROW.words, *typed]
    files = {n: source.code_hash(n, c) for n, c in source.read(["train.py"]).items()}
    config = composed(tuple(words))
    assert isinstance(config, dict)
    return {
        "row": "reach", "seed": seed, "command": shlex.join(["python", "train.py", *words, f"seed={seed}"]),
        "commit": "abc", "date": "2026-01-02",
        "machine": {"processor": "p", "cores": 2, "threads": 2, "gpu": None, "jobs": jobs},
        "versions": {"torch": "2", "newton": "1"},
        "training": {"updates": 30, "env_steps": 200, "seconds": seed - 70, "command_seconds": 40},
        "policies": {"planner": POLICY, "noop": POLICY},
        "code": {"files": files | code.get("files", {}), "config": config | code.get("config", {})},
    }  # fmt: skip


def place(folder: Path, *found: dict[str, Any]) -> Path:
    for one in found:
        records.write(one, folder)
    return folder


# -- what ran beside --------------------------------------------------------------------------------------


def test_no_run_was_alone_where_a_row_says_that_other_work_ran(tmp_path: Path) -> None:
    """Times are of all its runs then, the slowest among them."""
    row = replace(ROW, beside=True, seeds=(100, 101))
    found = [record(100), record(101, jobs=2)]
    place(tmp_path, *found)
    assert times.company(found) == " alone (1 of 2 runs)" and list(times.timed(found)) == found[:1]
    said = ", 1 – 2 at a time, beside other work"
    assert render.verdicts(row, found) == [("≤ 1 min of training", f"31 s{said}", True)]
    page, readme = render.page({"reach": row}, tmp_path), render.readme_tables({"reach": row}, tmp_path)
    assert f"training 30 (30 – 31) s{said}, the whole command" in page
    assert "p, 2 threads: 1 run at 1 a time, 1 at 2 a time, beside other work; torch" in page
    assert f"| 30 s{said} | 0.7 min |" in readme and "*beside other work*: something else ran" in readme
    assert "alone (1" not in page and "alone (1" not in readme
    assert times.company(found[:1], beside=True) == times.BESIDE_OTHERS
    assert times.grouped(found[:1], beside=True) == "p, 2 threads, beside other work"


def test_the_page_says_which_code_was_not_committed(tmp_path: Path) -> None:
    place(tmp_path, *({**record(seed), "commit": "0123456789abcdef+"} for seed in (100, 101, 102)))
    assert "commit 0123456789ab+, 2026-01-02" in render.page({"reach": ROW}, tmp_path)


def test_rows_whose_text_tells_of_other_work_declare_it() -> None:
    told = re.compile(r"beside (these|some|it)\b|[Oo]ther work ran")
    found = {
        name
        for name, row in load_rows().items()
        if told.search(" ".join(f"{row.section.text} {row.text}".split()))
    }
    assert found == {name for name, row in load_rows().items() if row.beside} and "push-demos-cpu" in found


def test_what_runs_beside_a_benchmark_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def call(command: list[str], environment: Any, log: Path) -> None:
        Path(command[-1]).write_text(json.dumps({"machine": MACHINE, "rows": [{"batch": 32}]}))

    monkeypatch.setattr(running, "_call", call)
    machine = running.Machine(threads=1, beside=2)
    assert running.run([(SPEED, [])], machine, out=tmp_path / "out", place=tmp_path / "place") == []
    (found,) = records.read(SPEED, tmp_path / "place")
    assert found["machine"]["jobs"] == 3
    assert "| p, 2 threads, 3 at a time, 2026-01-02 | 32 |" in render.readme_tables(
        {"speed": SPEED}, tmp_path / "place"
    )
    assert "p, 2 threads, 3 runs at a time; torch" in render.page({"speed": SPEED}, tmp_path / "place")
    (file,) = (tmp_path / "out").glob("speed/*/run.json")
    monkeypatch.setattr("benchmarks.results.__main__.load_rows", lambda: {"speed": SPEED})
    words = ["collect", "speed", str(file), "--jobs", "2", "--results", str(tmp_path / "other")]
    assert main(words) == 0
    assert records.read(SPEED, tmp_path / "other")[0]["machine"]["jobs"] == 2


def test_what_a_benchmark_misses_is_told_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = replace(SPEED, goals=[{"batch": 32, "speed": "≥ 1000"}, {"batch": 32, "wait": "≤ 9"}])
    lines = [{"batch": 32, "speed": 999.0, "wait": 8.0}]

    def call(command: list[str], environment: Any, log: Path) -> None:
        Path(command[-1]).write_text(json.dumps({"machine": MACHINE, "rows": lines}))

    monkeypatch.setattr(running, "_call", call)
    running.run([(row, [])], running.Machine(threads=1), out=tmp_path / "out", place=tmp_path)
    assert "Wanted and missed: batch 32: speed ≥ 1,000: 999." in render.readme_tables(
        {"speed": row}, tmp_path
    )
    assert "| batch 32: speed ≥ 1,000 | 999 | **no** |" in render.page({"speed": row}, tmp_path)
    told = overview({"speed": row}, tmp_path)
    assert "missed: batch 32: speed ≥ 1,000, is 999" in told and "wait" not in told
    without = render.readme_tables({"speed": replace(row, goals=row.goals[1:])}, tmp_path)
    assert "missed:" not in without


# -- which seeds ------------------------------------------------------------------------------------------


def test_a_seed_that_is_not_declared_enters_no_mean(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(running, "run", lambda *a, **k: pytest.fail("ran"))
    place(tmp_path, record(100), record(101), record(300))
    kind, reasons = state(ROW, records.read(ROW, tmp_path))
    assert kind == "mixed" and reasons == ["seed 300: seed 300 is none of reach's, 100 – 102"]
    assert "One fixed goal" not in render.readme_tables({"reach": ROW}, tmp_path)
    assert " 2/3 " in overview({"reach": ROW}, tmp_path)
    assert overview({"r" * 40: ROW}, tmp_path / "empty").split()[:2] == ["r" * 40, "missing"]
    name = next(iter(load_rows()))
    assert main(["run", name, "--seeds", "1", "--results", str(tmp_path)]) == 1
    assert f"--seeds: seed 1 is none of {name}'s, " in capsys.readouterr().err


def test_a_run_of_another_seed_is_not_collected(tmp_path: Path) -> None:
    for name in ("versions", "finished", "evaluation"):
        (tmp_path / f"{name}.json").write_text('{"a": 1}')
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"seed": 300}))
    with pytest.raises(UserError, match="seed 300 is none of reach's, 100 – 102"):
        records.record_run(ROW, tmp_path, jobs=1)


def test_a_seed_counts_once(tmp_path: Path) -> None:
    place(tmp_path, record(100), record(101))
    file = tmp_path / "reach" / "seed-100.json"
    file.with_name("seed-100 (copy).json").write_text(file.read_text())
    assert state(ROW, records.read(ROW, tmp_path)) == ("mixed", ["seed 100 has 2 files"])


# -- what else may differ ---------------------------------------------------------------------------------


def test_files_are_compared_among_all_runs(tmp_path: Path) -> None:
    """Also one that the first run did not read."""
    some = [record(100), record(101, files={"x.py": "1"}), record(102, files={"x.py": "2"})]
    assert state(ROW, records.read(ROW, place(tmp_path, *some))) == (
        "mixed",
        ["seed 102 differs from those before it in x.py"],
    )


def test_a_package_that_one_run_alone_had_makes_a_row_mixed() -> None:
    versions = {"versions": {"torch": "2", "newton": "1", "numpy": "2"}}
    assert mixed(ROW, [record(100) | versions, record(101)]) == [
        "seed 101 differs from those before it in numpy None"
    ]
    assert mixed(ROW, [record(100), record(101) | versions]) == [
        "seed 101 differs from those before it in numpy 2"
    ]


def test_arguments_that_change_no_number_do_not_make_a_row_mixed(tmp_path: Path) -> None:
    typed = ["logger=none", "evaluation.video_episodes=0", "trainer.checkpoint_replay=false"]
    some = [record(100), record(101, *typed), record(102, *typed[1:2])]
    assert some[0]["code"]["config"]["evaluation"] != some[1]["code"]["config"]["evaluation"]
    assert state(ROW, records.read(ROW, place(tmp_path, *some))) == ("fresh", [])


@pytest.mark.parametrize(("second", "apart"), [(101, False), (5, True)])
def test_a_datasets_seed_that_follows_the_runs_does_not_make_a_row_mixed(second: int, apart: bool) -> None:
    config = composed(tuple(ROW.words))
    assert isinstance(config, dict)
    some = [
        record(seed, config={"dataset": config["dataset"] | {"seed": own}})
        for seed, own in ((100, 100), (101, second))
    ]
    assert bool(mixed(ROW, some)) == apart


def test_changed_values_are_no_files_and_stand_unfolded(tmp_path: Path) -> None:
    old = {"files": {"gone.py": "1"}, "config": {"scale": "other", "old": 1}}
    text = render.page({"reach": ROW}, place(tmp_path, *(record(seed, **old) for seed in ROW.seeds)))
    assert "**Measured before changes of one file and 2 values of its configuration.**" in text
    assert " Of the configuration: `old 1 → –`, `scale other → smoke`. `gone.py`" in text
    assert "`gone.py`." in text
    assert render.changed_told(["a 1 → 2"]) == "one value of its configuration"
    assert render._since(["a 1 → 2"], None, "abc").endswith(" Of the configuration: `a 1 → 2`.")


# -- what README says of returns ---------------------------------------------------------------------------

PLAIN = {"mean": 0.0, "low": 0.0, "high": 0.0}


@pytest.mark.parametrize(
    ("reached", "said"),
    [(500.0, "| 500 (500 – 500) | 475 | – |"), (400.0, "| 475 | return ≥ 475 on average: 400 |")],
)
def test_a_return_below_what_was_wanted_is_marked(tmp_path: Path, reached: float, said: str) -> None:
    row = replace(ROW, seeds=(100, 101), wanted={"return": 475})
    for seed in row.seeds:
        found = record(seed)
        of = {"mean": reached, "low": reached, "high": reached}
        found["policies"] = {
            "planner": {"return": of, "episodes": 10},
            "noop": {"return": PLAIN, "episodes": 10},
        }
        records.write(found, tmp_path)
    readme = render.readme_tables({"reach": row}, tmp_path)
    assert said in readme


def test_readme_tells_what_the_row_of_other_seeds_misses(tmp_path: Path) -> None:
    """One of two rows is shown there: it must not be the one that was lucky. And which seeds had a part in choices."""
    row = replace(ROW, seeds=(100, 101), wanted={"return": 475}, chosen=True)
    others = replace(row, name="reach-others", seeds=(900, 901), readme=False, chosen=False)
    for made, reached in ((row, 500.0), (others, 400.0)):
        for seed in made.seeds:
            of = {"mean": reached, "low": reached, "high": reached}
            records.write(
                record(seed) | {"row": made.name, "policies": {"planner": {"return": of, "episodes": 9}}},
                tmp_path,
            )
    alone = render.readme_tables({"reach": row}, tmp_path)
    assert (
        "| 500 (500 – 500) | 475 | – |" in alone
        and "One fixed goal² |" in alone
        and "² A setting was" in alone
    )
    both = render.readme_tables({"reach": row, others.name: others}, tmp_path)
    assert "| 475 | other seeds: return ≥ 475 on average: 400 |" in both
    without = render.readme_tables({"reach": replace(row, chosen=False)}, tmp_path)
    assert "²" not in without


def test_readme_marks_what_was_not_confirmed_and_says_so_of_the_rest(tmp_path: Path, monkeypatch) -> None:
    old = {"files": {"gone.py": "1"}}
    row = replace(ROW, seeds=(100, 101), wanted={"minutes": 0.4}, beside=True)
    place(tmp_path, *(record(seed, **old) for seed in row.seeds))
    alone = render.readme_tables({"reach": row}, tmp_path)
    assert "One fixed goal¹ |" in alone and "¹ Measured before" in alone and render.ALIKE not in alone
    assert "| ≤ 0.4 min of training: 31 s |" in alone  # not what ran beside it
    assert "Gathering demonstrations is not counted." in alone
    same = {"date": "2026-01-03", "command": "python train.py"}
    monkeypatch.setattr(render, "confirmed", lambda *_: same)
    confirmed = render.readme_tables({"reach": row}, tmp_path)
    assert "One fixed goal |" in confirmed and "¹ Measured" not in confirmed and render.ALIKE in confirmed


def test_speeds_of_the_same_columns_are_one_table(tmp_path: Path) -> None:
    rows = {name: replace(SPEED, name=name) for name in ("one", "two")}
    for name, row in rows.items():
        file = tmp_path / "out.json"
        file.write_text(json.dumps({"machine": MACHINE, "rows": [{"batch": name}]}))
        records.write(records.record_benchmark(row, file, commit="abc"), tmp_path)
    readme = render.readme_tables(rows, tmp_path)
    assert readme.count("| machine | batch |") == 1
    assert "2026-01-02 | one |\n| p, 2 threads, 2026-01-02 | two |" in readme


def test_readme_begins_with_the_worst_seed_of_rows_that_are_whole(tmp_path: Path, monkeypatch) -> None:
    row = replace(ROW, seeds=(100, 101), headline=True)
    lucky, poor = record(100), record(101)
    rate = {"mean": 0.0, "low": 0.0, "high": 0.1}
    poor["policies"] = poor["policies"] | {
        "planner": POLICY | {"success": dict.fromkeys(("0.05", "0.025", "0.01"), rate)}
    }
    place(tmp_path, lucky)
    assert headlines({"reach": row}, tmp_path) == ""  # one seed is missing
    place(tmp_path, poor)
    assert "| One fixed goal | Two CPU cores | 30 s | 0 % within 5 cm, 2 seeds |" in headlines(
        {"reach": row}, tmp_path
    )
    assert "One fixed goal² |" in headlines({"reach": replace(row, chosen=True)}, tmp_path)
    assert headlines({"reach": replace(row, headline=False)}, tmp_path) == ""
    place(tmp_path, *(one | {"code": {**one["code"], "files": {"gone.py": "1"}}} for one in (lucky, poor)))
    aged = headlines({"reach": row}, tmp_path)
    assert "One fixed goal¹ |" in aged and "¹ Measured before changes" in aged and "²" not in aged
    monkeypatch.setattr("benchmarks.results.headlines.confirmed", lambda *_: {"date": "2026-01-03"})
    assert "One fixed goal |" in headlines({"reach": row}, tmp_path)
