"""Demonstrations that were recorded in other worlds than the run's: what is refused, what is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from franka_wm.commands import main as cli
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError
from franka_wm.training.demos import check_demonstrations, open_demonstrations
from franka_wm.training.spaces import Spaces

PUSH = ("env=push", "env.substeps=1", "env.episode_length=8", "seed=0", "device=cpu")


@pytest.fixture
def pushes(tmp_path: Path) -> Path:
    root = tmp_path / "push"
    assert cli.main(["collect", f"out={root}", "policy=expert", "episodes=2", "num_envs=2", *PUSH]) == 0
    return root


def test_other_physics_are_said(pushes: Path, settled, capsys) -> None:
    words = ("scale=smoke", *PUSH, "evaluation.during=[]", f"replay.demos={pushes}")
    capsys.readouterr()
    check_demonstrations(settled(*words))
    assert capsys.readouterr().out == ""
    check_demonstrations(settled(*words, "env.substeps=2"))
    line = "recorded with env.substeps=1, this run has 2; what its actions do is as recorded"
    assert capsys.readouterr().out.strip() == f"replay.demos={pushes}: {line}"


def test_states_of_other_objects_are_refused_whatever_the_dataset_says(pushes: Path, settled) -> None:
    """One body's numbers for two, of which the model reads none: the worlds would begin anywhere."""
    (pushes / PROVENANCE).unlink()
    words = ("scale=smoke", "env=stack", *PUSH[1:], "evaluation.during=[]", f"replay.demos={pushes}")
    run = settled(*words, "model.observations=[state,goal]", "replay.demo_resets=0.5")
    check_demonstrations(run)
    with pytest.raises(UserError, match="objects has size 13 there, 26 in this environment"):
        open_demonstrations(run, Spaces.of_config(run.env.arm), None)
