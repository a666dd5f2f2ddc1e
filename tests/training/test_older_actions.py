"""Discrete actions that an earlier version numbered otherwise are refused, and never taken for those of now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import franka_wm
from franka_wm.commands import main as cli
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.checkpoint import save_checkpoint
from franka_wm.training.load import load_agent
from franka_wm.training.spaces import Spaces

SAID = "has 17 discrete actions, of an earlier version; with a gripper there are 30 now"


@pytest.fixture
def older(settled: Callable, tiny: list[str], tmp_path: Path) -> Path:
    """A checkpoint of `env=lift`, as it was when a move had no command for the fingers."""
    run = settled(*tiny[:3], "env=lift", "model=muzero", "planner=gumbel", "model.latent_dim=16")
    spaces = replace(Spaces.of_config(run.env.arm, discrete=True), num_actions=17)
    return save_checkpoint(
        tmp_path / "older" / "checkpoints" / "latest",
        model=build.make_model(run, spaces, "cpu"),
        config=run.values,
        counters={"updates": 3, "env_steps": 24, "seconds": 1.0},
        replay=TensorDict({"action": torch.zeros(1, 4, dtype=torch.int64)}, batch_size=[1, 4]),
        extra={"rows": {}, "spaces": spaces.as_dict()},
    )


def test_nobody_acts_with_them(older: Path, monkeypatch) -> None:
    monkeypatch.setattr(build, "make_evaluation_env", lambda *_, **__: pytest.fail("built"))
    with pytest.raises(UserError, match=SAID):
        load_agent(older, device="cpu")
    assert franka_wm.load(str(older)).num_actions == 17  # the model alone


def test_no_run_goes_on_from_them(older: Path, train: Callable, capsys, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no checkpoint"):  # of this run: nothing was written
        train(f"resume={older}", folder=tmp_path / "second", status=1)
    assert SAID in capsys.readouterr().err


def test_they_are_not_exported(older: Path, capsys, tmp_path: Path) -> None:
    assert cli.main(["export", f"source={older}", f"out={tmp_path}/set"]) == 1
    assert SAID in capsys.readouterr().err and not (tmp_path / "set").exists()
