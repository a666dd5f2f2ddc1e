"""Frames that were reached later: of the window's episode, written, every one as often, seen from each step."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.future import FutureFrames
from franka_wm.data.replay import WindowReplay, make_replay

LENGTHS, STEPS, WINDOW = torch.tensor([5, 4, 7]), 40, 3


def experience(first: int, last: int) -> TensorDict:
    """(3, steps); vectors and images say when and in which world they were seen; episodes of 5, 4 and 7 steps."""
    time = torch.arange(first, last).expand(3, last - first)
    within, world = time % LENGTHS.unsqueeze(1), torch.arange(3).unsqueeze(1).expand_as(time)

    def seen(step: torch.Tensor) -> dict[str, torch.Tensor]:
        vector = torch.stack((world, time // LENGTHS.unsqueeze(1), step), -1)
        return {"where": vector, "pixels": vector.view(*time.shape, 1, 1, 3).to(torch.uint8)}

    next_ = TensorDict({**seen(within + 1), "reward": time.unsqueeze(-1).float()}, time.shape)
    root = {
        **seen(within),
        "action": within.unsqueeze(-1),
        "is_init": (within == 0).unsqueeze(-1),
        "next": next_,
    }
    return TensorDict(root, time.shape)


class Recorded(CapturedSampling):
    """As on CUDA, but the work is repeated instead of a graph of it."""

    def _record(self, data: Any, sampler: Any) -> Any:
        class Graph:
            replay = staticmethod(lambda: self._draw(data, sampler))

        return Graph()


def filled(until: int) -> WindowReplay:
    future = FutureFrames(episode_length=8)
    replay = make_replay(
        capacity=3 * STEPS, num_envs=3, window=WINDOW, batch_size=256, device="cpu", future=future
    )
    for first in range(0, until, 10):
        replay.extend(experience(first, min(until, first + 10)))
    return replay


@pytest.mark.parametrize("captured", [False, True])
@pytest.mark.parametrize("until", [23, 63])
def test_a_replay_gives_each_later_frame_as_often(until: int, captured: bool) -> None:
    torch.manual_seed(0)
    replay, seen = filled(until), Counter()
    draw = Recorded(replay) if captured else replay.sample
    for _ in range(60):
        batch: Any = draw()
        future = batch["future"]
        assert future.shape == (256, WINDOW)
        assert set(future.keys()) == {"where", "pixels", "steps"}
        assert torch.equal(future["where"].flatten(-1).to(torch.uint8), future["pixels"].flatten(2))
        assert (future["where"][..., :2] == batch["where"][..., :2]).all()  # world and episode
        assert (future["where"] == future["where"][:, :1]).all()
        assert torch.equal(future["steps"][..., 0], future["where"][..., 2] - batch["where"][..., 2])
        end, found = batch["next", "where"][:, -1], future["where"][:, 0, 2]
        seen.update(map(tuple, torch.cat((end, found.unsqueeze(1)), 1).tolist()))
    ends: dict[tuple[int, ...], list[int]] = {}
    for (*end, found), count in seen.items():
        assert end[2] <= found
        ends.setdefault(tuple(end), []).append(count)
    for (world, episode, step), counts in ends.items():
        length = int(LENGTHS[world])
        left = min(length, until - episode * length) - step + 1  # the last episode may have begun just now
        assert len(counts) == left, (world, episode, step)
        assert left == 1 or chisquare(counts).pvalue > 1e-5


def test_without_it_batches_are_windows_alone() -> None:
    replay = make_replay(capacity=120, num_envs=3, window=WINDOW, batch_size=8, device="cpu")
    replay.extend(experience(0, 30))
    assert "future" not in replay.sample().keys()  # noqa: SIM118
