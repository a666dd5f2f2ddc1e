"""Agents and models from a checkpoint alone; two stages in one run; every family through the one loop."""

from __future__ import annotations

import fcntl
import gc
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.data import LazyTensorStorage

import franka_wm
from forks import run_in_fork
from franka_wm.commands.demo import AGENT
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.learner import Learner
from franka_wm.training.load import _planning_otherwise, load_agent, load_model, preset_of
from franka_wm.training.place import _LOCKS, lock_run_dir
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings
from franka_wm.training.stages import pretrain
from franka_wm.training.trainer import Trainer

SMALL = (
    "scale=smoke",
    "device=cpu",
    "logger=none",
    "env.substeps=1",
    "env.episode_length=8",
    "env.image_size=32",
    "collector.num_envs=4",
    "replay.capacity=400",
    "replay.batch_size=4",
    "evaluation.episodes=2",
    "trainer.updates=6",
    "trainer.updates_per_batch=3",
)
FAMILIES = {
    "tdmpc2": ["env=reach"],
    "tdmpc2_pixels": ["env=reach_pixels", "env.image_size=40"],
    "muzero": ["env=reach", "planner=gumbel"],
    "dreamer": ["env=reach"],
    "lewm": ["env=reach_goal_image", "planner=cem"],
    "action_world_model": ["env=reach_goal_image", "planner=cem"],
    "jepa": ["env=reach_pixels"],
}


@pytest.fixture(scope="module")
def train(settled, tmp_path_factory) -> Callable[..., tuple[Path, RunSettings, Any]]:
    """What train.py does, without Hydra's folders: the run's folder, configuration and trainer."""

    def make(*overrides: str) -> tuple[Path, RunSettings, Any]:
        cfg = settled(*SMALL, *overrides)
        check(cfg)
        torch.manual_seed(0)
        run = Run(settings=cfg, folder=tmp_path_factory.mktemp("run"))
        env = build.make_env(cfg)
        replay, spaces = run.build_experience(env)
        pretrain(run, env, replay, spaces)
        cfg = run.settings  # the second stage's
        model = build.make_model(cfg, spaces, run.device)
        trainer = Trainer(
            env=env,
            learner=Learner(model, **run.settings.learner_options),
            replay=replay,
            policies=build.make_agent_policies(cfg, model, env, spaces),
            actor=cfg.actor,
            settings=cfg,
            folder=run.folder,
            loggers=[],
            evaluate=dict,
            spaces=spaces,
        )
        trainer.fit()
        return run.folder, cfg, trainer

    return make


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_trains_and_comes_back(family: str, train) -> None:
    folder, _, trainer = train(f"model={family}", *FAMILIES[family])
    metrics = [row for row in trainer.rows if "loss" in row]
    assert metrics and all(torch.tensor(row["loss"]).isfinite() for row in metrics)
    model = franka_wm.load(str(folder))
    assert not model.training
    batch = trainer.replay.sample()
    trainer.model.eval()
    with torch.no_grad():
        torch.testing.assert_close(model.encode(batch), trainer.model.encode(batch))
    agent = load_agent(folder, num_envs=2, device="cpu")
    assert ("planner" in agent.policies) == (family != "jepa")
    for policy in agent.policies.values():
        tensordict = agent.env.reset(seed=3)
        for _ in range(2):
            _, tensordict = agent.env.step_and_maybe_reset(policy(tensordict))
            assert tensordict["action"].float().isfinite().all()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["action_world_model", "dino_wm"])
def test_two_stages(train, model: str) -> None:
    """The teacher of the first stage does not move in the second, and the checkpoint does not need it."""
    folder, _, trainer = train(
        f"model={model}", "pretrain=jepa", "pretrain.updates=4", *FAMILIES["action_world_model"]
    )
    first = franka_wm.load(str(folder / "pretrained"))
    learned = trainer.model.encoder.network.state_dict()
    assert learned
    taught = first.target_encoder.state_dict()
    assert set(taught) == set(learned)
    for name, value in taught.items():
        assert torch.equal(value, learned[name]), name
    frozen = [p for p in trainer.model.encoder.parameters() if p.requires_grad]
    assert frozen == []
    shutil.rmtree(folder / "pretrained")
    again = franka_wm.load(str(folder))
    batch = trainer.replay.sample()
    trainer.model.eval()
    with torch.no_grad():
        torch.testing.assert_close(again.encode(batch), trainer.model.encode(batch))


def test_the_first_stage_leaves_no_replay_behind(settled, tmp_path: Path) -> None:
    """Or the second could not have the memory."""
    cfg = settled(
        *SMALL,
        "model=action_world_model",
        "pretrain=jepa",
        "pretrain.updates=4",
        *FAMILIES["action_world_model"],
    )
    run = Run(settings=cfg, folder=tmp_path)
    env = build.make_env(cfg)
    replay, spaces = run.build_experience(env)

    def filled() -> int:
        storages = [one for one in gc.get_objects() if isinstance(one, LazyTensorStorage)]
        return sum(one.initialized for one in storages)

    seen = []
    gc.collect()
    before = filled()
    pretrain(run, env, replay, spaces, diagnose=lambda model, _: seen.append(type(model)) or ({}, None))
    assert filled() == before
    assert {one.__name__ for one in seen} == {"JEPA"}  # which could collapse


def test_a_family_without_an_encoder_to_replace(settled) -> None:
    with pytest.raises(UserError, match="pretrain"):
        check(settled(*SMALL, "pretrain=jepa"))


def test_a_family_that_needs_a_pretrained_encoder_has_one_or_is_refused(settled, tmp_path: Path) -> None:
    task = (*SMALL, "model=dino_wm", *FAMILIES["action_world_model"])
    with pytest.raises(UserError, match="needs a pretrained encoder"):
        check(settled(*task))
    with pytest.raises(UserError, match=r"neither model\.safetensors nor a folder"):
        check(settled(*task, f"model.encoder_from={tmp_path}"))
    check(settled(*task, "pretrain=jepa"))
    with pytest.raises(UserError, match="needs goal_pixels"):
        check(settled(*task, "pretrain=jepa", "env.observations=[pixels,state]"))


def test_no_world_and_no_data(settled) -> None:
    with pytest.raises(UserError, match="dataset"):
        check(settled("env=none"))


def test_one_run_in_a_folder(tmp_path: Path) -> None:
    """The second process is refused while the first one lives."""
    lock_run_dir(tmp_path)
    refused = run_in_fork(lambda: lock_run_dir(tmp_path), tmp_path)
    assert refused.returncode and "another run" in refused.stderr
    fcntl.flock(_LOCKS.pop(), fcntl.LOCK_UN)
    assert run_in_fork(lambda: lock_run_dir(tmp_path), tmp_path).returncode == 0


def test_no_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="checkpoint"):
        load_agent(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "lift"}, "model=tdmpc2 needs state of size 20, with env.task as given it is 28"),
        ({"observations": ["joint_target"]}, "with env.observations as given it is not there"),
        ({"action_mode": "ee_delta"}, "needs action of size 7, with env.action_mode as given it is 3"),
        ({"observations": 5}, "observations"),
        ({"observations": None}, "observations"),
    ],
)
def test_an_environment_that_the_model_cannot_act_in_is_refused_before_it_is_built(
    changes, said: str, monkeypatch
) -> None:
    monkeypatch.setattr(build, "make_evaluation_env", lambda *_, **__: pytest.fail("built"))
    with pytest.raises(UserError) as refused:
        load_agent(AGENT, device="cpu", env_changes=changes)
    assert said in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("env", ["env=lift", "env=multitask"])
def test_what_is_not_named_of_a_group_stays_when_an_environment_is_changed(env: str, settled) -> None:
    """As ``env.randomization.color=0.2`` changes a run: its delay is no less."""
    of = "env.tasks.push" if "multitask" in env else "env"
    run = settled(env, f"{of}.randomization.action_latency=2", "collector.num_envs=8")
    changed = run.env.changed(randomization={"color": 0.2}, fps=20.0).config
    arm = changed.tasks["push"] if "multitask" in env else changed
    assert (arm.randomization.action_latency, arm.randomization.color, arm.fps) == (2, 0.2, 20.0)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["planner=mcts"], "continuous"),
        (["model=muzero"], "discrete actions"),
        (["objective=goal_image"], "goal_pixels"),
        (["model=lewm"], "pixels"),
        (["model=muzero", "planner=mcts", "collector.policy=random"], "planner"),
        (["model=jepa", "env=reach_pixels", "collector.policy=planner"], "random"),
        (["model=lewm", "env=reach_pixels"], "goal_pixels"),
        (["export=lerobot", "export.format=gif"], "gif"),
        (["export=lerobot", "env.episode_length=50"], "whole episode"),
        (["dataset=lerobot", "dataset.root=no/such/folder"], "no/such/folder"),
        (["dataset=lerobot"], "dataset.root"),
        (["objective.metric=l7"], "l7"),
        (["objective.metric=cosine"], "metric=cosine: is of objective=goal_image"),
        (["objective.steps_weight=1"], "steps_weight=1: is of objective=goal_image"),
        (["trainer.precision=int3"], "precision"),
        (["trainer.schedule=up"], "schedule"),
    ],
)
def test_what_does_not_go_together(overrides: list[str], named: str, settled) -> None:
    with pytest.raises(UserError) as caught:
        check(settled(*SMALL, *overrides))
    assert named in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("scale", "horizon"), [("smoke", 2), ("gpu", 5)])
def test_another_planner_is_what_the_runs_scale_has(scale: str, horizon: int, settled) -> None:
    preset = preset_of("cem", settled(f"scale={scale}", "env=reach", "device=cpu"))
    assert (preset["name"], preset["horizon"]) == ("cem", horizon)


@pytest.mark.parametrize("planning", [{"planner.num_samples": 64}, {"num_samples": 64}, {"planner": 64}])
def test_options_of_a_planner_that_are_given_otherwise_end_in_one_line(planning: Any, settled) -> None:
    with pytest.raises(UserError, match=r'must be options of planner or objective, such as \{"planner"'):
        _planning_otherwise(settled("scale=smoke", "device=cpu"), planning)


def test_an_option_that_the_runs_objective_does_not_read_is_refused(settled) -> None:
    run = settled("scale=smoke", "device=cpu")
    with pytest.raises(
        UserError, match=r"metric: is of objective=goal_image, this run has objective=reward_value; "
    ):
        _planning_otherwise(run, {"objective": {"metric": "cosine"}})
    assert _planning_otherwise(run, {"objective": {"action_penalty": 0.1}}).objective.action_penalty == 0.1


def test_weights_of_an_earlier_version_are_said_to_be_that(monkeypatch) -> None:
    monkeypatch.setattr("franka_wm.training.load.sketch", lambda *_: torch.nn.Linear(2, 2))
    with pytest.raises(
        UserError, match="of an earlier version, whose models were others; train anew"
    ) as said:
        load_model(AGENT)
    assert "does not fit this Linear" in str(said.value) and "\n" not in str(said.value)

    def broken(*_: object) -> None:
        raise UserError("weights: is damaged")

    monkeypatch.setattr("franka_wm.training.checkpoint.Checkpoint.check_model", broken)
    with pytest.raises(UserError, match=r"^weights: is damaged$"):
        load_model(AGENT)
