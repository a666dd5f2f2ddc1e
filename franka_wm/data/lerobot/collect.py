"""A policy acts in many worlds at once, and its episodes go straight into a dataset."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.console import count, duration, say
from franka_wm.data.lerobot.episodes import Episode, EpisodeCutter, tell_lost
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import SEED, SUCCESS, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter, default_shard_frames
from franka_wm.errors import UserError
from franka_wm.interrupt import interruptible
from franka_wm.seeding import derive_seed, drawing_for, seeded

BATCH = 8192
"""Steps of all worlds in one batch of the collector, about."""

HOPELESS = 200
"""Episodes without a success after which ``success_only`` gives up."""


@dataclass
class Gatherer:
    """Who acts where.

    Attributes:
        env: The worlds; of several processes, this one's.
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
    source: Gatherer,
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

    Each process of a job calls this with worlds of its own. World k of the job plays the same episodes, and its policy
    draws the same numbers, whatever the number of processes; they gather batch by batch together.

    Every world contributes the same number of episodes (one more or less), its first ones: whoever ends early
    does not fill the dataset with short episodes.

    Args:
        source: Who acts where. The worlds' seed is derived from ``seed`` and the number of episodes that are there
            already, and so is the policy's where there are any; the feature ``seed`` says it.
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

    from franka_wm import processes
    from franka_wm.envs.transformed import arm_of

    base = arm_of(source.env)
    assert base is not None
    numbers = processes.objects(base.num_envs)
    first, whole_job = sum(numbers[: processes.rank()]), sum(numbers)
    schema = schema_for(base.config, format=format)
    worlds, length = base.num_envs, base.config.episode_length
    if shard_frames is None and workers:  # few episodes: still something for every process to do
        shard_frames = min(default_shard_frames(schema), -(-episodes * length // (workers * len(numbers))))
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
        base.simulation.set_first_world(first)
        source.env.set_seed(seed)
        quota = np.full(whole_job, left // whole_job) + (np.arange(whole_job) < left % whole_job)
        chosen = _Choice(quota, success_only)
        wanted = int(quota[first : first + worlds].sum())
        cutter = EpisodeCutter(schema, seed=seed, first_world=first, discrete=_table(source.env))
        again = (source.policy,) if writer.resumed else ()  # else it would draw the first session's numbers
        # From here on: a collector tries its policy. Planners draw from torch's generator.
        with interruptible() as stop, seeded(seed, *again), drawing_for(first, worlds, whole_job):
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
            done, steps, lost, stopped = 0, 0, 0, False
            batches = iter(collector)
            while done < left and not stopped:
                if chosen.taken < wanted:
                    batch = next(batches)
                    steps += batch.numel()
                    writer.add(episode for episode in cutter.push(batch) if chosen.takes(episode))
                told = processes.objects(
                    (chosen.taken, chosen.seen, chosen.steps, steps, cutter.lost, stop())
                )
                done, seen, kept, played, lost, stopped = (sum(one) for one in zip(*told, strict=True))
                if lost >= HOPELESS and not seen:
                    raise UserError(
                        f"collect: all of {lost} episodes lost contacts, for want of room; raise env.max_contacts"
                    )
                if success_only and seen >= HOPELESS and not done:
                    raise UserError(
                        f"collect: none of {seen} episodes succeeded; success_only=true would never end: "
                        "take another policy, or success_only=false"
                        + (f"; {lost} others lost contacts, env.max_contacts" if lost else "")
                    )
                now = time.perf_counter()
                if now - said >= every or done >= left:
                    rate = done / (now - started)
                    rest = f"   left {duration((left - done) / rate)}" if rate else ""
                    say(
                        f"episodes {writer.resumed + done}/{episodes}   steps {count(kept)} kept, "
                        f"{count(played)} played ({count(played / (now - started))}/s){rest}"
                    )
                    said = now
            collector.shutdown()
            tell_lost("collect", lost)
            # A signal must not leave it half-written, so still within.
            return writer.finish(), done >= left


class _Choice:
    """The first episodes of each world, or the first that succeed.

    Args:
        quota: (worlds,) how many of each, of the whole job.
        success_only: Whether others do not count.

    Attributes:
        seen, taken: How many episodes it was asked for, and how many it took.
        steps: How many the episodes have that it took.
    """

    def __init__(self, quota: np.ndarray, success_only: bool):
        self._left, self._success_only = quota.copy(), success_only
        self.seen = self.taken = self.steps = 0

    def takes(self, episode: Episode) -> bool:
        """Whether this one is kept; called for all in the order of their ends."""
        self.seen += 1
        if self._success_only and not episode.rows[SUCCESS][-1, 0]:
            return False
        world = episode.rows[SEED][0][1]
        if self._left[world] <= 0:
            return False
        self._left[world] -= 1
        self.taken += 1
        self.steps += episode.length
        return True


def _table(env: Any) -> Any:
    """The actions of an environment with discrete ones, a row each."""
    if env.action_spec.dtype.is_floating_point:
        return None
    return env.transform.table
