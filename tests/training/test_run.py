"""A run's worlds: which processes they have, and what is asked before they are built."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest

from franka_wm.conf import compose
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings


@pytest.mark.parametrize("parallel", [False, True])
def test_worlds_of_other_libraries_have_processes_of_their_own_if_asked(
    parallel: bool, tmp_path: Path
) -> None:
    """Those of training alone: the evaluation's worlds step in this one."""
    words = (
        "env=gym",
        "collector.num_envs=2",
        "evaluation.episodes=2",
        f"collector.parallel={str(parallel).lower()}",
    )
    before = set(multiprocessing.active_children())
    settings = RunSettings.of(compose("scale=smoke", "device=cpu", *words))
    env, eval_env = Run(settings, tmp_path).build_environments()
    assert env is not None and eval_env is not None
    try:
        assert len(set(multiprocessing.active_children()) - before) == (2 if parallel else 0)
    finally:
        env.close()
        eval_env.close()


def test_recorded_data_are_opened_before_worlds_are_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What is wrong with them is a line in seconds, not after minutes of compiling."""

    def opened(*_: object) -> None:
        raise UserError("damaged")

    monkeypatch.setattr(build, "open_recorded", opened)
    monkeypatch.setattr(build, "make_evaluation_env", lambda *_: pytest.fail("built"))
    arguments = ("scale=smoke", "device=cpu", "dataset=lerobot", "dataset.root=there", "trainer=offline")
    with pytest.raises(UserError, match="damaged"):
        Run(RunSettings.of(compose(*arguments)), tmp_path).build_environments()
