"""From (worlds, time) batches of a collector or a replay to whole episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from franka_wm.data.lerobot.schema import (
    ACTION,
    DONE,
    EPISODE_KEY,
    REWARD,
    SEED,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Schema,
    episode_key,
)
from franka_wm.errors import UserError
from franka_wm.keys import LOST

if TYPE_CHECKING:  # writing processes unpickle episodes, and need no torch
    import torch
    from tensordict import TensorDictBase

UNKNOWN_EPISODE = -1
"""Number of an episode whose place in its world's history is not known: from a replay, or played by hand."""


@dataclass(frozen=True)
class Episode:
    """One whole episode in memory.

    Attributes:
        rows: Feature → (T, …), one row for each action, for every feature of the schema.
        terminal: Feature → (…): what was observed after the last action, for ``schema.observed``.
    """

    rows: dict[str, np.ndarray]
    terminal: dict[str, np.ndarray]

    @property
    def length(self) -> int:
        """Number of actions, T."""
        return len(next(iter(self.rows.values())))

    @property
    def key(self) -> int:
        """The episode's fingerprint."""
        return int(self.rows[EPISODE_KEY][0, 0])


class EpisodeCutter:
    """Turns consecutive batches into whole episodes, world by world.

    Batches are (worlds, time) and continue one another. An episode starts where ``is_init`` is set and ends where
    ``("next", "done")`` is; its last observation is the true one, from ``next``. What has not ended yet waits for
    the next batch.

    Args:
        schema: What is kept.
        seed: Seed of the run: the first number of the feature ``seed``.
        first_world: Number of the first world of the batches.
        numbered: Whether the first batch begins with each world's first episode, so that the feature ``seed`` says
            which one each is; else it says :data:`UNKNOWN_EPISODE`.
        discrete: Table (number of actions, A) that an integer action is a row of; for continuous actions ``None``.

    Attributes:
        lost: How many episodes were left out since contacts were lost in them: where ``("next", "overflow")`` is set.
    """

    def __init__(
        self,
        schema: Schema,
        *,
        seed: int,
        first_world: int = 0,
        numbered: bool = True,
        discrete: torch.Tensor | None = None,
    ):
        self.schema = schema
        self.seed = seed
        self.first_world = first_world
        self._table = None if discrete is None else discrete.cpu().numpy()
        self._numbered = numbered
        self._numbers: np.ndarray | None = None
        self._open: dict[str, np.ndarray] | None = None
        self.lost = 0

    def push(self, batch: TensorDictBase) -> list[Episode]:
        """The episodes that end in this batch, in order of their end, then world.

        Args:
            batch: (worlds, time), with the schema's observations, ``action``, ``is_init`` and, under ``next``, the
                observations, ``reward``, ``done``, ``terminated``, ``truncated``, ``success``.
        """
        arrays = self._arrays(batch)
        if self._open is not None:
            arrays = {key: np.concatenate([self._open[key], arrays[key]], 1) for key in arrays}
        first = arrays["is_init"][..., 0]
        done = arrays[DONE][..., 0]
        worlds, steps = done.shape
        if self._numbers is None:
            self._numbers = np.zeros(worlds, np.int64)
        # The start of the episode that each step belongs to; -1 before the first start that was seen.
        start = np.maximum.accumulate(np.where(first, np.arange(steps), -1), 1)
        number = self._numbers[:, None] + np.cumsum(first, 1) - 1
        out = []
        for time, world in zip(*np.nonzero(done.T), strict=True):
            begin = start[world, time]
            if begin >= 0 and LOST in arrays and arrays[LOST][world, begin : time + 1].any():
                self.lost += 1
            elif begin >= 0:
                out.append(
                    self._episode(arrays, int(world), int(begin), int(time) + 1, int(number[world, time]))
                )
        # What is still open: from the earliest start that has no end. In other worlds older steps come along; they
        # are cut off by forgetting their start.
        ended = np.where(done.any(1), steps - np.argmax(done[:, ::-1], 1), 0)
        opened = np.where(start[:, -1] >= ended, start[:, -1], steps)
        keep = int(opened.min()) if worlds else steps
        self._numbers = self._numbers + (first & (np.arange(steps) < opened[:, None])).sum(1)
        if keep < steps:
            self._open = {key: array[:, keep:].copy() for key, array in arrays.items()}
            stale = np.arange(keep, steps) < opened[:, None]
            self._open["is_init"][stale] = False
            self._open[DONE][stale] = False
        else:
            self._open = None
        return out

    def _arrays(self, batch: TensorDictBase) -> dict[str, np.ndarray]:
        """Everything that is kept, (worlds, time, …), on the host; ``next`` observations under ``next.KEY``."""

        def host(value: torch.Tensor) -> np.ndarray:
            return value.detach().cpu().numpy()

        out = {}
        for key in {*self.schema.sources.values(), *(key for key, _, _ in self.schema.derived.values())}:
            if batch.get(key, None) is None or batch.get(("next", key), None) is None:
                raise UserError(f"the data has no {key!r}; add it to env.observations")
            out[key], out[f"next.{key}"] = host(batch.get(key)), host(batch.get(("next", key)))
        action = host(batch.get("action"))
        if self._table is not None:
            action = self._table[action]
        out[ACTION] = action
        out["is_init"] = host(batch.get("is_init"))
        if (lost := batch.get(("next", LOST), None)) is not None:
            out[LOST] = host(lost)
        for name in (REWARD, DONE, TERMINATED, TRUNCATED, SUCCESS):
            if name in self.schema.features:
                out[name] = host(batch.get(("next", name.removeprefix("next."))))
        return out

    def _episode(
        self, arrays: dict[str, np.ndarray], world: int, begin: int, end: int, number: int
    ) -> Episode:
        schema = self.schema
        rows, terminal = {}, {}
        for feature, key in schema.sources.items():
            rows[feature] = arrays[key][world, begin:end].copy()
            terminal[feature] = arrays[f"next.{key}"][world, end - 1].copy()
        for feature, (key, low, high) in schema.derived.items():
            rows[feature] = arrays[key][world, begin:end, low:high].copy()
            terminal[feature] = arrays[f"next.{key}"][world, end - 1, low:high].copy()
        for name in (ACTION, REWARD, DONE, TERMINATED, TRUNCATED, SUCCESS):
            if name in arrays:
                rows[name] = arrays[name][world, begin:end].copy()
        number = number if self._numbered else UNKNOWN_EPISODE
        return complete(rows, terminal, seed=(self.seed, self.first_world + world, number))


def complete(
    rows: dict[str, np.ndarray], terminal: dict[str, np.ndarray], *, seed: tuple[int, int, int]
) -> Episode:
    """Adds ``seed`` and ``episode_key`` to an episode's rows.

    Args:
        rows, terminal: As in :class:`Episode`, without those two.
        seed: Seed of the run, world, number of the episode in that world.
    """
    length = len(next(iter(rows.values())))
    rows[SEED] = np.tile(np.array(seed, np.int64), (length, 1))
    rows[EPISODE_KEY] = np.full((length, 1), episode_key(rows), np.int64)
    return Episode(rows, terminal)


def cut_replay(
    data: TensorDictBase,
    schema: Schema,
    *,
    seed: int,
    episode_length: int,
    first_world: int = 0,
    discrete: torch.Tensor | None = None,
) -> tuple[list[Episode], int, int]:
    """Whole episodes of a replay buffer, which may keep no flag for the end by time.

    An episode is whole if its first step is there and it terminated, was truncated or has ``episode_length`` steps.
    The oldest may have lost their start, the newest have not ended; a run that was resumed leaves one without an end.
    Without ``truncated``, so does every episode that was cut short: an object was lost, or a world broke.

    Args:
        data: (worlds, time), oldest step first: observations, ``action``, ``is_init`` and, under ``next``,
            observations, ``reward``, ``terminated``, ``truncated`` if it was kept, ``success`` if the schema has it.
        schema: What is kept.
        seed: Seed of the run.
        episode_length: Steps of the environment's episodes.
        first_world: Number of the first world.
        discrete: As for :class:`EpisodeCutter`.

    Returns:
        The episodes, how many partial ones were left out, and how many in which contacts were lost.
    """
    import torch

    first = data.get("is_init")[..., 0]
    terminated = data.get(("next", "terminated"))[..., 0]
    time = torch.arange(first.shape[1], device=first.device)
    start = torch.where(first, time, -1).cummax(1).values
    age = time - start + 1
    over = terminated | (age == episode_length)
    if (truncated := data.get(("next", "truncated"), None)) is not None:
        over = over | truncated[..., 0]
    if (lost := data.get(("next", LOST), None)) is not None:
        over = over | lost[..., 0]
    whole = (start >= 0) & over
    data = data.clone(recurse=False)
    after = data.get("next").clone(recurse=False)
    after["done"] = whole.unsqueeze(-1)
    after["terminated"] = (whole & terminated).unsqueeze(-1)
    after["truncated"] = (whole & ~terminated).unsqueeze(-1)
    data["next"] = after
    cutter = EpisodeCutter(schema, seed=seed, first_world=first_world, numbered=False, discrete=discrete)
    # Every step of an episode that is not whole belongs to a start without an end, or to none.
    pieces = first.clone()
    pieces[:, :1] = True
    partial = int(pieces.sum()) - int(whole.sum())
    return cutter.push(data), partial, cutter.lost


def tell_lost(verb: str, episodes: int) -> None:
    """Says that episodes were left out for want of room for contacts."""
    from franka_wm.console import say

    if episodes:
        say(f"warning: {verb}: {episodes} episodes lost contacts and were left out; raise env.max_contacts")
