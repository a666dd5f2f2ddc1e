"""A policy acts in many worlds at once, and its episodes go straight into a dataset."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.console import count, duration, say
from franka_wm.data.lerobot.episodes import Episode, EpisodeCutter
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import SEED, SUCCESS, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter, default_shard_frames
from franka_wm.errors import UserError
from franka_wm.interrupt import interruptible
from franka_wm.seeding import derive_seed

BATCH = 8192
"""Steps of all worlds in one batch of the collector, about."""

HOPELESS = 200
"""Episodes without a success after which ``success_only`` gives up."""


@dataclass
class Source:
    """Who acts where.

    Attributes:
        env: The worlds.
        policy: Writes ``action``.
        config: The resolved configuration, plain.
        name: Name of the policy, for the dataset's provenance.
        seed: Seed of the run.
    """

    env: Any
    policy: Any
    config: dict[str, Any]
    name: str
    seed: int


def gather(
    source: Source,
    *,
    out: str | Path,
    episodes: int,
    format: str = "exact",
    workers: int = 2,
    shard_frames: int | None = None,
    resume: bool = False,
    success_only: bool = False,
    every: float = 10.0,
) -> tuple[Path, bool]:
    """Runs the policy until there are so many episodes, and writes them.

    Every world contributes the same number of episodes (one more or less), its first ones: whoever ends early
    does not fill the dataset with short episodes.

    Args:
        source: Who acts where. The worlds' seed is derived from ``seed`` and the number of episodes that are there
            already; the feature ``seed`` says it.
        out, workers, shard_frames, resume: As for :class:`~franka_wm.data.lerobot.writer.DatasetWriter`.
        episodes: In all.
        format: Format of images.
        success_only: Keep only episodes that end in success.
        every: Seconds between lines of progress.

    Returns:
        The dataset's folder, and whether all episodes are there (not after Ctrl-C).

    Raises:
        UserError: One line; with ``success_only`` also where none of the first episodes succeeds.
    """
    from torchrl.collectors import Collector

    base = getattr(source.env, "base_env", source.env)
    schema = schema_for(base.config, format=format)
    worlds, length = base.num_envs, base.config.episode_length
    if shard_frames is None and workers:  # few episodes: still something for every process to do
        shard_frames = min(default_shard_frames(schema), -(-episodes * length // workers))
    provenance = describe(policy=source.name, seed=source.seed, config=source.config)
    with DatasetWriter(
        out,
        schema,
        provenance=provenance,
        workers=workers,
        shard_frames=shard_frames,
        resume=resume,
    ) as writer:
        left = episodes - writer.resumed
        if left <= 0:
            say(f"{writer.resumed} episodes are there already")
            return writer.finish(), True
        writer.start()
        seed = derive_seed("collection", source.seed, writer.resumed)
        source.env.set_seed(seed)
        chosen = _Choice(np.full(worlds, left // worlds) + (np.arange(worlds) < left % worlds), success_only)
        cutter = EpisodeCutter(schema, seed=seed, discrete=_table(source.env))
        collector = Collector(
            source.env,
            source.policy,
            frames_per_batch=worlds * max(1, min(length, BATCH // worlds)),
            total_frames=-1,
            track_traj_ids=False,
            no_cuda_sync=True,
            trust_policy=True,
        )
        started = said = time.perf_counter()
        before, steps = writer.episodes, 0
        with interruptible() as stop:
            batches = iter(collector)
            while writer.episodes < episodes and not stop():
                batch = next(batches)
                steps += batch.numel()
                writer.add(episode for episode in cutter.push(batch) if chosen.takes(episode))
                now = time.perf_counter()
                if now - said >= every or writer.episodes >= episodes:
                    rate = (writer.episodes - before) / (now - started)
                    rest = f"   left {duration((episodes - writer.episodes) / rate)}" if rate else ""
                    say(
                        f"episodes {writer.episodes}/{episodes}   steps {count(steps)} "
                        f"({count(steps / (now - started))}/s){rest}"
                    )
                    said = now
            whole = writer.episodes >= episodes
        collector.shutdown()
        return writer.finish(), whole


class _Choice:
    """The first episodes of each world, or the first that succeed.

    Args:
        quota: (worlds,) how many of each.
        success_only: Whether others do not count.
    """

    def __init__(self, quota: np.ndarray, success_only: bool):
        self._left, self._success_only = quota.copy(), success_only
        self._seen = self._taken = 0

    def takes(self, episode: Episode) -> bool:
        """Whether this one is kept; called for all in the order of their ends."""
        self._seen += 1
        if self._success_only and not episode.rows[SUCCESS][-1, 0]:
            if self._seen >= HOPELESS and not self._taken:
                raise UserError(
                    f"collect: none of {self._seen} episodes succeeded; success_only=true would never end: "
                    "take another policy, or success_only=false"
                )
            return False
        world = episode.rows[SEED][0][1]
        if self._left[world] <= 0:
            return False
        self._left[world] -= 1
        self._taken += 1
        return True


def _table(env: Any) -> Any:
    """The actions of an environment with discrete ones, a row each."""
    if env.action_spec.dtype.is_floating_point:
        return None
    return env.transform.table
