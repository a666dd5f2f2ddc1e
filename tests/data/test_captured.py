"""A captured batch: the same windows, uniformly, also when the buffer has grown since the capture."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.replay import make_replay
from franka_wm.errors import UserError

WORLDS, WINDOW, STEPS = 3, 3, 40
on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def experience(first: int, last: int) -> TensorDict:
    """(WORLDS, steps) whose numbers say where they come from; episodes of 5, 4 and 7 steps."""
    time = torch.arange(first, last).expand(WORLDS, last - first)
    is_init = time % torch.tensor([[5], [4], [7]]) == 0
    world = torch.arange(WORLDS).unsqueeze(1).expand_as(time)
    return TensorDict(
        {"time": time, "world": world, "is_init": is_init.unsqueeze(-1)}, batch_size=[WORLDS, last - first]
    )


class Unrecorded:
    """Stands in for a CUDA graph: a replay does the work again."""

    def __init__(self, work: Any) -> None:
        self.replay = work


class OnTheCpu(CapturedSampling):
    """As on CUDA, but the work is repeated instead of a graph of it."""

    def _record(self, data: Any, sampler: Any) -> Any:
        return Unrecorded(lambda: self._draw(data, sampler))


DEVICES = [
    pytest.param("cpu", OnTheCpu, id="cpu"),
    pytest.param("cuda", CapturedSampling, id="cuda", marks=[pytest.mark.gpu, on_gpu]),
]


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_moved_windows_of_a_growing_buffer(device: str, kind: type[CapturedSampling]) -> None:
    """The buffer ends where an episode has just begun: a window moved into it would go on at its oldest steps."""
    torch.manual_seed(0)
    sizes = {"capacity": WORLDS * STEPS, "num_envs": WORLDS, "window": WINDOW, "batch_size": 256}
    replay = make_replay(**sizes, device=device, moved=True)
    sampling, end = kind(replay), 0
    for until in (22, 40, 66):
        replay.extend(experience(end, until).to(device))
        end = until
        for _ in range(40):
            batch = sampling().to("cpu")
            assert (batch["time"].diff(dim=1) == 1).all() and not batch["is_init"][:, 1:].any()
        replay.sampler.check()


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_steps_before_windows_of_a_growing_buffer(device: str, kind: type[CapturedSampling]) -> None:
    torch.manual_seed(0)
    sizes = {"capacity": WORLDS * STEPS, "num_envs": WORLDS, "window": WINDOW, "batch_size": 256}
    replay = make_replay(**sizes, device=device, moved=True, burn_in=2)
    sampling, end = kind(replay), 0
    for until in (22, 40, 66):
        replay.extend(experience(end, until).to(device))
        end, oldest = until, max(0, until - STEPS)
        for _ in range(4):
            batch = sampling().to("cpu")
            start = batch["time"][:, 2:3]
            assert torch.equal(batch["time"], (start + torch.arange(-2, WINDOW)).clamp_min(oldest))
            repeated = batch["time"].diff(dim=1) == 0
            assert batch["is_init"][:, 1:][repeated].all() and not batch["is_init"][:, 3:].any()


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_windows_of_a_growing_buffer(device: str, kind: type[CapturedSampling]) -> None:
    """Half full, full, wrapped around: every whole window of what is there, equally often, and nothing else."""
    torch.manual_seed(0)
    replay = make_replay(
        capacity=WORLDS * STEPS, num_envs=WORLDS, window=WINDOW, batch_size=256, device=device
    )
    sampling, end = kind(replay), 0
    for until in (20, 40, 63):
        replay.extend(experience(end, until).to(device))
        end = until
        seen: Counter[tuple[int, int]] = Counter()
        for _ in range(40):
            batch = sampling().to("cpu")
            assert (batch["time"].diff(dim=1) == 1).all() and not batch["is_init"][:, 1:].any()
            assert (batch["world"] == batch["world"][:, :1]).all()
            seen.update(zip(batch["world"][:, 0].tolist(), batch["time"][:, 0].tolist(), strict=True))
        replay.sampler.check()
        data = experience(0, until)
        whole = {
            (world, t)
            for world in range(WORLDS)
            for t in range(max(0, until - STEPS), until - WINDOW + 1)
            if not data["is_init"][world, t + 1 : t + WINDOW].any()
        }
        assert set(seen) == whole
        assert chisquare(list(seen.values())).pvalue > 1e-3


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_other_memory_is_captured_anew(device: str, kind: type[CapturedSampling]) -> None:
    """A buffer that lies elsewhere than at the capture is read where it is."""
    sampling = None
    for first in (0, 100):
        replay = make_replay(
            capacity=WORLDS * STEPS, num_envs=WORLDS, window=WINDOW, batch_size=64, device=device
        )
        replay.extend(experience(first, first + 30).to(device))
        if sampling is None:
            sampling = kind(replay)
        sampling.replay = replay
        for _ in range(4):
            time = sampling()["time"]
            assert first <= time.min() and time.max() < first + 30


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_what_cannot_be_filled_is_reported(device: str, kind: type[CapturedSampling]) -> None:
    replay = make_replay(capacity=WORLDS * STEPS, num_envs=WORLDS, window=8, batch_size=64, device=device)
    sampling = kind(replay)
    replay.extend(experience(0, 6).to(device))
    with pytest.raises(UserError, match="collect more first"):
        sampling()
    replay.extend(experience(6, 30).to(device))  # no episode has 8 steps
    for _ in range(4):
        try:
            sampling()
            replay.sampler.check()
        except UserError as error:
            assert "too few episodes" in str(error)
        else:
            pytest.fail("windows across episodes were given out as whole ones")


@pytest.mark.parametrize(("device", "kind"), DEVICES)
def test_eager_calls_draw_what_captured_ones_would(device: str, kind: type[CapturedSampling]) -> None:
    """So a run that resumes, and is eager again at first, goes on with the batches that the first would have had."""
    replay = make_replay(
        capacity=WORLDS * STEPS, num_envs=WORLDS, window=WINDOW, batch_size=64, device=device
    )
    replay.extend(experience(0, 30).to(device))
    sampling = kind(replay)
    for _ in range(4):
        sampling()
    torch.manual_seed(5)
    captured = [sampling()["time"].clone() for _ in range(3)]
    torch.manual_seed(5)
    fresh = kind(replay)
    assert all(torch.equal(fresh()["time"], one) for one in captured)


@pytest.mark.gpu
@on_gpu
def test_a_captured_batch_stays_where_it_is() -> None:
    replay = make_replay(
        capacity=WORLDS * STEPS, num_envs=WORLDS, window=WINDOW, batch_size=64, device="cuda"
    )
    replay.extend(experience(0, 30).to("cuda"))
    sampling = CapturedSampling(replay)
    batches = [sampling() for _ in range(5)]
    assert [sampling.is_static(batch) for batch in batches] == [False, False, True, True, True]
    before = batches[-1]["time"].clone()
    assert sampling() is batches[-1] and not torch.equal(batches[-1]["time"], before)
