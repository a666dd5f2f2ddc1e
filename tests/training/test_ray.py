"""A run with ``collector=ray``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from forks import TRAIN
from franka_wm.conf import compose
from franka_wm.errors import UserError
from franka_wm.training.check import check
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings

pytest.importorskip("gymnasium")
PENDULUM = ("env=gym", "env.name=Pendulum-v1", "env.episode_length=15", "scale=smoke", "device=cpu")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("env=reach",), "collector=ray: is for env=gym and env=dm_control"),
        (PENDULUM, r"collector=ray: say how many actors .* collector.workers=N, .* collector.num_envs=8"),
        ((*PENDULUM, "collector.workers=3"), "collector.workers=3: cannot share"),
        ((*PENDULUM, "collector.workers=2"), r"collector=ray needs pip install 'franka-wm\[ray\]'"),
    ],
)
def test_refusals_before_anything_is_built(
    words: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=said):
        check(RunSettings.of(compose("scale=smoke", "device=cpu", "collector=ray", *words)))


def test_the_training_worlds_are_rays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    words = (*PENDULUM, "collector=ray", "collector.workers=2")
    with pytest.raises(UserError, match="collector=ray needs"):
        Run(RunSettings.of(compose(*words)), tmp_path).build_environments()


@pytest.mark.slow
def test_actors_and_processes_learn_the_same_weights(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = [*PENDULUM, "collector.workers=2", "evaluation.episodes=2", "evaluation.video_episodes=0"]
    weights = []
    for name in ("policy", "ray"):
        command = [
            sys.executable,
            str(TRAIN),
            *words,
            f"collector={name}",
            f"hydra.run.dir={tmp_path}/{name}",
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=400)
        assert done.returncode == 0, done.stderr
        weights.append(load_file(tmp_path / name / "checkpoints/latest/model.safetensors"))
    one, other = weights
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
