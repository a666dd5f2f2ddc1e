"""What tests of whole runs share."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

from franka_wm.envs import FrankaEnv
from franka_wm.report import end_of_run, page
from franka_wm.training import build
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.learner import Learner
from franka_wm.training.settings import RunSettings
from franka_wm.training.trainer import Trainer

TINY = [
    "scale=smoke",
    "device=cpu",
    "env.substeps=1",
    "env.episode_length=8",
    "collector.num_envs=3",
    "evaluation.episodes=2",
    "evaluation.video_episodes=0",
    "logger=none",
    "planner.num_samples=8",
    "planner.num_elites=4",
]

Train = Callable[..., Checkpoint]

N, CAPACITY = 4, 50
"""Worlds of the trainer that `make` builds, and steps of each in its replay."""

Make = Callable[..., Trainer]


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Overrides for a run of seconds."""
    return TINY


@pytest.fixture
def train(root: Path, tmp_path: Path, monkeypatch) -> Train:
    """``python train.py`` in this process, with tiny sizes; returns the run's last checkpoint.

    Its curves and its page are not drawn, which takes as long as the run itself.
    """
    monkeypatch.setattr(end_of_run, "plot_learning_curves", lambda *_, **__: None)
    monkeypatch.setattr(page, "write_page", lambda folder: folder / "report.html")

    def train(*arguments: str, folder: Path = tmp_path / "run", status: int | None = None) -> Checkpoint:
        given = {argument.split("=", 1)[0] for argument in arguments}
        if {"env=gym", "env=none", "env=multitask"} & {*arguments}:  # options of the arm are none of theirs
            given |= {one.split("=", 1)[0] for one in TINY if one.startswith("env.")}
        sizes = [] if "resume" in given else [one for one in TINY if one.split("=", 1)[0] not in given]
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(
            sys, "argv", [str(root / "train.py"), *sizes, *arguments, f"hydra.run.dir={folder}"]
        )
        GlobalHydra.instance().clear()
        if status is None:
            runpy.run_path(str(root / "train.py"), run_name="__main__")
        else:
            with pytest.raises(SystemExit) as caught:
                runpy.run_path(str(root / "train.py"), run_name="__main__")
            assert caught.value.code == status
        return load_checkpoint(latest_checkpoint(folder))

    return train


# -- a trainer in this process ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cfg(settled) -> RunSettings:
    return settled(
        "scale=smoke",
        "device=cpu",
        "env.substeps=1",
        "env.episode_length=7",
        f"collector.num_envs={N}",
        f"replay.capacity={CAPACITY * N}",
        "trainer.updates=20",
        "logger=none",
        "evaluation.every=1000",
    )


@pytest.fixture(scope="module")
def env(cfg: RunSettings) -> FrankaEnv:
    return build.make_env(cfg)


@pytest.fixture
def make(cfg: RunSettings, env: FrankaEnv, tmp_path: Path) -> Make:
    def make(folder: str = "run", evaluate=dict, model=(), cfg=cfg, env=env, **changes) -> Trainer:
        mine = cfg.changed(trainer=changes, model=dict(model))
        torch.manual_seed(0)
        env.set_seed(0)
        built = build.make_model(mine, env)
        return Trainer(
            env=env,
            learner=Learner(built),
            replay=build.make_replay_buffer(mine, env.device),
            policies=build.make_policies(built, build.make_planner(mine, env.action_dim), env),
            actor="policy",
            settings=mine,
            spaces=build.Spaces.of_env(env),
            folder=tmp_path / folder,
            loggers=[],
            evaluate=evaluate,
        )

    return make
