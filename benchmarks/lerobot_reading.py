"""Windows per second from the cache of a LeRobot dataset, beside LeRobot's own reader and a replay buffer.

python benchmarks/lerobot_reading.py [--episodes 40] [--window 8] [--batch-size 64] [--out results.json]

The dataset is recorded with the arm: 64 × 64 images (exact), state, action. All readers give windows of H
transitions, H + 1 images each; LeRobot's ``__getitem__`` with ``delta_timestamps``, one by one in random order.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["HF_HUB_OFFLINE"] = "1"
sys.path.append(sys.path.pop(0))  # this folder last: `lerobot` is the package, not the script beside this one

from common import publish, rate

from franka_wm.data.replay import make_replay
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.policies.scripted import SmoothRandomPolicy


def record(folder: Path, episodes: int, format: str, window: int, batch_size: int) -> tuple[Path, Any]:
    """A dataset of episodes of 50 steps, and a replay buffer with the same steps."""
    from torchrl.collectors import Collector

    from franka_wm.data.lerobot.episodes import EpisodeCutter
    from franka_wm.data.lerobot.provenance import describe
    from franka_wm.data.lerobot.schema import schema_for
    from franka_wm.data.lerobot.writer import DatasetWriter

    config = FrankaConfig(
        observations=("pixels", "state"), goal_sampling="reachable", substeps=4, episode_length=50
    )
    env = FrankaEnv(config, num_envs=episodes, device="cpu")
    collector = Collector(
        env,
        SmoothRandomPolicy(7),
        frames_per_batch=50 * episodes,
        total_frames=50 * episodes,
        track_traj_ids=False,
    )
    batch = next(iter(collector)).clone()
    collector.shutdown()
    env.close()
    schema = schema_for(config, format=format)
    with DatasetWriter(
        folder / format, schema, provenance=describe(policy="smooth", seed=0, config={})
    ) as writer:
        writer.add(EpisodeCutter(schema, seed=0).push(batch))
        writer.finish()
    replay = make_replay(
        capacity=50 * episodes, num_envs=episodes, window=window, batch_size=batch_size, device="cpu"
    )
    keys = ["pixels", "state", "action", "is_init"]
    replay.extend(batch.select(*keys, *[("next", k) for k in ("pixels", "state", "reward", "terminated")]))
    return folder / format, replay


def theirs(root: Path, window: int) -> float:
    """Windows per second of ``LeRobotDataset.__getitem__``."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    fps = 30
    steps = [t / fps for t in range(window + 1)]
    dataset = LeRobotDataset(
        "me/benchmark",
        root=root,
        delta_timestamps={
            "observation.images.front": steps,
            "observation.state": steps,
            "action": steps[:-1],
            "next.reward": steps[:-1],
        },
    )
    numbers = random.Random(0)
    return rate(lambda: dataset[numbers.randrange(len(dataset))], warmup=5)


def reading(*, episodes: int = 40, window: int = 8, batch_size: int = 64) -> list[dict[str, Any]]:
    """The rows of the table."""
    from franka_wm.data.lerobot import open_dataset

    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        root, replay = record(folder, episodes, "exact", window, batch_size)
        base = theirs(root, window)

        def add(name: str, rate_: float, unit: str = "windows/s") -> None:
            times = f"{rate_ / base:.0f} ×" if unit == "windows/s" else ""
            rows.append({"reader": name, "rate": rate_, "unit": unit, "beside __getitem__": times})

        add("LeRobotDataset.__getitem__", base)
        for workers in (1, 2):
            cache_dir = folder / f"cache-{workers}"
            started = time.perf_counter()
            open_dataset(
                root,
                window=window,
                batch_size=batch_size,
                keys=["pixels", "state"],
                cache_dir=cache_dir,
                workers=workers,
                say=lambda line: None,
            )
            add(
                f"building the cache, {workers} processes (start included)",
                50 * episodes / (time.perf_counter() - started),
                "rows/s",
            )
        for in_memory in (True, False):
            windows = open_dataset(
                root,
                window=window,
                batch_size=batch_size,
                split="all",
                keys=["pixels", "state"],
                cache_dir=folder / "cache-1",
                in_memory=in_memory,
                say=lambda line: None,
            )
            where = "memory" if in_memory else "memory-mapped files"
            add(f"cache, {where}, batches of {batch_size}", batch_size * rate(windows.sample))
        add("replay buffer", batch_size * rate(replay.sample))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=40, help="of 50 steps")
    parser.add_argument("--window", type=int, default=8)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--out")
    options = parser.parse_args()
    rows = reading(episodes=options.episodes, window=options.window, batch_size=options.batch_size)
    publish("reading a LeRobot dataset", rows, options.out, device="cpu")


if __name__ == "__main__":
    main()
