"""Datasets that the tests of this folder share; each is made once."""

from __future__ import annotations

import os

os.environ["HF_HUB_OFFLINE"] = "1"  # before LeRobot is imported: it reads this once

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer

from franka_wm.data.lerobot.episodes import EpisodeCutter
from franka_wm.data.lerobot.opening import open_dataset
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import schema_for
from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.data.replay import make_replay
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.policies.scripted import SmoothRandomPolicy


@pytest.fixture(scope="session")
def foreign() -> ModuleType:
    """The module that makes datasets as other people's look."""
    spec = importlib.util.spec_from_file_location("foreign", Path(__file__).with_name("foreign.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def pictures(foreign: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of 5, 4 and 7 rows, two cameras as PNG. Not to be changed: copy it."""
    return foreign.make_foreign(tmp_path_factory.mktemp("foreign") / "pictures")


@pytest.fixture(scope="session")
def video(foreign: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as video. Not to be changed: copy it."""
    return foreign.make_foreign(tmp_path_factory.mktemp("foreign") / "video", video=True)


@pytest.fixture
def opened(tmp_path: Path) -> Callable[..., RecordedWindows]:
    """:func:`open_dataset`, all episodes in one process, with a cache of the test's own, silent."""

    def open_(root: Any, **options: Any) -> RecordedWindows:
        defaults = {
            "window": 2,
            "batch_size": 8,
            "split": "all",
            "workers": 0,
            "cache_dir": tmp_path / "cache",
            "say": lambda line: None,
        }
        return open_dataset(root, **(defaults | options))

    return open_


EPISODE_LENGTH = 6
ARM: dict[str, Any] = {
    "substeps": 2,
    "gravity_compensation": True,
    "goal_sampling": "reachable",
    "observations": ("pixels", "state", "joint_target"),
    "image_size": 64,  # the least that LeRobot's TD-MPC can see
    "episode_length": EPISODE_LENGTH,
}
"""Settings of the arm that the exported datasets were recorded with."""


@dataclass(frozen=True)
class Recorded:
    """Data of this package: as a replay buffer, and exported."""

    replay: ReplayBuffer
    root: Path


@pytest.fixture(scope="session")
def export(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Recorded]:
    """Collects with the arm into a replay and exports it; ``format`` is that of the pictures."""

    def make(format: str = "exact", *, steps: int = 20, worlds: int = 3, window: int = 3) -> Recorded:
        config = FrankaConfig(**ARM)
        env = FrankaEnv(config, num_envs=worlds, device="cpu", seed=1)
        policy = SmoothRandomPolicy(7, generator=torch.Generator().manual_seed(0))
        collector = Collector(
            env, policy, frames_per_batch=steps * worlds, total_frames=steps * worlds, track_traj_ids=False
        )
        batch = next(iter(collector)).clone()
        collector.shutdown()
        replay = make_replay(
            capacity=steps * worlds, num_envs=worlds, window=window, batch_size=8, device="cpu"
        )
        replay.extend(batch)
        schema = schema_for(config, format=format)
        root = tmp_path_factory.mktemp("export") / format
        session = describe(policy="smooth", seed=1, config={"env": {**ARM, "kind": "franka"}})
        with DatasetWriter(root, schema, provenance=session, workers=1) as writer:
            writer.add(EpisodeCutter(schema, seed=1).push(batch))
            writer.finish()
        return Recorded(replay, root)

    return make


@pytest.fixture(scope="session")
def exact(export: Callable[..., Recorded]) -> Recorded:
    """Nine whole episodes of six steps, three worlds, pictures bit for bit."""
    return export("exact")
