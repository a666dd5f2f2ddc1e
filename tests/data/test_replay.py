"""Windows: contiguous, of one episode, uniform over all there are; also when the buffer wraps around."""

from __future__ import annotations

import logging
import warnings
from collections import Counter
from types import SimpleNamespace
from unittest import mock

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from franka_wm.data.replay import OVERFLOW, WindowSampler, make_replay, newest_step
from franka_wm.errors import UserError

WORLDS = 3


def experience(steps: int, *, start: int = 0, lengths: tuple[int, ...] = (5, 3, 7)) -> TensorDict:
    """(WORLDS, steps) whose numbers say where they come from; world k has episodes of ``lengths[k]`` steps."""
    time = torch.arange(start, start + steps).expand(len(lengths), steps)
    length = torch.tensor(lengths).unsqueeze(1)
    data = {
        "time": time,
        "world": torch.arange(len(lengths)).unsqueeze(1).expand_as(time),
        "episode": time // length,
        "is_init": time % length == 0,
        "state": torch.stack([time, time * 10], -1).float(),
        "next": TensorDict(
            {"state": torch.stack([time + 1, time * 10 + 1], -1).float(), "done": (time + 1) % length == 0},
            batch_size=time.shape,
        ),
    }
    data["is_init"] = data["is_init"].unsqueeze(-1)
    return TensorDict(data, batch_size=time.shape)


def buffer(steps: int, window: int, batch_size: int = 64, *, cross_episode: bool = False) -> ReplayBuffer:
    return make_replay(
        capacity=steps * WORLDS,
        num_envs=WORLDS,
        window=window,
        batch_size=batch_size,
        device="cpu",
        cross_episode=cross_episode,
    )


def whole_windows(first: int, last: int, window: int) -> set[tuple[int, int]]:
    """(world, first step) of every window of one episode within steps [first, last)."""
    data = experience(last)
    return {
        (world, t)
        for world in range(WORLDS)
        for t in range(first, last - window + 1)
        if data["episode"][world, t] == data["episode"][world, t + window - 1]
    }


@pytest.mark.parametrize(("window", "length"), [(4, 12), (6, 9), (8, 8)])
def test_moved_windows_show_the_ends_of_episodes_oftener(window: int, length: int) -> None:
    """A third as often as any step, at least, also where the buffer has wrapped around; else they are in one window."""
    torch.manual_seed(0)
    lengths, steps = (length,) * WORLDS, 40 * length
    options = {"capacity": steps * WORLDS, "num_envs": WORLDS, "window": window, "device": "cpu"}
    replay = make_replay(**options, batch_size=600, episode_length=length, moved=True)  # type: ignore[arg-type]
    replay.extend(experience(steps, lengths=lengths))
    replay.extend(
        experience(5 * length + 1, start=steps, lengths=lengths)
    )  # by a number of episodes that is not whole
    seen = torch.zeros(length)
    for _ in range(40):
        sample = replay.sample()
        assert (sample["episode"] == sample["episode"][:, :1]).all()
        assert (sample["time"] == sample["time"][:, :1] + torch.arange(window)).all()
        assert (sample["time"] > 5 * length).all()
        seen += (sample["time"] % length).flatten().bincount(minlength=length)
    # A half of the windows across each end is moved to either side of it.
    starts = torch.arange(length)
    over = (starts + window - length).clamp_min(0)  # steps in the next episode
    moved = torch.where(2 * (window - over) <= window, 0, length - window)
    start = torch.where(over > 0, moved, starts)
    expected = (start.unsqueeze(1) + torch.arange(window)).flatten().bincount(minlength=length)
    assert expected.min() >= 0.3 * expected.max()
    share = expected / expected.sum()
    assert (seen / seen.sum() - share).abs().max() < 0.1 * share.min()


def test_a_graph_moves_windows_by_tensors_alike() -> None:
    replay = make_replay(capacity=300, num_envs=WORLDS, window=4, batch_size=9, device="cpu", moved=True)
    replay.extend(experience(100, lengths=(9,) * WORLDS))
    sampler, storage = replay.sampler, replay.storage
    assert isinstance(sampler, WindowSampler)
    span, oldest = sampler.bounds(storage)
    draw = torch.randint(span * WORLDS, (sampler.candidates(9),))
    held = torch.tensor(oldest), torch.tensor(span * WORLDS, dtype=torch.float64) / WORLDS
    found = [sampler.choose(storage._storage, draw, *one, 9) for one in ((oldest, span), held)]  # type: ignore[union-attr]
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))  # type: ignore[arg-type]


@pytest.mark.parametrize("window", [1, 2, 3])
@pytest.mark.parametrize(("total", "chunk"), [(21, 7), (40, 8), (63, 9), (67, 5)])
def test_windows(window: int, total: int, chunk: int) -> None:
    """A buffer of 40 steps: half full, full, wrapped once, wrapped in the middle of a chunk."""
    torch.manual_seed(0)
    replay = buffer(40, window, 400)
    gathered = 0
    while gathered < total:
        steps = min(chunk, total - gathered)
        replay.extend(experience(steps, start=gathered))
        gathered += steps
    expected = whole_windows(max(0, total - 40), total, window)
    counts: Counter[tuple[int, int]] = Counter()
    for _ in range(60):
        sample = replay.sample()
        assert sample.batch_size == (400, window)
        assert (sample["time"] == sample["time"][:, :1] + torch.arange(window)).all()
        assert (sample["world"] == sample["world"][:, :1]).all()
        assert (sample["episode"] == sample["episode"][:, :1]).all()
        assert (sample["state"][..., 1] == 10 * sample["time"]).all()
        assert (sample["next", "state"][..., 0] == sample["time"] + 1).all()
        counts.update(zip(sample["world"][:, 0].tolist(), sample["time"][:, 0].tolist(), strict=True))
    # All of them, nothing else; the last transition of every episode among them; equally often.
    assert set(counts) == expected
    assert chisquare([counts[w] for w in sorted(expected)]).pvalue > 1e-3


@pytest.mark.parametrize("total", [9, 31])
def test_steps_before_a_window_come_with_it(total: int) -> None:
    """Those that are not kept, any more or yet, are the oldest one, where a memory begins anew."""
    sizes = {"capacity": 12 * WORLDS, "num_envs": WORLDS, "window": 3, "batch_size": 64, "device": "cpu"}
    replay = make_replay(**sizes, burn_in=4, moved=True)  # type: ignore[arg-type]
    for first in range(0, total, 7):
        replay.extend(experience(min(7, total - first), start=first))
    kept, seen = max(0, total - 12), 0
    batch = replay.sample()
    assert batch.shape == (64, 7)
    for time, world, is_init in zip(batch["time"], batch["world"][:, 0], batch["is_init"], strict=True):
        start = int(time[4])
        assert time.tolist() == [max(start - k, kept) for k in (4, 3, 2, 1)] + [start, start + 1, start + 2]
        begins = [t % (5, 3, 7)[world] == 0 for t in time.tolist()]
        stood_for = [k > 0 and start + k - 4 <= kept for k in range(7)]
        assert [*is_init[1:].flatten()] == [a or b for a, b in zip(begins[1:], stood_for[1:], strict=True)]
        seen += start < kept + 4
    assert seen  # some windows start among the oldest steps


def test_every_last_transition_can_be_sampled() -> None:
    torch.manual_seed(0)
    replay = buffer(40, 3, 500)
    replay.extend(experience(35))
    seen = set()
    for _ in range(20):
        sample = replay.sample()
        ends = sample["next", "done"][:, -1]
        seen |= set(zip(sample["world"][ends, -1].tolist(), sample["time"][ends, -1].tolist(), strict=True))
        assert not sample["next", "done"][:, :-1].any()
    data = experience(35)
    assert seen == {(w, t) for w, t in data["next", "done"].nonzero().tolist()}


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("window", [1, 3])
def test_no_window_has_a_step_that_lost_contacts(window: int, across: bool) -> None:
    """All others are drawn, equally often."""
    torch.manual_seed(0)
    options = dict(num_envs=WORLDS, batch_size=200, device="cpu", cross_episode=across, marks=True)
    replay = make_replay(capacity=40 * WORLDS, window=window, **options)
    data = experience(35)
    lost = torch.zeros(WORLDS, 35, 1, dtype=torch.bool)
    lost[0, 4] = lost[1, 20:22] = True
    replay.extend(data.set(OVERFLOW, lost))
    every = {(world, t) for world in range(WORLDS) for t in range(35 - window + 1)}
    expected = every if across else whole_windows(0, 35, window)
    expected = {(w, t) for w, t in expected if not lost[w, t : t + window].any()}
    counts: Counter[tuple[int, int]] = Counter()
    for _ in range(60):
        sample = replay.sample()
        counts.update(zip(sample["world"][:, 0].tolist(), sample["time"][:, 0].tolist(), strict=True))
    assert set(counts) == expected
    assert chisquare([counts[w] for w in sorted(expected)]).pvalue > 1e-3


def test_windows_past_the_end_of_an_episode() -> None:
    """Every step starts one, equally often, in episodes shorter than a window too; none crosses the writer."""
    torch.manual_seed(0)
    replay = buffer(40, 6, 400, cross_episode=True)
    for start in range(0, 63, 9):
        replay.extend(experience(9, start=start))
    counts: Counter[tuple[int, int]] = Counter()
    for _ in range(60):
        sample = replay.sample()
        assert sample.batch_size == (400, 6)
        assert (sample["time"] == sample["time"][:, :1] + torch.arange(6)).all()
        assert (sample["world"] == sample["world"][:, :1]).all()
        counts.update(zip(sample["world"][:, 0].tolist(), sample["time"][:, 0].tolist(), strict=True))
    expected = {(world, t) for world in range(WORLDS) for t in range(63 - 40, 63 - 5)}
    assert set(counts) == expected
    assert chisquare([counts[w] for w in sorted(expected)]).pvalue > 1e-3


def test_cost_does_not_depend_on_capacity() -> None:
    """The same number of candidates, and nothing read but the flags of those."""
    drawn = []
    for steps in (20, 2000):
        replay = buffer(steps, 3, 32)
        replay.extend(experience(steps))
        with mock.patch.object(torch, "randint", wraps=torch.randint) as randint:
            replay.sample()
        assert randint.call_count == 1
        drawn.append(randint.call_args.args[1:])
    assert drawn[0] == drawn[1] == ((4 * 32 + 64,),)


def test_a_batch_size_of_ones_own() -> None:
    replay = buffer(40, 3)
    replay.extend(experience(30))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert replay.sample(7).batch_size == (7, 3)


def test_the_first_batch_is_kept_without_a_line_of_torchrl(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("torchrl")
    with caplog.at_level(logging.INFO, logger="torchrl"):
        log.addHandler(caplog.handler)  # it tells its own handlers alone
        try:
            buffer(40, 3).extend(experience(30))
            assert not caplog.messages and not log.filters
            ReplayBuffer(storage=LazyTensorStorage(4)).extend(torch.zeros(2))  # another's is as it was
        finally:
            log.removeHandler(caplog.handler)
    assert [line.split(" with")[0] for line in caplog.messages] == ["Initialized LazyTensorStorage"]


def test_too_few_windows() -> None:
    replay = buffer(40, 6)
    replay.extend(experience(5))
    with pytest.raises(UserError, match="collect more"):
        replay.sample()
    replay = buffer(40, 6)
    replay.extend(experience(30, lengths=(5, 3, 5)))
    with pytest.raises(UserError, match="too few episodes"):
        replay.sample()


def test_an_empty_buffer_holds_no_steps() -> None:
    with pytest.raises(UserError, match="holds 0 steps per world, a window needs 6; collect more first"):
        buffer(40, 6).sample()


def test_what_is_no_batch_of_worlds_and_times_is_refused() -> None:
    """Flat, worlds and times changed over, or of other worlds; nothing of it is kept."""
    replay, data = buffer(40, 3), experience(7)
    other = experience(7, lengths=(5, 3))
    for batch, shape in (
        (data.reshape(-1), r"\(21,\)"),
        (data.transpose(0, 1), r"\(7, 3\)"),
        (other, r"\(2, 7\)"),
    ):
        with pytest.raises(
            UserError, match=rf"collector's batch \(worlds, time\), \(3, …\) here, not {shape}"
        ):
            replay.extend(batch)
        assert len(replay) == 0


def test_a_batch_that_lacks_an_entry_is_refused() -> None:
    """The flag of first steps always; anything else that those before have."""
    replay, data = buffer(40, 3), experience(14)
    pixels = torch.zeros(WORLDS, 14, 4, 4, 3)
    data.update({"pixels": pixels, "action": torch.zeros(WORLDS, 14, 2), "next": {"pixels": pixels}})
    with pytest.raises(UserError, match="the batch has no is_init, which marks first steps of episodes"):
        replay.extend(data[:, :7].exclude("is_init"))
    replay.extend(data[:, :7])
    for key in ("pixels", ("next", "pixels"), "action", ("next", "done")):
        name = key if isinstance(key, str) else ".".join(key)
        with pytest.raises(UserError, match=f"the batch has no {name}, which those before have"):
            replay.extend(data[:, 7:].exclude(key))
    assert len(replay) == 7 * WORLDS
    replay.extend(data[:, 7:])


@pytest.mark.parametrize("option", ["num_envs", "batch_size"])
def test_sizes_are_whole_numbers(option: str) -> None:
    sizes = {"capacity": 40, "num_envs": 3, "window": 3, "batch_size": 4, option: 0}
    with pytest.raises(UserError, match=f"{option}=0: must be"):
        make_replay(**sizes, device="cpu")


@pytest.mark.parametrize(("capacity", "num_envs"), [(3, 3), (11, 3), (0, 3), (2, 3)])
def test_capacity_too_small(capacity: int, num_envs: int) -> None:
    with pytest.raises(UserError, match="at least 12"):
        make_replay(capacity=capacity, num_envs=num_envs, window=3, batch_size=4, device="cpu")


def test_smallest_capacity() -> None:
    replay = make_replay(capacity=12, num_envs=3, window=3, batch_size=64, device="cpu")
    replay.extend(experience(4, lengths=(4, 4, 4)))
    assert replay.sample()["time"].amin() == 0


def test_a_buffer_of_one_window_has_one() -> None:
    replay = buffer(40, 5)
    replay.extend(experience(5, lengths=(5, 5, 5)))
    assert replay.sampler.bounds(replay.storage) == (1, 0)
    assert (replay.sample()["time"] == torch.arange(5)).all()


def test_windows_start_after_the_steps_that_must_be_kept_before_them() -> None:
    """Full or not, and where the writer has come round: the oldest steps start no window."""
    replay = buffer(10, 3)
    sampler = WindowSampler(replay.writer, length=3, before=2)
    replay.extend(experience(7))
    assert sampler.bounds(replay.storage) == (3, 2)  # steps 2 … 4 start windows, which end at 6
    assert newest_step(replay) == 6
    replay.extend(experience(7, start=7))
    assert sampler.bounds(replay.storage) == (6, 6)  # the oldest, step 4, lies at 4
    assert newest_step(replay) == 3
    replay.extend(experience(6, start=14))
    assert newest_step(replay) == 9  # the last place, from where the writer starts anew


def test_capacity_counts_the_images_before_a_window() -> None:
    options = {"num_envs": 3, "window": 3, "batch_size": 4, "device": "cpu"}
    with pytest.raises(UserError, match="and 2 before them; use at least 18"):
        make_replay(capacity=17, frame_stack=3, stacked=("pixels",), **options)
    assert make_replay(capacity=18, frame_stack=3, stacked=("pixels",), **options).sampler.before == 2
    assert make_replay(capacity=12, frame_stack=3, **options).sampler.before == 0  # nothing is stacked


def test_windows_end_with_their_episode_unless_asked() -> None:
    replay = make_replay(capacity=120, num_envs=3, window=3, batch_size=200, device="cpu")
    replay.extend(experience(40))
    sample = replay.sample()
    assert (sample["episode"] == sample["episode"][:, :1]).all()
    assert WindowSampler(replay.writer, length=1).candidates(8) == 8  # one step crosses nothing
    usual = WindowSampler(replay.writer, length=1, oversample=1)
    assert (usual.length, usual.before, usual.cross_episode) == (1, 0, False)


def test_windows_nearly_as_long_as_episodes_are_found_in_every_batch() -> None:
    def batches(episode_length: int) -> None:
        torch.manual_seed(0)
        replay = make_replay(
            capacity=480, num_envs=3, window=18, batch_size=16, device="cpu", episode_length=episode_length
        )
        replay.extend(experience(160, lengths=(20, 20, 20)))
        for _ in range(500):
            replay.sample()

    batches(20)
    with pytest.raises(UserError, match="too few episodes of at least 18 steps"):
        batches(0)  # not known


def test_on_a_gpu_missing_windows_are_kept_in_mind_until_asked_for() -> None:
    """Without waiting for the device: whether a batch was whole is a tensor until :meth:`check`."""

    def crossing(missing: bool) -> SimpleNamespace:
        return SimpleNamespace(device=SimpleNamespace(type="cuda"), any=lambda: torch.tensor(missing))

    sampler = buffer(40, 3).sampler
    sampler.check()
    for batches in ([True], [True, False], [False, True]):
        for missing in batches:
            sampler.record_missing(crossing(missing))
        with pytest.raises(UserError, match="too few episodes"):
            sampler.check()
        sampler._missing = None
    sampler.record_missing(crossing(False))
    sampler.check()
    assert sampler._missing is None


@pytest.mark.parametrize(
    "options", [{"length": 0}, {"length": 2, "oversample": 0}, {"length": 2, "burn_in": -1}]
)
def test_impossible_sampler(options: dict[str, int]) -> None:
    with pytest.raises(UserError):
        WindowSampler(buffer(10, 2).writer, **options)


def test_round_trip() -> None:
    replay = buffer(40, 3)
    data = experience(12)
    replay.extend(data[:, :7])
    replay.extend(data[:, 7:])
    stored = replay[:]  # TorchRL gives it back as it was given: (worlds, time)
    assert stored.batch_size == (WORLDS, 12)
    assert (stored == data).all()
    assert len(replay) == 12 * WORLDS
