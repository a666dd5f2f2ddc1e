"""Synthetic episodes, quick to make, what reads them back (LeRobot's own code, offline), and a Hub on loopback."""

from __future__ import annotations

import os

os.environ.setdefault("HF_HUB_OFFLINE", "1")  # before anything imports LeRobot

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fake_hub
from franka_wm.data.lerobot.episodes import Episode, complete
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import DONE, EPISODE_KEY, SEED, TRUNCATED, Schema, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.envs import FrankaConfig
from preloaded import Preloaded


@pytest.fixture(scope="session")
def make_schema() -> Callable[..., Schema]:
    """A schema with one camera, state, goal and targets; pictures of 16 × 16."""

    def make(format: str = "exact", size: int = 16, **changes: Any) -> Schema:
        values = {"observations": ("pixels", "state", "joint_target"), "image_size": size} | changes
        return schema_for(FrankaConfig(**values), format=format)

    return make


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., Episode]:
    """An episode of noise; its pictures show a square that moves by a pixel per step over a gradient."""

    def make(schema: Schema, number: int, length: int = 7) -> Episode:
        rng = np.random.default_rng(number)
        rows, terminal = {}, {}
        for name, feature in schema.features.items():
            if name in (SEED, EPISODE_KEY):
                continue
            shape = (length + 1, *feature["shape"])
            if name in schema.images:
                array = moving_square(length + 1, feature["shape"][0], rng)
            elif feature["dtype"] == "bool":
                array = np.zeros(shape, bool)
            else:
                array = rng.normal(size=shape).astype(schema.numpy_dtype(name))
            rows[name] = array[:length].copy()
            if name in schema.observed:
                terminal[name] = array[length]
        rows[DONE][-1] = rows[TRUNCATED][-1] = True
        return complete(rows, terminal, seed=(0, number, 0))

    return make


def moving_square(length: int, size: int, rng: np.random.Generator) -> np.ndarray:
    """(length, size, size, 3) uint8."""
    ramp = np.linspace(30, 200, size)
    picture = np.stack(
        [np.broadcast_to(ramp, (size, size)), np.broadcast_to(ramp[:, None], (size, size))], -1
    )
    picture = np.concatenate([picture, np.full((size, size, 1), 90.0)], -1).astype(np.uint8)
    out = np.repeat(picture[None], length, 0)
    side, start = size // 4, rng.integers(0, size, 2)
    for t in range(length):
        rows = (start[0] + np.arange(side)) % size
        columns = (start[1] + t + np.arange(side)) % size
        out[t][np.ix_(rows, columns)] = (
            rng.integers(0, 255, 3) if t == 0 else out[t - 1, rows[0], (start[1] + t - 1) % size]
        )
    return out


@pytest.fixture(scope="session")
def write() -> Callable[..., Path]:
    """Writes episodes as a dataset, in this process unless ``workers`` says otherwise."""

    def run(out: Path, schema: Schema, episodes: list[Episode], **options: Any) -> Path:
        options = {"workers": 0, "provenance": describe(policy="test", seed=0, config={})} | options
        with DatasetWriter(out, schema, **options) as writer:
            writer.add(episodes)
            return writer.finish()

    return run


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """LeRobot's own reader."""

    def run(root: Path, **options: Any) -> Any:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        return LeRobotDataset("test/set", root=root, video_backend="pyav", **options)

    return run


@pytest.fixture(scope="session")
def one_hub() -> Iterator[fake_hub.Hub]:
    hub = fake_hub.Hub()
    yield hub
    hub.close()


@pytest.fixture
def hub(one_hub: fake_hub.Hub) -> fake_hub.Hub:
    """Empty, at the same address in all tests."""
    one_hub.repos.clear()
    one_hub.requests.clear()
    return one_hub


@pytest.fixture(scope="session")
def clients(one_hub: fake_hub.Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Any]]:
    """Runs the verb where the Hub's client was imported: there it reads the address, and that it is offline."""
    home = str(tmp_path_factory.mktemp("hub"))
    known: dict[tuple[str, bool], Preloaded] = {}

    def run(*arguments: str, url: str, offline: bool, cwd: Path, **variables: str) -> Any:
        if (url, offline) not in known:
            env = {k: v for k, v in os.environ.items() if not k.startswith(("HF_", "HUGGING"))}
            env |= {"HF_ENDPOINT": url, "HF_HOME": home, "HF_HUB_DISABLE_XET": "1"}
            env |= {"HF_HUB_OFFLINE": "1"} if offline else {}
            modules = (
                "franka_wm.data.lerobot.publish",
                "huggingface_hub.hf_api",
                "pyarrow.compute",
                "pandas",
            )
            known[url, offline] = Preloaded(*modules, environment=env)
        return known[url, offline].run("franka_wm.commands.main", *arguments, cwd=cwd, **variables)

    yield run
    for one in known.values():
        one.close()


@pytest.fixture
def publish(hub, clients, tmp_path):
    """Runs the verb in a process of its own."""

    def run(
        *arguments: str, token: str | None = fake_hub.TOKEN, url: str | None = None, offline: bool = False
    ):
        variables = {"HF_TOKEN": token} if token else {}
        return clients("publish", *arguments, url=url or hub.url, offline=offline, cwd=tmp_path, **variables)

    return run
