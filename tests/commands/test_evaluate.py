"""``franka-wm evaluate``: files, tables, repeatability, and one line for what cannot be."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from franka_wm.commands import evaluate_checkpoint
from franka_wm.commands import main as cli
from franka_wm.commands.evaluate import default_folder
from franka_wm.commands.evaluate import evaluate as verb
from franka_wm.errors import UserError
from franka_wm.evaluation import diagnose
from franka_wm.evaluation.results import to_json
from franka_wm.models import WorldModel
from franka_wm.planning import registry
from franka_wm.report import diagnostics
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.load import _planning_otherwise

POLICIES = {"planner", "policy", "noop", "random", "ik"}


@pytest.mark.slow
def test_everything_twice(run_folder: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    """All files, and evaluation.json and evaluation.md the same to the byte."""
    train = diagnose.train_decoder
    monkeypatch.setattr(diagnose, "train_decoder", lambda z, p: train(z, p, steps=20))
    for out in ("one", "two"):
        arguments = [f"checkpoint={run_folder}", f"out={tmp_path / out}", "episodes=8", "device=cpu"]
        assert cli.main(["evaluate", *arguments]) == 0
    said = capsys.readouterr().out
    one, two = tmp_path / "one", tmp_path / "two"
    names = {"evaluation.json", "evaluation.md", "timing.json", "imagined.png", "imagined.mp4", "run.json"}
    assert {path.name for path in one.iterdir()} == names
    for name in ("evaluation.json", "evaluation.md", "imagined.png"):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name

    results = json.loads((one / "evaluation.json").read_text())
    assert set(results["policies"]) == POLICIES and "diagnostics" not in results["protocol"]
    for policy in results["policies"].values():
        assert policy["episodes"] == 8
        assert {"final_distance", "success", "success_once", "return", "path_length", "jerk"} <= set(policy)
    assert results["policies"]["ik"]["final_distance"]["mean"] < 0.1
    assert len(results["open_loop"]["curves"]["model"]["mean"]) == 10
    assert set(results["probes"]) == {"joints", "velocities", "tool", "goal", "tool to goal"}
    assert results["spectrum"]["effective_rank"] > 1 and results["calibration"]["samples"] == 8 * 12
    assert results["health"]["planner states"] == 8
    assert len(results["latents"]["points"]) == len(results["latents"]["quantity"]) == 8 * 12
    assert results["protocol"]["episodes"] == 8 and results["protocol"]["model"] == "tdmpc2"
    timing = json.loads((one / "timing.json").read_text())
    assert set(timing) == POLICIES and timing["planner"]["seconds_per_decision"] > 0

    text = (one / "evaluation.md").read_text()
    for title in ("Open loop", "Probes", "What else was found", "| ik |"):
        assert title in text
    assert " ik " in said and "ik: inverse kinematics" in text and "Robustness" not in text


@pytest.mark.slow
def test_the_closed_loop_alone(run_folder: Path, tmp_path: Path, capsys) -> None:
    arguments = ["episodes=4", "device=cpu", "open_loop=false", "probes=false"]
    assert cli.main(["evaluate", f"checkpoint={run_folder}", f"out={tmp_path}", *arguments]) == 0
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert set(results) == {"protocol", "policies"} and "planned with" not in results["protocol"]
    assert str(tmp_path) in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.slow
def test_what_was_played_is_kept_when_the_rest_is_interrupted(
    run_folder: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(diagnose, "hold_out", stop)
    arguments = ["evaluate", f"checkpoint={run_folder}", f"out={tmp_path}", "device=cpu"]

    def kept(*more: str) -> dict[str, Any]:
        assert cli.main([*arguments, *more]) == 130
        assert "| ik |" in (tmp_path / "evaluation.md").read_text()
        return json.loads((tmp_path / "evaluation.json").read_text())

    results = kept("episodes=4")
    assert set(results) == {"protocol", "policies"} and set(results["policies"]) == POLICIES
    assert results["protocol"]["diagnostics"] == "not ended"
    assert "results of the episodes" in capsys.readouterr().out
    assert kept("episodes=5")["protocol"]["episodes"] == 5  # it held less
    assert cli.main([*arguments, "episodes=6", "open_loop=false", "probes=false"]) == 0
    whole = kept("episodes=7")
    assert whole["protocol"]["episodes"] == 6 and "diagnostics" not in whole["protocol"]
    (tmp_path / "evaluation.json").write_text(
        json.dumps({**whole, "protocol": {**whole["protocol"], "updates": 1}})
    )
    assert kept("episodes=7")["protocol"]["episodes"] == 7  # of earlier weights


def test_what_is_stopped_says_what_was_written(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    file = tmp_path / "run" / "evaluation" / "evaluation.json"

    def stopped(writes: bool) -> str:
        def run(_: object) -> None:
            if writes:
                file.parent.mkdir(exist_ok=True)
                file.write_text("{}")
            raise KeyboardInterrupt

        monkeypatch.setattr(evaluate_checkpoint, "run", run)
        assert cli.main(["evaluate", str(tmp_path / "run")]) == 130
        return capsys.readouterr().out

    monkeypatch.setattr("franka_wm.commands.evaluate.check_run", lambda *_: None)
    assert stopped(False) == "stopped; nothing was written\n"
    assert f"stopped; {file.parent} has the results of all episodes, not those of the diag" in stopped(True)
    assert (
        stopped(False)
        == f"stopped; nothing was written; the result that was in {file.parent} is still there\n"
    )


def test_each_policy_says_how_long_it_took_and_what_is_left(capsys, monkeypatch) -> None:
    now = iter((0.0, 4.0, 4.0, 10.0, 10.0))
    monkeypatch.setattr(evaluate_checkpoint.time, "perf_counter", lambda: next(now))
    began: list[str] = []
    report = evaluate_checkpoint._progress(["4 episodes of planner", "4 episodes of noop"], began.append)
    for name in ("planner", "noop"):
        report(name, {"return": {"mean": -1.0}})
    first, last = capsys.readouterr().out.splitlines()
    assert first == "  planner: return -1.00   (4.0 s; 1 of 2, left 0:04)"
    assert last == "  noop: return -1.00   (6.0 s)"
    assert began == ["4 episodes of planner", "4 episodes of noop"]


def test_as_many_episodes_as_the_run_has_itself(
    run_folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """Not a number of its own: of a run of scale=smoke it took as long as of a large one."""
    own = load_checkpoint(latest_checkpoint(run_folder)).config["evaluation"]["episodes"]
    built: list[int] = []

    def load(*_: object, num_envs: int, **__: object) -> None:
        built.append(num_envs)
        raise UserError("loaded")

    monkeypatch.setattr(evaluate_checkpoint, "load_agent", load)
    words = ["evaluate", str(run_folder), f"out={tmp_path}", "device=cpu"]
    assert cli.main(words) == cli.main([*words, "episodes=9"]) == 1
    assert built == [own, 9] and own != 100
    told = {"protocol": {}, "policies": {"planner": {"episodes": own + 1}}}
    (tmp_path / "evaluation.json").write_text(json.dumps(told))
    capsys.readouterr()
    assert cli.main(words) == 1
    assert f"a result of {own + 1} episodes, which one of {own} would replace" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["episodes=5"], "give checkpoint="),
        (["checkpoint=a", "episodes=1"], "episodes=1"),
        (["checkpoint=a", "episodes=many"], "episodes=many"),
        (["checkpoint=a", "probes=perhaps"], "true or false"),
        (["checkpoint=a", "fast=true"], "fast: no such option; there are checkpoint, out"),
        (["checkpoint=a", "--robustnes"], "robustnes: no such option; did you mean robustness?"),
        (["checkpoint=a", "checkpoint=b"], "given twice"),
        (["a", "outputs/run"], "'outputs/run': write options as name=value"),
        (["checkpoint="], "checkpoint=: a value is missing"),
        (["a", "planner.num_samples=8"], "do not take the place of its own; give another folder, out=FOLDER"),
        (["a", "out=a/evaluation", "objective.policy_penalty=1"], "do not take the place of its own"),
        (["a", "out=a", "objective.policy_penalty=1"], "do not take the place of its own"),
        (["a", "evaluation.episodes=5"], "evaluation.episodes: no such option; did you mean episodes?"),
        (["a", "env.fps=20"], "plugins, planner=, planner.KEY, objective.KEY, hydra.searchpath="),
        (["a", "planner=cem"], "planner=cem: results of other settings than the run's do not take the place"),
        (["checkpoint=a", "outputs/run"], "'outputs/run': write options as name=value"),
    ],
)
def test_bad_arguments(arguments: list[str], says: str, capsys) -> None:
    assert cli.main(["evaluate", *arguments]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and says in lines[0]


@pytest.mark.slow
def test_a_checkpoint_plans_otherwise_than_its_run(
    root, run_folder, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.syspath_prepend(root)
    monkeypatch.setattr(registry, "_REGISTERED", {})
    words = ["episodes=4", "device=cpu", "open_loop=false", "probes=false"]
    changed = ["planner.num_samples=6", "planner.num_elites=3", "planner.num_policy_samples=0"]
    for out, more in (("as_it_was", []), ("otherwise", changed)):
        assert cli.main(["evaluate", str(run_folder), f"out={tmp_path / out}", *words, *more]) == 0
    found = {
        out: json.loads((tmp_path / out / "evaluation.json").read_text())
        for out in ("as_it_was", "otherwise")
    }
    assert found["otherwise"]["protocol"]["planned with"] == ", ".join(changed)
    assert (tmp_path / "otherwise" / "evaluation.md").read_text().startswith(f"Planned with {changed[0]}, ")
    returns = {
        out: {name: one["return"]["mean"] for name, one in f["policies"].items()} for out, f in found.items()
    }
    assert returns["otherwise"]["planner"] != returns["as_it_was"]["planner"]
    assert returns["otherwise"]["policy"] == returns["as_it_was"]["policy"]
    words_of_cem = [*words, "planner=icem", "planner=cem", "planner.num_samples=12"]
    assert cli.main(["evaluate", str(run_folder), f"out={tmp_path / 'cem'}", *words_of_cem]) == 0
    cem = json.loads((tmp_path / "cem" / "evaluation.json").read_text())
    assert cem["protocol"]["planner"] == "cem" and cem["policies"]["planner"]["return"]["mean"] not in {
        one["planner"] for one in returns.values()
    }
    capsys.readouterr()
    for wrong, says in (
        (
            "planner.num_smaples=6",
            "planner.num_smaples: no such option of this run's planner; there are horizon",
        ),
        ("objective.policy_penalty=-1", "policy_penalty=-1: must be a finite number of at least 0"),
        ("planner.num_samples=0", "planner.num_samples=0: must be a whole number of at least 1"),
        (
            "planner=cemm",
            "planner=cemm: must be one of cem, gradient, gumbel, icem, mcts, mppi; did you mean cem?",
        ),
        ("planner=../model/tdmpc2", "planner=../model/tdmpc2: must be the name of a planner"),
        ("planner=cem,icem", "must be the name of a planner"),
        (
            "planner=mine",
            "icem, mcts, mppi; of your own: hydra.searchpath=[file://FOLDER], with planner/mine.yaml",
        ),
    ):
        assert cli.main(["evaluate", str(run_folder), f"out={tmp_path / 'wrong'}", *words, wrong]) == 1
        assert says in capsys.readouterr().err
    assert not (tmp_path / "wrong").exists()
    own = [f"hydra.searchpath=[file://{root}/examples/conf]", "plugins=[examples.add_a_planner]"]
    assert (
        cli.main(["evaluate", str(run_folder), f"out={tmp_path / 'own'}", *words, *own, "planner=shooting"])
        == 0
    )
    protocol = json.loads((tmp_path / "own" / "evaluation.json").read_text())["protocol"]
    assert protocol["planner"] == "shooting" and protocol["planned with"] == "planner=shooting"


def test_a_folder_of_something_else_is_told_apart(tmp_path: Path, capsys) -> None:
    (tmp_path / "staged" / "pretrained" / "checkpoints").mkdir(parents=True)
    assert cli.main(["evaluate", str(tmp_path / "staged")]) == 1
    assert "holds runs" not in capsys.readouterr().err
    for folder in ("sweep/0-reach/checkpoints", "sweep/1-reach/checkpoints", "sweep/plots", "data/meta"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text("{}")
    for folder, says in (
        ("sweep", "sweep: holds runs; give one of 0-reach, 1-reach"),
        ("data", "data: is a dataset; give the folder of a run"),
    ):
        assert cli.main(["evaluate", str(tmp_path / folder)]) == 1
        told = capsys.readouterr()
        assert says in told.err and not told.out


def test_a_tree_search_is_told_that_it_has_no_objective() -> None:
    settings: Any = SimpleNamespace(is_discrete=True, values={"objective": {"policy_penalty": 0.0}})
    with pytest.raises(UserError, match=r"objective\.policy_penalty: a tree search has no objective"):
        _planning_otherwise(settings, {"planner": {}, "objective": {"policy_penalty": 3.0}})


def test_a_checkpoint_that_is_not_there(tmp_path: Path, capsys) -> None:
    for name in ("checkpoint=", ""):
        arguments = [f"{name}{tmp_path}/nowhere", f"out={tmp_path}/out", "device=cpu"]
        assert cli.main(["evaluate", *arguments]) == 1
        assert f"checkpoint={tmp_path}/nowhere: no such folder" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_results_of_something_else_are_not_replaced(tmp_path: Path, capsys, monkeypatch) -> None:
    """Those of another run, and those that were planned otherwise."""
    for name in ("run", "other", "other/evaluation"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr("franka_wm.commands.evaluate.check_run", lambda *_: None)
    monkeypatch.setattr(evaluate_checkpoint, "run", lambda _: None)

    def told(out: str, *words: str) -> str:
        code = cli.main(["evaluate", str(tmp_path / "run"), f"out={tmp_path / out}", "episodes=9", *words])
        said = capsys.readouterr().err
        assert bool(code) is bool(said)
        return said

    assert "other: is the folder of another run" in told("other")
    assert not told("new", "planner=cem")
    (tmp_path / "new").mkdir()
    there = {"protocol": {"episodes": 2, "planned with": "planner=cem"}, "policies": {}}
    (tmp_path / "new" / "evaluation.json").write_text(json.dumps(there))
    assert not told("new", "planner=cem")
    assert "holds a result planned with planner=cem, which this one would replace" in told(
        "new", "planner=icem"
    )
    assert "holds a result planned with planner=cem" in told("new")


def test_a_result_of_more_episodes_is_not_replaced(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("franka_wm.training.load.find_checkpoint", lambda _: SimpleNamespace(counters={}))
    (tmp_path / "checkpoints").mkdir()
    place = tmp_path / "evaluation"
    place.mkdir()
    told = {"protocol": {}, "policies": {"planner": {"episodes": 100}}}
    (place / "evaluation.json").write_text(json.dumps(told))
    assert cli.main(["evaluate", str(tmp_path), "episodes=99", "device=cpu"]) == 1
    assert "holds a result of 100 episodes, which one of 99 would replace" in capsys.readouterr().err
    assert cli.main(["evaluate", str(tmp_path), "episodes=100", "device=cpu"]) == 1
    assert "no checkpoint in" in capsys.readouterr().err  # nothing against it: it goes on to load


def test_images_of_an_earlier_evaluation_do_not_stay_beside_new_numbers(tmp_path: Path) -> None:
    for name in ("imagined.png", "imagined.mp4", "mine.png"):
        (tmp_path / name).write_text("earlier")
    nothing: Any = SimpleNamespace(seconds={}, worlds=2)
    evaluate_checkpoint._write(tmp_path, {}, "", nothing, None, None)
    names = {"mine.png", "timing.json", "evaluation.md", "evaluation.json"}
    assert {one.name for one in tmp_path.iterdir()} == names


@pytest.mark.parametrize("out", ["taken", "taken/below"])
def test_results_that_cannot_be_written_are_refused_before_playing(out: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "taken").write_text("mine")
    arguments = [f"checkpoint={tmp_path}/nowhere", f"out={tmp_path / out}", "device=cpu"]
    assert cli.main(["evaluate", *arguments]) == 1  # before it even looks for the checkpoint
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "taken is not a folder; give another folder" in captured.err
    assert captured.out == ""
    assert (tmp_path / "taken").read_text() == "mine"


def test_shifting_what_is_no_arm_is_refused_before_playing(tmp_path: Path, monkeypatch, capsys) -> None:
    found = SimpleNamespace(folder=tmp_path, env=object())
    for name in ("find_checkpoint", "load_agent"):
        monkeypatch.setattr(evaluate_checkpoint, name, lambda *a, **k: found)
    monkeypatch.setattr(evaluate_checkpoint, "evaluate_agent", lambda *a, **k: pytest.fail("played"))
    (tmp_path / "checkpoints").mkdir()
    monkeypatch.setattr(evaluate_checkpoint, "protocol", lambda *a: pytest.fail("went on"))
    assert cli.main(["evaluate", str(tmp_path), f"out={tmp_path}/out", "episodes=9", "robustness=true"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "only the arm can be shifted" in captured.err


def test_latents_that_never_change_are_said(agent, monkeypatch) -> None:
    """The rest is measured; the reason is in the results and in the table."""
    held = diagnose.hold_out(agent, images=False)
    held.latents = torch.zeros_like(held.latents)
    for other in ("calibration", "health"):
        monkeypatch.setattr(diagnose, other, lambda *a: {})
    results, said = {}, []
    assert evaluate_checkpoint._look_ahead(agent, held, None, results, said.append) is None  # type: ignore[arg-type]
    assert "no latent changes within 1 steps" in results["open_loop"]["not_measured"]
    assert sum("warning: open loop not measured" in line for line in said) == 1
    assert "no latent changes" in diagnostics.findings(results)["open loop, not measured"]


def test_help(capsys) -> None:
    assert cli.main(["evaluate", "--help"]) == 0
    assert "robustness=false" in capsys.readouterr().out
    assert cli.main(["evaluate"]) == 2


def test_options() -> None:
    """Words, and options as other programs have them."""
    words = [
        "checkpoint=a",
        "out=b",
        "episodes=7",
        "device=cpu",
        "robustness=true",
        "open_loop=true",
        "probes=false",
    ]
    options = [
        "--checkpoint",
        "a",
        "--out=b",
        "--episodes",
        "7",
        "--device=cpu",
        "--robustness",
        "--open-loop",
    ]
    found = verb.make_context("evaluate", words).params
    assert found == verb.make_context("evaluate", [*options, "--probes=false"]).params
    assert found["episodes"] == 7 and found["robustness"] and not found["probes"] and found["open_loop"]


def test_the_bare_folder_may_follow_an_option_and_its_value() -> None:
    episodes = ["--episodes", "7"]
    for words in ([*episodes, "a"], ["a", *episodes], ["--robustness", "a", *episodes]):
        found = verb.make_context("evaluate", words).params
        assert (found["checkpoint"], found["episodes"]) == ("a", 7), words
    assert verb.make_context("evaluate", ["--out", "b=1", "a"]).params["out"] == "b=1"


def test_default_folder(tmp_path: Path) -> None:
    checkpoint = tmp_path / "run" / "checkpoints" / "latest"
    checkpoint.mkdir(parents=True)
    other = checkpoint.with_name("reach")  # anybody may call a folder checkpoints
    assert default_folder(str(other)) == other / "evaluation"
    assert default_folder(str(checkpoint)) == tmp_path / "run" / "evaluation"
    (tmp_path / "run" / "config.yaml").touch()
    first = tmp_path / "run" / "pretrained"
    assert default_folder(str(first / "checkpoints" / "7")) == first / "evaluation"
    for one in (checkpoint, checkpoint.parent, tmp_path / "run"):
        assert default_folder(str(one)) == tmp_path / "run" / "evaluation"
    assert default_folder("hf:me/arm") == Path("outputs/evaluation/me--arm")


def test_json_has_no_nan() -> None:
    text = to_json({"a": float("nan"), "b": [1.0, float("inf")], "c": {"d": 2}})
    assert json.loads(text) == {"a": None, "b": [1.0, None], "c": {"d": 2}}


# -- models that lack parts --------------------------------------------------------------------------------


class Blind(WorldModel):
    """A representation alone: no dynamics, no value, no policy."""

    observation_sizes = {"state": 20}

    def encode(self, observation):
        return observation.get("state")


@pytest.fixture
def representation_alone(agent):
    from dataclasses import replace

    policies = {name: agent.policies[name] for name in ("noop", "random")}
    return replace(agent, model=Blind(), policies=policies)


def test_a_representation_alone(representation_alone) -> None:
    held = diagnose.hold_out(representation_alone, images=False)
    assert held.images is None
    assert "curves" not in diagnose.open_loop(representation_alone, held)
    assert diagnose.calibration(representation_alone) == {}
    assert diagnose.health(representation_alone, None) == {}
    assert diagnose.imagine(representation_alone, held) is None
    found = diagnose.probes(held, representation_alone.model)
    assert found["joints"]["ridge"] > 0.999 and found["tool"]["ridge"] > 0.999  # it hands the state over
    assert found["goal"]["ridge"] is None  # one test episode has one goal
    spectrum, latents = diagnose.representation(held, representation_alone.model)
    assert spectrum["dimensions"] == 20 and len(latents["explained"]) == 2
