"""Options of a run that goes on: any of its own, whatever the defaults have; tried as Hydra reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from franka_wm.commands.overrides import compose
from franka_wm.commands.resumed import with_options_of_its_run
from franka_wm.training.checkpoint import save_checkpoint
from franka_wm.training.run import resumed


@pytest.fixture(params=[False, True])
def run(tmp_path: Path, request: pytest.FixtureRequest) -> str:
    """A checkpoint of Dreamer on recorded data, planned with by trees' search: nothing of it is a default.

    Or one of its first stage, which keeps the whole run's configuration aside.
    """
    staged = request.param
    words = [
        "scale=smoke",
        "device=cpu",
        "model=dreamer",
        "planner=gumbel",
        "dataset=lerobot",
        "dataset.root=sets/a",
    ]
    whole: Any = OmegaConf.to_container(compose(words), resolve=True)
    config: Any = OmegaConf.create(
        {**whole, "model": {"name": "jepa"}, "whole_run": whole} if staged else whole
    )
    save_checkpoint(tmp_path / "run", model=torch.nn.Linear(1, 1), config=config, counters={})
    return f"resume={tmp_path / 'run'}"


def test_a_run_goes_on_with_other_values_of_its_own_options(run: str) -> None:
    words = [
        run,
        "model.burn_in=3",
        "planner.num_simulations=5",
        "dataset.validation_fraction=0.2",
        "trainer.lr=0.1",
    ]
    given = with_options_of_its_run(
        [*words, "device=cpu", "--cfg", "job", "hydra.run.dir=x", "+model.classes=7"]
    )
    assert given == [
        run,
        *(f"++{one}" for one in words[1:4]),
        words[4],  # Hydra has it as well
        "device=cpu",
        "--cfg",
        "job",
        "hydra.run.dir=x",
        "+model.classes=7",
    ]
    overrides = [one for one in given if "=" in one]
    _, settled = resumed(compose(overrides), overrides)
    assert (settled.model.burn_in, settled.planner.num_simulations, settled.model.classes) == (3, 5, 7)
    assert (settled.dataset.validation_fraction, settled.trainer.lr) == (0.2, 0.1)
    assert settled.model.name == "dreamer"


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("model.rho=0.4", "model.rho: no such option; did you mean "),
        ("model.burnin=3", "model.burnin: no such option; did you mean model.burn_in?"),
        ("planner.num_samples=9", "planner.num_samples: no such option"),
    ],
)
def test_what_the_run_does_not_have_is_refused_in_one_line(option: str, said: str, run: str, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        with_options_of_its_run([run, option])
    told = capsys.readouterr().err
    assert ended.value.code == 1 and told.startswith(f"error: {said}") and told.count("\n") == 1


def test_without_a_run_to_go_on_from_nothing_changes(tmp_path: Path) -> None:
    for words in (
        ["model.burn_in=3", "seed=1"],
        ["resume=nowhere", "model.burn_in=3"],
        ["resume=", "a.b=1"],
        [],
    ):
        assert with_options_of_its_run(words) == words


def test_a_sweep_over_runs_takes_what_each_has(run: str, tmp_path: Path, capsys) -> None:
    folder = run.partition("=")[2]
    plain: Any = OmegaConf.create(
        OmegaConf.to_container(compose(["scale=smoke", "device=cpu"]), resolve=True)
    )
    save_checkpoint(tmp_path / "plain", model=torch.nn.Linear(1, 1), config=plain, counters={})
    assert with_options_of_its_run([f"{run},{folder}", "model.burn_in=2,3"])[1] == "++model.burn_in=2,3"
    with pytest.raises(SystemExit):
        with_options_of_its_run([f"{run},{tmp_path}/plain", "model.burn_in=2"])
    assert "model.burn_in: no such option" in capsys.readouterr().err


def test_an_older_run_has_todays_options_of_its_planner(tmp_path: Path) -> None:
    words = ["scale=smoke", "device=cpu", "model=muzero", "planner=gumbel", "env=reach_fixed"]
    older: Any = OmegaConf.to_container(compose(words), resolve=True)
    del older["planner"]["c_scale_acting"]
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=OmegaConf.create(older), counters={})  # type: ignore[arg-type]
    given = with_options_of_its_run([f"+resume={tmp_path}", "planner.c_scale_acting=2"])
    assert given[1] == "++planner.c_scale_acting=2"
    older["planner"]["name"] = "mine"  # of a plugin: what it has is known later
    save_checkpoint(tmp_path, model=torch.nn.Linear(1, 1), config=OmegaConf.create(older), counters={})  # type: ignore[arg-type]
    words = [f"resume={tmp_path}", "planner.width=2"]
    assert with_options_of_its_run(words) == words


@pytest.mark.parametrize("named", ["[", "/tmp/run(1)", "~/run", "x" * 300])
def test_what_names_no_folder_is_said_where_it_is_read(named: str) -> None:
    words = [f"resume={named}", "model.burn_in=3"]
    assert with_options_of_its_run(words) == words


def test_help_reads_no_run(tmp_path: Path) -> None:
    words = ["--help", f"resume={tmp_path}", "model.burn_in=3"]
    assert with_options_of_its_run(words) == words


def test_train_reads_options_so(run: str, monkeypatch, capsys) -> None:
    from franka_wm.commands import train

    seen: list[Any] = []
    monkeypatch.setattr(train, "run_command", lambda main, arguments: seen.append(arguments))
    train.command([run, "model.burn_in=3"])
    assert seen == [[run, "++model.burn_in=3"]]
