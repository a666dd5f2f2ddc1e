"""A tiny trained agent, once for all tests of this room."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from franka_wm.models import WorldModel
from franka_wm.training.load import Agent, load_agent

SMOKE = [
    "scale=smoke",
    "device=cpu",
    "env.episode_length=12",
    "env.substeps=2",
    "collector.num_envs=4",
    "evaluation.episodes=2",
    "evaluation.video_episodes=0",
    "logger=none",
]


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory, root: Path) -> Path:
    """The folder of a finished smoke run."""
    place = tmp_path_factory.mktemp("agent")
    command = [sys.executable, str(root / "train.py"), *SMOKE, f"hydra.run.dir={place}/run"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return place / "run"


@pytest.fixture(scope="session")
def agent(run_folder: Path) -> Agent:
    """That run's agent in six worlds."""
    return load_agent(run_folder, num_envs=6, device="cpu", seed=0)


class PointModel(WorldModel):
    """A model that is exact for points that move as their actions say: z' = z + a."""

    observation_sizes = {"position": 2}
    action_dim, latent_dim = 2, 2

    def encode(self, observation):
        return observation.get("position")

    def next(self, z, action):
        return z + action


@pytest.fixture
def point_model() -> PointModel:
    return PointModel()
