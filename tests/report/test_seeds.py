"""The table over seeds."""

import json

import pytest

from franka_wm.commands.main import main
from franka_wm.commands.summary import summary
from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import bootstrap_mean
from franka_wm.evaluation.results import END, Result
from franka_wm.report.compare import differences, repetitions
from franka_wm.report.run import RunFiles, as_asked, but_for_the_seed, read_run
from franka_wm.report.seeds import cells_told, read_evaluation, runs_of, seeds_table
from light import answers


def evaluation(distance: float, success: float) -> dict:
    interval = {"mean": success, "low": 0.0, "high": 1.0}
    return {
        "planner": {
            "final_distance": {"mean": distance, "low": 0.0, "high": 1.0},
            "success": {key: interval for key in ("0.05", "0.025", "0.01")},
            "return": {"mean": -1.0, "low": -2.0, "high": 0.0},
            "episodes": 64,
        }
    }


def written(distance: float, success: float) -> str:
    """An ``evaluation.json``."""
    return json.dumps({"protocol": {"by": END}, "policies": evaluation(distance, success)})


def test_mean_and_range_over_runs():
    table = seeds_table([evaluation(0.01, 1.0), evaluation(0.03, 0.5)])
    assert "| planner | 2.00 (1.00 – 3.00) | 75 (50 – 100) |" in table


def test_three_runs_have_an_interval_of_their_mean():
    """Of runs, not of episodes: that of the same numbers as a sample; the range stands below it."""
    distances = (0.01, 0.02, 0.03, 0.06)
    _, low, high = bootstrap_mean([100 * d for d in distances])
    assert 1.0 < low < 3.0 < high < 6.0
    table = seeds_table([evaluation(d, 1.0) for d in distances])
    assert f"| planner | 3.00 ({low:.2f} – {high:.2f}) | 100 (100 – 100) |" in table
    assert "\n| | 1.00 – 6.00 | 100 – 100 |" in table
    assert "interval" in cells_told(3) and "interval" not in cells_told(2)
    assert seeds_table([evaluation(0.01, 1.0), evaluation(0.03, 0.5)]).count("\n") == 2


def test_one_failure_in_many_episodes_shows():
    table = seeds_table([evaluation(0.01, rate) for rate in (1.0, 1.0, 127 / 128)])
    assert "| 99.7 (99 – 100) |" in table and "| 99 – 100 |" in table


def test_a_table_does_not_wait_for_torch(tmp_path):
    for k in range(3):
        (tmp_path / str(k)).mkdir()
        (tmp_path / str(k) / "evaluation.json").write_text(written(k / 100, 1.0))
    (done,) = answers([("-m", "franka_wm", "summary", "0", "1", "2")], tmp_path).values()
    assert "| planner | 1.00 (" in done.stdout and "torch" not in done.loaded, done.stderr


def test_summary_reads_folders(tmp_path, capsys):
    for k, distance in enumerate((0.01, 0.02)):
        (tmp_path / str(k)).mkdir()
        (tmp_path / str(k) / "evaluation.json").write_text(written(distance, 1.0))
    assert main(["summary", str(tmp_path / "0"), str(tmp_path / "1")]) == 0
    assert "2 runs of 64 episodes" in (out := capsys.readouterr().out) and "1.50" in out


def test_a_closed_pipe_is_not_the_runs_fault(tmp_path, monkeypatch):
    """`franka-wm summary RUN | head -1`: main ends that without a word."""

    def closed(*_: object) -> None:
        raise BrokenPipeError

    (tmp_path / "evaluation.json").write_text(written(0.01, 1.0))
    monkeypatch.setattr("builtins.print", closed)
    with pytest.raises(BrokenPipeError):
        summary.callback((str(tmp_path),))


def test_a_run_without_evaluation_is_refused(tmp_path, capsys):
    with pytest.raises(UserError, match="no evaluation"):
        read_evaluation(tmp_path)
    with pytest.raises(UserError, match="nowhere: no such folder"):
        read_evaluation(tmp_path / "nowhere")
    (tmp_path / "evaluation.json").write_text("{")
    with pytest.raises(UserError, match="cannot be read"):
        read_evaluation(tmp_path)
    assert main(["summary"]) == 2
    assert "usage: franka-wm summary RUN" in capsys.readouterr().out


def test_a_sweep_stands_for_its_runs(tmp_path, capsys):
    """Those of Hydra's numbers, in that order; of one that runs or failed a line says that it is left out."""
    (tmp_path / "multirun.yaml").touch()
    assert main(["summary", str(tmp_path)]) == 1
    assert "without runs" in capsys.readouterr().err
    for k in (10, 9, 2):
        (tmp_path / f"{k}-reach").mkdir()
        (tmp_path / f"{k}-reach" / "evaluation.json").write_text(written(k / 100, 1.0))
    (tmp_path / "figures").mkdir()
    assert [path.name for path in runs_of(tmp_path)] == ["2-reach", "9-reach", "10-reach"]
    assert main(["summary", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "of 64 episodes each: mean over runs (its bootstrap 95 % interval over seeds); below, " in said
    assert "| planner | 7.00 (" in said and "\n| | 2.00 – 10.00 | 100 – 100 |" in said
    (tmp_path / "9-reach" / "evaluation.json").unlink()
    assert main(["summary", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "1 of 3 runs have no result (yet; train.log says more): 9-reach\n" in said
    assert "2 runs of " in said and "6.00 (2.00 – 10.00)" in said
    for k in (10, 2):
        (tmp_path / f"{k}-reach" / "evaluation.json").unlink()
    assert main(["summary", str(tmp_path)]) == 1
    assert "2-reach: no evaluation" in capsys.readouterr().err


def test_runs_of_different_tasks_are_not_averaged(tmp_path, capsys):
    for k, (task, seed) in enumerate([("reach", 0), ("reach_fixed", 0), ("reach", 1)]):
        run = tmp_path / f"{k}-{task}"
        run.mkdir()
        (run / "evaluation.json").write_text(written((k + 1) / 100, 1.0))
        (run / "config.yaml").write_text(f"seed: {seed}\nenv: {{task: {task}}}\n")
    (tmp_path / "multirun.yaml").touch()
    assert main(["summary", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "2 runs (0-reach, 2-reach: env.task=reach)" in out and "2.00 (1.00 – 3.00)" in out
    assert "1 run (1-reach_fixed: env.task=reach_fixed)" in out and "| planner | 2.00 | 100 |" in out


def test_the_seed_of_recorded_data_follows_the_runs(tmp_path):
    """Runs on a dataset are repetitions, too, unless its own seed was chosen."""
    alike = [but_for_the_seed({"seed": k, "dataset": {"root": "there", "seed": k}}) for k in (0, 1)]
    chosen = [but_for_the_seed({"seed": k, "dataset": {"root": "there", "seed": 5 + k}}) for k in (0, 1)]
    other = but_for_the_seed({"seed": 0, "dataset": {"root": "here", "seed": 0}})
    assert alike[0] == alike[1] and len({alike[0], *chosen, other}) == 4


def test_a_run_that_went_on_is_the_repetition_it_was(tmp_path):
    """Its configuration names what its model had found itself before; only what was asked for tells runs apart."""
    began = but_for_the_seed({"seed": 0, "model": {"name": "tdmpc2", "value_low": None, "lr": 1}})
    found = {"seed": 1, "model": {"name": "tdmpc2", "value_low": -3.2, "lr": 1}, "resume": "there"}
    assert but_for_the_seed({**found, "derived": ["value_low"]}) == began
    assert but_for_the_seed({**found, "derived": []}) != began
    encoder = {
        **found,
        "model": {**found["model"], "encoder_architecture": [1, 2]},
    }  # no option has such a name
    assert but_for_the_seed({**encoder, "derived": ["encoder_architecture", "value_low"]}) == began
    first = {"seed": 0, "model": {"name": "tdmpc2", "value_low": None}}
    again = {"seed": 0, "model": {"name": "tdmpc2", "value_low": -3.2, "encoder_architecture": [1]}}
    derived = {"derived": ["encoder_architecture", "value_low"]}
    assert differences({"a": as_asked(first), "b": as_asked(again | derived)}) == {}
    assert but_for_the_seed({**found, "derived": 3}) != began, "of a damaged file"


def test_a_run_given_twice_is_refused(tmp_path, capsys):
    """By any name, and by itself beside its sweep."""
    (tmp_path / "multirun.yaml").touch()
    for k in range(2):
        (tmp_path / f"{k}-reach").mkdir()
        (tmp_path / f"{k}-reach" / "evaluation.json").write_text(written(0.01, 1.0))
    (tmp_path / "link").symlink_to(tmp_path / "1-reach")
    for words in (["0-reach", "0-reach/"], ["1-reach", "link"], [".", "1-reach"]):
        assert main(["summary", *(f"{tmp_path}/{word}" for word in words)]) == 1
        assert "is given twice; each run counts once" in capsys.readouterr().err


def test_of_one_seed_the_later_weights_count(tmp_path, capsys):
    """A run that was repeated for longer is no second seed, nor are results of a run that lie elsewhere."""
    for name, seed, updates in (
        ("a", 1, 300),
        ("b", 2, 300),
        ("a2", 1, 600),
        ("b2", 2, 600),
        ("out", 1, 300),
    ):
        run = tmp_path / name
        run.mkdir()
        config = {"seed": seed, "model": {"name": "tdmpc2"}}
        if name == "out":
            told = {"config": config, "overrides": [], "preset": "", "typed": []}
            (run / "run.json").write_text(json.dumps(told))
        else:
            (run / "config.yaml").write_text(json.dumps(config))
        found = {"protocol": {"by": END, "updates": updates}, "policies": evaluation(0.01 * len(name), 1.0)}
        (run / "evaluation.json").write_text(json.dumps(found))
    assert main(["summary", *(str(tmp_path / name) for name in ("a", "b", "b2", "a2", "out"))]) == 0
    out = capsys.readouterr().out
    assert "2 runs of 64 episodes" in out and "2.00 (2.00 – 2.00)" in out
    for left in ("a", "out"):
        assert f"left out: {tmp_path / left}, of seed 1 as {tmp_path / 'a2'}, which counts" in out
    groups = repetitions({name: read_run(tmp_path / name) for name in ("a", "b", "a2", "b2")})
    assert [list(group) for group in groups.values()] == [["a", "b"], ["a2", "b2"]]


def test_results_elsewhere_are_of_the_configuration_of_their_runs(tmp_path, capsys):
    for k, size in enumerate((32, 512, 512)):
        run = tmp_path / str(k)
        run.mkdir()
        config = {"seed": k, "model": {"name": "tdmpc2", "latent_dim": size}}
        (run / "run.json").write_text(
            json.dumps({"config": config, "overrides": [], "preset": "", "typed": []})
        )
        (run / "evaluation.json").write_text(written(0.01, 1.0))
    assert main(["summary", *(str(tmp_path / str(k)) for k in range(3))]) == 0
    out = capsys.readouterr().out
    assert "1 run (0: model.latent_dim=32)" in out and "2 runs (1, 2: model.latent_dim=512)" in out


def test_runs_of_other_updates_or_versions_are_told(tmp_path, capsys):
    for k, (updates, version) in enumerate([(4000, "0.1"), (4000, "0.1"), (2000, "0.2")]):
        (tmp_path / str(k)).mkdir()
        found = json.loads(written(0.01, 1.0))
        found["protocol"] |= {"updates": updates, "franka_wm": version}
        (tmp_path / str(k) / "evaluation.json").write_text(json.dumps(found))
    runs = [str(tmp_path / str(k)) for k in range(3)]
    assert main(["summary", *runs[:2]]) == 0
    assert "note:" not in capsys.readouterr().out
    assert main(["summary", *runs]) == 0
    out = capsys.readouterr().out
    assert "note: the runs are of different updates: 4000, 2000\n" in out
    assert "note: the runs are of different versions of franka_wm: 0.1, 0.2\n\n| policy" in out


def test_a_sweep_with_a_link_out_of_it_is_refused(tmp_path, capsys):
    sweep, other = tmp_path / "sweep", tmp_path / "other"
    for folder in (sweep, other):
        folder.mkdir()
    (sweep / "multirun.yaml").touch()
    (other / "evaluation.json").write_text(written(0.01, 1.0))
    (sweep / "0-reach").symlink_to(other)
    assert main(["summary", str(sweep)]) == 1
    assert f"0-reach is a link to {other}, outside of " in capsys.readouterr().err


def test_compare_does_not_blame_the_first_run_for_another_ones_values(tmp_path, capsys):
    for name in ("good", "bad"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "evaluation.json").write_text(written(0.01, 1.0))
    bad = json.loads((tmp_path / "bad" / "evaluation.json").read_text())
    bad["policies"]["planner"]["final_distance"]["mean"] = "a word"
    (tmp_path / "bad" / "evaluation.json").write_text(json.dumps(bad))
    words = [str(tmp_path / "good"), str(tmp_path / "bad"), f"out={tmp_path}/page.html"]
    assert main(["compare", *words]) == 1
    assert f"{tmp_path}/good or {tmp_path}/bad holds values of another form" in capsys.readouterr().err


def test_compare_tells_which_results_were_planned_otherwise(tmp_path, capsys):
    for name in ("as_it_was", "otherwise"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "evaluation.json").write_text(written(0.01, 1.0))
    words = ["compare", str(tmp_path / "as_it_was"), str(tmp_path / "otherwise"), f"out={tmp_path}/page.html"]
    assert main(words) == 0
    assert "measured by" not in (tmp_path / "page.html").read_text()
    found = json.loads((tmp_path / "otherwise" / "evaluation.json").read_text())
    found["protocol"]["planned with"] = "planner.num_samples=8"
    (tmp_path / "otherwise" / "evaluation.json").write_text(json.dumps(found))
    assert main(words) == 0
    page = (tmp_path / "page.html").read_text()
    assert "measured by" in page and page.count(", planned with planner.num_samples=8") == 1
    capsys.readouterr()
    assert main(["summary", *words[1:3]]) == 0
    said = capsys.readouterr().out
    assert "1 run (as_it_was) of" in said and "1 run (otherwise) of" in said, "no seeds of one another"


def test_what_was_found_of_older_weights_does_not_stand_beside_newer_ones(tmp_path):
    """A run that went on after `franka-wm evaluate`: its warnings and probes are not those of the table."""
    old = Result(tmp_path / "evaluation.json", {"updates": 20}, {}, {"probes": 1})
    new = Result(tmp_path / "evaluation.json", {"updates": 40}, {}, {"open_loop": 2})
    unsaid = Result(tmp_path / "evaluation.json", {}, {}, {"calibration": 3})
    assert RunFiles(tmp_path, results=[new, old]).extras == {"open_loop": 2}
    assert RunFiles(tmp_path, results=[new, unsaid]).extras == {"open_loop": 2, "calibration": 3}
