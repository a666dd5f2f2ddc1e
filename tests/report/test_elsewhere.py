"""Results that ``franka-wm evaluate`` wrote elsewhere than into the run's folder: they say of which run they are."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from franka_wm.commands import evaluate_checkpoint
from franka_wm.commands.evaluate_checkpoint import Options
from franka_wm.evaluation.protocol import Evaluation
from franka_wm.evaluation.results import COMMAND
from franka_wm.report.compare import _differences, compare_page, differences, repetitions, unique_names
from franka_wm.report.page import page
from franka_wm.report.run import RunFiles, read_config, read_run
from franka_wm.report.sections import probes, reproduce
from franka_wm.report.tasks import tasks_table
from tests.report.conftest import policy

CHANGED = ("planner=icem", "planner.sizes=[1, 2]")


@pytest.fixture
def evaluate(monkeypatch, tmp_path: Path) -> Any:
    """``evaluate(run, out, *overrides)`` without playing; returns the folder."""

    def evaluated(run: Path, out: str, *overrides: str, episodes: int = 100) -> Path:
        config = yaml.safe_load((run / "config.yaml").read_text())
        planner = {"name": "icem"} if overrides else config["planner"]
        # As training leaves them: the device here, and a value that it found.
        values = {**config, "planner": planner, "device": "auto", "model": {"name": "tdmpc2", "low": -1}}
        agent = SimpleNamespace(
            folder=run / "checkpoints" / "300",
            settings=SimpleNamespace(values=values),
            policies={"planner": None},
            env=SimpleNamespace(config=None),
            counters={},
        )
        found = Evaluation({"planner": {**policy(0.1), "episodes": episodes}}, {}, [1], {"planner": 0.1}, 1)
        told = {"by": COMMAND, "task": "reach", "updates": 300}
        monkeypatch.setattr(evaluate_checkpoint, "find_checkpoint", lambda folder: agent)
        monkeypatch.setattr(evaluate_checkpoint, "load_agent", lambda *a, **k: agent)
        monkeypatch.setattr(evaluate_checkpoint, "evaluate_agent", lambda *a, **k: found)
        monkeypatch.setattr(evaluate_checkpoint, "protocol", lambda *a, **k: told)
        evaluate_checkpoint.run(
            Options(
                str(run),
                tmp_path / out,
                episodes,
                "auto",
                False,
                False,
                False,
                overrides,
                ", ".join(overrides),
                ("RUN", *overrides, "plugins=[mine]"),
            )
        )
        return tmp_path / out

    return evaluated


@pytest.fixture
def run(make_run) -> Path:
    return with_planner(make_run("o/run"))


def with_planner(run: Path) -> Path:
    (run / "checkpoints").mkdir()
    (run / "config.yaml").write_text((run / "config.yaml").read_text() + "planner: {name: mppi}\n")
    return run


def compared(*folders: Path) -> dict[str, RunFiles]:
    runs = [read_run(folder) for folder in folders]
    return dict(zip(unique_names(runs), runs, strict=True))


def test_another_planner_is_the_one_difference_from_its_run(run: Path, evaluate) -> None:
    named = compared(run, evaluate(run, "icem", *CHANGED))
    table = tasks_table(repetitions(named))
    assert table is not None
    assert table.header == ["task", "tdmpc2", f"tdmpc2, {', '.join(CHANGED)}"]
    assert [row[0] for row in table.rows] == ["reach_fixed"] and "–" not in table.rows[0]
    different = differences({name: one.config for name, one in named.items()})
    assert different == {"planner.name": {"run": "mppi", "icem": "icem"}}
    assert _differences(different, list(named)) in compare_page(list(named.values()))


def test_its_page_says_what_was_planned_with_and_how_to_do_it_again(run: Path, evaluate, capsys) -> None:
    folder = evaluate(run, "icem", *CHANGED)
    assert capsys.readouterr().out.splitlines()[-1].endswith(f"franka-wm report {folder}")
    found = read_run(folder)
    header = f"reach, fixed goal · tdmpc2 · seed 0 · planned with {', '.join(CHANGED)}, not as the run did"
    assert header in page(found)
    again = "franka-wm evaluate RUN planner=icem &#39;planner.sizes=[1, 2]&#39; &#39;plugins=[mine]&#39;"
    assert again in reproduce(found)
    assert "franka-wm train env=reach_fixed seed=0" in reproduce(found)


def test_beside_the_runs_own_files_nothing_is_said_twice(run: Path, evaluate, capsys) -> None:
    folder = evaluate(run, "o/run/evaluation")
    assert not (folder / "run.json").exists()
    assert capsys.readouterr().out.splitlines()[-1].endswith(f"franka-wm report {run}")
    assert "planned with" not in page(read_run(run)) and "out=" not in reproduce(read_run(run))


def test_results_elsewhere_are_no_run(make_run, run: Path, evaluate) -> None:
    """No second run of a seed; those of several runs, planned alike, are repetitions of each other."""
    again = evaluate(run, "again")
    assert not (again / "config.yaml").exists() and read_config(again)["seed"] == 0
    other = with_planner(make_run("o/other", seed=1))
    icem = evaluate(run, "icem", *CHANGED), evaluate(other, "other_icem", *CHANGED)
    more = evaluate(run, "more", *CHANGED, episodes=200)
    groups = repetitions(compared(again, run, other, *icem, more))
    assert list(map(list, groups.values())) == [["again"], ["run", "other"], ["icem", "other_icem"], ["more"]]


def test_a_run_has_its_own_configuration_whatever_was_written_there_before(run: Path, evaluate) -> None:
    config = (run / "config.yaml").read_text()
    folder = evaluate(run, "icem", *CHANGED)
    (folder / "config.yaml").write_text(config)
    found = read_run(folder)
    assert not found.elsewhere and found.config["planner"] == {"name": "mppi"}


def test_a_file_of_another_form_ends_in_one_line(run: Path, evaluate) -> None:
    from franka_wm.errors import UserError

    folder = evaluate(run, "icem", *CHANGED)
    (folder / "run.json").write_text(json.dumps({"config": {}}))
    assert not read_run(folder).elsewhere, "of somebody else"
    for told in ([], {"config": [], "overrides": 1, "preset": "", "typed": []}):
        (folder / "run.json").write_text(json.dumps(told))
        with pytest.raises(UserError, match=r"measure the run again|run\.json holds no object"):
            read_run(folder)


def test_the_caption_tells_bars_of_probes_that_are_cut(tmp_path: Path, run: Path) -> None:
    for low, cut in ((-6.25, True), (-0.5, False)):
        results = {"protocol": {}, "policies": {}, "probes": {"joints": {"ridge": low, "neighbours": 0.5}}}
        (run / "evaluation.json").write_text(json.dumps(results))
        shown = probes(read_run(run))
        assert ("A bar with an arrow is cut" in shown) is ("← -6.25" in shown) is cut
