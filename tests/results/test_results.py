"""Rows of docs/results.md: from a run's folder to its file, from files to the page."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.results import records, render
from benchmarks.results.__main__ import overview, with_results
from benchmarks.results.rows import Row, Section, load_rows
from benchmarks.results.state import composed, state
from franka_wm import source
from franka_wm.errors import UserError
from franka_wm.evaluation.results import COMMAND, END
from result_rows import ROW

TYPED = ["scale=smoke", "device=cpu", "env=reach_fixed"]


def interval(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": mean / 2, "high": min(1.0, 2 * mean)}


def policy(distance: float, within: float) -> dict[str, Any]:
    success = {d: interval(within) for d in ("0.05", "0.025", "0.01")}
    return {
        "final_distance": interval(distance),
        "success": success,
        "return": interval(0.5),
        "episodes": 128,
    }


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """A finished run's folder: ``make_run(seed, distance, within, typed=…, versions=…, files=…, config=…)``."""

    def make(
        seed: int,
        distance: float = 0.01,
        within: float = 1.0,
        *,
        typed: list[str] = TYPED,
        versions: dict[str, Any] | None = None,
        files: dict[str, str] | None = None,
        config: dict[str, Any] | None = None,
        protocol: dict[str, Any] | None = None,
    ) -> Path:
        run = tmp_path / "runs" / str(seed)
        (run / ".hydra").mkdir(parents=True)
        (run / "checkpoints" / "latest").mkdir(parents=True)
        (run / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([*typed, f"seed={seed}"]))
        now = composed((*TYPED, f"seed={seed}"))
        assert isinstance(now, dict)
        (run / "config.yaml").write_text(
            yaml.safe_dump(now | {"seed": seed, "device": "cpu"} | (config or {}))
        )
        policies = {"planner": policy(distance, within), "noop": policy(0.25, 0.0)}
        found = {"protocol": {"by": END, **(protocol or {})}, "policies": policies}
        (run / "evaluation.json").write_text(json.dumps(found))
        counters = {"env_steps": 200, "updates": 30, "seconds": 30.0 + seed - 100}
        (run / "checkpoints" / "latest" / "counters.json").write_text(json.dumps(counters))
        made = {
            "python": "3.12.1", "torch": "2.11.0", "newton": "1.8.0", "processor": "a processor", "cores": 2,
            "threads": 2, "device": "cpu", "commit": "0123456789abcdef", "started": "2026-01-02T03:04:05+00:00",
        }  # fmt: skip
        (run / "versions.json").write_text(json.dumps(made | (versions or {})))
        now_there = {n: source.code_hash(n, c) for n, c in source.read(["train.py"]).items()}
        finished = {"seconds": 40, "source": now_there if files is None else files}
        (run / "finished.json").write_text(json.dumps(finished))
        return run

    return make


@pytest.fixture
def measured(make_run: Callable[..., Path], tmp_path: Path) -> Callable[..., Path]:
    """The results folder of runs, given as for ``make_run``."""

    def make(*runs: dict[str, Any]) -> Path:
        place = tmp_path / "results"
        for one in runs:
            records.write(records.record_run(ROW, make_run(**one), jobs=1), place)
        return place

    return make


def test_a_record_holds_what_the_run_wrote(make_run) -> None:
    run = make_run(100, 0.01, protocol={"episodes": 128})
    record = records.record_run(ROW, run, jobs=3)
    assert record["policies"] == json.loads((run / "evaluation.json").read_text())["policies"]
    assert record["protocol"] == {"by": END, "episodes": 128}
    assert record["command"] == "python train.py scale=smoke device=cpu env=reach_fixed seed=100"
    assert (record["seed"], record["commit"], record["date"]) == (100, "0123456789abcdef", "2026-01-02")
    machine = {"processor": "a processor", "cores": 2, "threads": 2, "gpu": None, "jobs": 3}
    assert record["machine"] == machine
    assert record["training"] == {"env_steps": 200, "updates": 30, "seconds": 30.0, "command_seconds": 40}


def test_a_run_whose_evaluation_is_of_an_older_form_is_refused(make_run) -> None:
    run = make_run(100, 0.01)
    (run / "evaluation.json").write_text(json.dumps({"planner": policy(0.01, 1.0)}))
    with pytest.raises(UserError, match="older form"):
        records.record_run(ROW, run, jobs=1)


def test_both_stages_count(make_run, tmp_path) -> None:
    run = make_run(100)
    first = run / "pretrained" / "checkpoints" / "latest"
    first.mkdir(parents=True)
    (first / "counters.json").write_text(json.dumps({"updates": 10, "seconds": 60.0}))
    assert render.seconds(records.record_run(ROW, run, jobs=1)) == 90


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"typed": [*TYPED, "trainer.lr=1"]}, "not a run of reach, started with trainer.lr=1"),
        ({"typed": TYPED[:2]}, "started without env=reach_fixed"),
        ({"config": {"resume": "outputs/before"}}, "resumed"),
        (
            {"versions": {"device": "NVIDIA H200"}},
            "on NVIDIA H200, and reach is measured with at most 2 threads",
        ),
        ({"versions": {"threads": 4}}, "with 4 threads"),
        ({"protocol": {"by": COMMAND}}, "is by franka-wm evaluate; results need"),
    ],
)
def test_another_run_is_refused(make_run, given, says) -> None:
    with pytest.raises(UserError, match=says):
        records.record_run(ROW, make_run(100, **given), jobs=1)


def test_a_run_that_did_not_finish_is_refused(make_run) -> None:
    run = make_run(100)
    (run / "finished.json").unlink()
    with pytest.raises(UserError, match="finished"):
        records.record_run(ROW, run, jobs=1)


def test_arguments_that_change_no_number_may_differ(make_run) -> None:
    typed = [*TYPED, "logger=none", "evaluation.video_episodes=0"]
    assert "logger=none" in records.record_run(ROW, make_run(100, typed=typed), jobs=1)["command"]


# -- the page -----------------------------------------------------------------------------------------------


def test_the_page_tells_mean_worst_and_what_was_wanted(measured) -> None:
    place = measured(
        {"seed": 100, "distance": 0.01, "within": 1.0}, {"seed": 101, "distance": 0.03, "within": 0.8}
    )
    assert state(ROW, records.read(ROW, place)) == ("fresh", [])
    text = render.page({"reach": ROW}, place)
    assert (
        "for seed in 100 101; do\n  python train.py scale=smoke device=cpu env=reach_fixed seed=$seed" in text
    )
    assert "| planner | 2.00 (1.00 – 3.00) | 90 (80 – 100) |" in text
    assert "| ≤ 1 min of training | 31 s | yes |" in text
    assert "| ≤ 1.5 cm on average | 2.00 cm | **no** |" in text
    assert "| worst seed ≥ 90 % within 5 cm | 80.0 % | **no** |" in text
    assert "| 101 | 3.00 (1.50 – 6.00) | 80 (40 – 100) |" in text
    assert "a processor, 2 threads; torch 2.11.0" in text and "commit 0123456789ab, 2026-01-02" in text
    readme = render.readme_tables({"reach": ROW}, place)
    line = (
        "| One fixed goal | TD-MPC2, MPPI | Two CPU cores, 2 seeds | 30 s | 0.7 min | 2.0 cm | 80 % | 25 cm |"
    )
    assert line in readme
    assert "| training | whole command |" in readme and readme.index(line) < readme.index(render.LEGEND)
    assert "and the evaluation of each policy on 128 episodes, without a film." in readme
    assert "missed: ≤ 1.5 cm" in overview({"reach": ROW}, place)


def test_success_where_a_task_says_what_it_is(measured) -> None:
    place = measured({"seed": 100}, {"seed": 101})
    found = records.read(ROW, place)
    for record, rate in zip(found, (0.9, 0.7), strict=True):
        for name, mean in (("planner", rate), ("expert", 1.0)):
            bounds = {"mean": mean, "low": mean - 0.1, "high": mean}
            record["policies"][name] = {"success": bounds, "return": bounds, "episodes": 128}
        del record["policies"]["noop"]
        records.write(record, place)
    row = replace(ROW, wanted={"success": 80}, before="franka-wm collect out=datasets/push episodes=2")
    text = render.page({"reach": row}, place)
    assert "franka-wm collect out=datasets/push episodes=2\nfor seed in 100 101; do" in text
    script = replace(row, script="benchmarks/of.py", arguments="datasets/push", seeds=())
    assert render._command(script, []).split("\n")[0] == row.before
    assert "| worst seed ≥ 80 % | 70.0 % | **no** |" in text
    assert "| planner | 80 (70 – 90) | 1 (1 – 1) |" in text
    readme = render.readme_tables({"reach": row}, place)
    assert "| 30 s | 0.7 min | 80 | 70 | 100 |" in readme and "final distance" not in readme


def test_single_seeds_stand_below_and_not_in_the_readme(measured) -> None:
    place = measured({"seed": 100})
    text = render.page({"reach": ROW}, place)
    assert "## Two CPU cores" not in text
    assert text.index("## Single seeds") < text.index("### One fixed goal")
    assert "| planner | 1.00 (0.50 – 2.00) |" in text  # the interval over its episodes
    assert "**Missing: seed 101** of the 2 that" in text
    assert "| ≤ 1 min of training | 30 s | so far |" in text
    assert "One fixed goal" not in render.readme_tables({"reach": ROW}, place)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"files": {"train.py": "000000000000"}}, "seed 101 differs from those before it in train.py"),
        ({"versions": {"torch": "2.11.1"}}, "in torch 2.11.1"),
        ({"config": {"scale": "other"}}, "in scale smoke → other"),
    ],
)
def test_a_row_of_mixed_versions_is_refused(measured, given, says) -> None:
    place = measured({"seed": 100}, {"seed": 101, **given})
    kind, reasons = state(ROW, records.read(ROW, place))
    assert kind == "mixed" and says in reasons[0]
    text = render.page({"reach": ROW}, place)
    assert says in text and "| planner |" not in text
    assert "One fixed goal" not in render.readme_tables({"reach": ROW}, place)


def test_a_row_measured_with_another_command_is_refused(measured) -> None:
    place = measured({"seed": 100}, {"seed": 101})
    row = replace(ROW, arguments="env=reach_fixed trainer.lr=0.1")
    assert state(row, records.read(row, place))[0] == "mixed"


def test_times_are_those_of_runs_that_were_alone(make_run, tmp_path) -> None:
    """Seed 100 shared the machine, seed 101 did not; the verdict, the page and README say so."""
    shared = records.record_run(ROW, make_run(100), jobs=3)
    alone = records.record_run(ROW, make_run(101), jobs=1)
    said = "31 s alone (1 of 2 runs)"
    assert render.verdicts(ROW, [shared, alone])[0] == ("≤ 1 min of training", said, True)
    for record in (shared, alone):
        records.write(record, tmp_path / "one")
    text = render.page({"reach": ROW}, tmp_path / "one")
    assert f"training {said}, the whole command 40 s." in text
    assert "a processor, 2 threads: 1 run alone, 1 at 3 a time; torch" in text
    assert f"2 seeds | {said} | 0.7 min |" in render.readme_tables({"reach": ROW}, tmp_path / "one")


def test_with_no_run_alone_times_say_how_many_ran_at_a_time(make_run, tmp_path) -> None:
    few, many = (records.record_run(ROW, make_run(100 + k), jobs=jobs) for k, jobs in enumerate((3, 4)))
    assert render.verdicts(ROW, [few])[0][1] == "30 s, 3 at a time"
    assert render.company([few, many]) == ", 3 – 4 at a time"
    for record in (few, many):
        record["machine"]["jobs"] = 3
        records.write(record, tmp_path)
    page = render.page({"reach": ROW}, tmp_path)
    assert "training 30 (30 – 31) s, 3 at a time," in page and "2 threads, 3 runs at a time; torch" in page
    assert "2 seeds | 30 s, 3 at a time | 0.7 min |" in render.readme_tables({"reach": ROW}, tmp_path)


def test_fewer_threads_than_the_row_allows_are_told(measured) -> None:
    one = {"versions": {"threads": 1, "cores": 1}}
    place = measured({"seed": 100, **one}, {"seed": 101, **one})
    assert "a processor, 1 thread (up to 2 threads are allowed); torch" in render.page({"reach": ROW}, place)
    assert "2 of 3 seeds |" in render.readme_tables({"reach": replace(ROW, seeds=(100, 101, 9))}, place)


def test_machines_stand_once_with_their_runs(make_run) -> None:
    made = records.record_run(ROW, make_run(100), jobs=1)
    some = [made | {"machine": made["machine"] | {"gpu": gpu, "jobs": jobs}} for gpu, jobs in
            (("A", 1), ("A", 3), ("A", 3), ("B", 2))]  # fmt: skip
    assert render.grouped(some[:3]) == "A: 1 run alone, 2 at 3 a time"
    assert render.grouped(some) == "A: 1 run alone, 2 at 3 a time; B: 1 run at 2 a time"
    assert render.grouped(some[:1]) == "A"


def test_arguments_beside_those_of_the_row_are_told(measured) -> None:
    typed = [*TYPED, "logger=none", "evaluation.video_episodes=0"]
    place = measured({"seed": 100, "typed": typed}, {"seed": 101, "typed": typed})
    assert " Run with `logger=none evaluation.video_episodes=0`.\n" in render.page({"reach": ROW}, place)
    row = replace(ROW, arguments="env=reach_fixed logger=none trainer.checkpoint_replay=false")
    said = "Run with `evaluation.video_episodes=0` and without `trainer.checkpoint_replay=false`."
    assert said in render.page({"reach": row}, place)


def test_the_planner_is_held_against_its_policy_on_each_seed(make_run) -> None:
    row = replace(ROW, wanted={})
    found = [records.record_run(ROW, make_run(100 + k, d), jobs=1) for k, d in enumerate((0.01, 0.05))]
    for record, alone in zip(found, (0.09, 0.02), strict=True):
        record["policies"]["policy"] = policy(alone, 1.0)
    found[1]["policies"]["policy"]["return"] = interval(0.4)
    ((wanted, reached, enough),) = render.verdicts(row, found)
    assert wanted == "planner no worse than policy, each seed"
    assert (
        reached == "1 of 2 seeds; worse on 101 (5.00, policy 2.00 cm); its return is no lower on 2"
        and not enough
    )
    found[0]["policies"]["policy"]["return"] = interval(0.6)
    assert render.verdicts(row, found[:1]) == [(wanted, "1 of 1 seeds; its return is no lower on 0", True)]


@pytest.mark.parametrize(
    ("planner", "label"), [("mppi", "inverse kinematics"), ("mcts", "search with the same actions")]
)
def test_the_oracle_of_discrete_moves_is_a_search(measured, planner, label) -> None:
    given = {"config": {"planner": {"name": planner}}}
    place = measured({"seed": 100, **given}, {"seed": 101, **given})
    for file in (place / "reach").iterdir():
        found = json.loads(file.read_text())
        found["policies"]["ik"] = policy(0.001, 1.0)
        file.write_text(json.dumps(found))
    assert f"| {label} | 0.10 (0.10 – 0.10) |" in render.page({"reach": ROW}, place)


def test_code_that_no_file_names_is_removed(measured, make_run) -> None:
    place = measured({"seed": 100})
    before = {path.name for path in (place / "code").iterdir()}
    newer = make_run(101, files={"train.py": "1"})
    records.write(records.record_run(ROW, newer, jobs=1), place)
    (place / "reach" / "seed-100.json").unlink()
    records.prune(place)
    assert len(list((place / "code").iterdir())) == 1
    assert not (place / "code" / before.pop()).exists()


def test_rows_older_than_the_code_say_so(measured) -> None:
    old = {"files": {"train.py": "000000000000", "gone.py": "1"}}
    place = measured({"seed": 100, **old}, {"seed": 101, **old})
    assert state(ROW, records.read(ROW, place)) == ("stale", ["gone.py", "train.py"])
    assert "before changes of 2 files.** `gone.py`, `train.py`." in render.page({"reach": ROW}, place)
    assert "One fixed goal¹" in render.readme_tables({"reach": ROW}, place)


def test_where_many_files_changed_git_names_them(measured) -> None:
    many = {"files": {f"gone{k}.py": "1" for k in range(13)}}
    place = measured({"seed": 100, **many}, {"seed": 101, **many})
    assert "changes of 13 files.** `git diff --stat " in render.page({"reach": ROW}, place)


def test_rows_older_than_the_configuration_say_so(measured) -> None:
    old = {"config": {"scale": "other"}}
    place = measured({"seed": 100, **old}, {"seed": 101, **old})
    assert state(ROW, records.read(ROW, place)) == ("stale", ["scale other → smoke"])


def test_what_is_not_measured_is_named_and_left_out_of_the_readme(tmp_path) -> None:
    text = render.page({"reach": ROW}, tmp_path)
    assert "## Not measured yet" in text and "`make results ROW=reach`" in text
    assert render.readme_tables({"reach": ROW}, tmp_path) == "Not measured yet.\n"


def test_a_benchmark(tmp_path) -> None:
    row = Row(
        name="speed",
        section=Section(title="Speed", threads=2),
        title="The learner",
        script="benchmarks/learner.py",
        arguments="--precision float32",
        readme=["batch", "updates"],
    )
    made = {
        "python": "3", "torch": "2.11.0", "newton": "1.8.0", "processor": "p", "cores": 2, "threads": 2,
        "device": "cpu", "started": "2026-01-02T03:04:05+00:00", "source": {},
    }  # fmt: skip
    file = tmp_path / "out.json"
    found = {"machine": made, "rows": [{"batch": "32", "updates": 1234.5, "other": float("nan")}]}
    file.write_text(json.dumps(found))
    written = records.write(records.record_benchmark(row, file, commit="abc"), tmp_path)
    assert (
        json.loads(written.read_text(), parse_constant=lambda name: pytest.fail(name))["rows"][0]["other"]
        is None
    )
    text = render.page({"speed": row}, tmp_path)
    written.write_text(
        written.read_text().replace('"other": null', '"other": NaN')
    )  # as earlier versions wrote it
    assert render.page({"speed": row}, tmp_path) == text
    assert "python benchmarks/learner.py --precision float32" in text
    assert "| 32 | 1,234 | – |" in text and "commit abc" in text
    assert "| p, 2 threads, 2026-01-02 | 32 | 1,234 |" in render.readme_tables({"speed": row}, tmp_path)
    file.write_text("{}")
    with pytest.raises(UserError, match="not what a benchmark wrote"):
        records.record_benchmark(row, file)


# -- the declared rows and the committed pages --------------------------------------------------------------


def test_train_accepts_every_declared_command(monkeypatch: pytest.MonkeyPatch) -> None:
    # A GPU's machine has other memory.
    monkeypatch.setattr("franka_wm.training.storage_budget.free_memory", lambda device: None)
    from franka_wm.training.check import check
    from franka_wm.training.settings import RunSettings

    monkeypatch.setattr("franka_wm.training.check.check_dataset", lambda run: None)  # `before` would make it
    for row in load_rows().values():
        if row.script is not None:
            assert (source.ROOT / row.script).is_file()
            continue
        # what `before` makes is not there: tests/training/test_demonstrations.py has such runs
        gone = ("replay.demo", "model.imitation_coef=") if row.before else ()
        config = composed(tuple(word for word in row.words if not word.startswith(gone)))
        assert isinstance(config, dict), f"{row.name}: {config}"
        check(RunSettings.of(config | {"seed": 0, "device": "cpu", "resume": None}))


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("{section: b, title: t, seeds: [0, 1]}", "section must be one of a"),
        ("{section: a, title: t, seed: 0}", "no entry seed"),
        ("{section: a, title: t}", "needs either seeds"),
        ("{section: a, title: t, seeds: [0, 1], wanted: {speed: 3}}", "wanted has no speed"),
        ("{section: a, title: t, seeds: [0, 1], goals: [{x: ≥ 1}]}", "goals are of a benchmark"),
        ("{section: a, title: t, script: b.py, goals: [{x: 1}]}", "COLUMN: ≥ N or ≤ N, not"),
    ],
)
def test_a_wrong_declaration_is_one_line(tmp_path, entry, says) -> None:
    file = tmp_path / "rows.yaml"
    file.write_text(f"sections: {{a: {{title: A}}}}\nrows:\n  one: {entry}\n")
    with pytest.raises(UserError, match=says):
        load_rows(file)


def test_committed_pages_are_what_the_files_say() -> None:
    """Nobody edits them by hand; after changes of code or files `make results` writes them anew."""
    rows = load_rows()
    assert (source.ROOT / "docs" / "results.md").read_text() == render.page(rows), "run `make results`"
    readme = (source.ROOT / "README.md").read_text()
    assert readme == with_results(readme, rows, records.PLACE), "run `make results`"


def test_readme_without_its_place_is_refused() -> None:
    with pytest.raises(UserError, match="needs the lines"):
        render.with_tables("# a readme", "tables")


def test_a_row_that_many_files_make_stale_has_a_short_line(monkeypatch) -> None:
    main = import_module("benchmarks.results.__main__")
    monkeypatch.setattr(main, "state", lambda *_: ("stale", [f"file{k}.py" for k in range(9)]))
    monkeypatch.setattr(main.confirm, "confirmed", lambda *_: None)
    (line,) = overview({"reach-cpu": load_rows()["reach-cpu"]}, records.PLACE).splitlines()
    assert "file2.py; 6 more, see docs/results.md" in line and "file3.py" not in line
