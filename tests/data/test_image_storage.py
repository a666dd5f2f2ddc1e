"""A replay that keeps each image once gives back the images and stacks that it was given, bit for bit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.replay import make_replay
from franka_wm.errors import UserError
from franka_wm.training.storage_budget import filled_bytes

N, LENGTH, COUNT, WINDOW = 3, 4, 3, 2
on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
KEYS = ("pixels", "pixels_side")


@pytest.fixture(scope="module")
def played(small_env, random_actions) -> TensorDictBase:
    """Steps (worlds, time) of the arm, with stacks from two cameras; each world has its own times of resets."""
    env = small_env(
        N,
        observations=("pixels", "state"),
        cameras=("front", "side"),
        image_size=16,
        episode_length=LENGTH,
        frame_stack=COUNT,
    )
    root, steps = env.reset(seed=0), []
    for t, action in enumerate(random_actions(N, 26).unbind(1)):
        step, root = env.step_and_maybe_reset(root.clone().set("action", action))
        steps.append(step.clone())
        if t in (5, 14):  # one world alone starts anew, in the middle of its episode
            mask = torch.tensor([[t == 5], [t == 14], [False]])
            root = env.reset(root.exclude("reward").set("_reset", mask))
    return torch.stack(steps, 1).select(*KEYS, "state", "is_init", "action", *(("next", key) for key in KEYS))


def filled(played: TensorDictBase, chunks: list[int], steps: int = 12, **options: Any) -> Any:
    replay = make_replay(
        capacity=steps * N,
        num_envs=N,
        window=WINDOW,
        batch_size=64,
        device="cpu",
        frame_stack=COUNT,
        **options,
    )
    start = 0
    for chunk in chunks:
        replay.extend(played[:, start : start + chunk])
        start += chunk
    return replay


@pytest.mark.parametrize("cross_episode", [False, True])
@pytest.mark.parametrize("chunks", [[9], [5, 4], [1] * 11, [7, 6, 6, 7]])
def test_windows_have_the_stacks_that_were_given(played, chunks: list[int], cross_episode: bool) -> None:
    """Half full, filled step by step, wrapped around twice; across the ends of episodes, and within them."""
    torch.manual_seed(0)
    replay = filled(played, chunks, stacked=KEYS, cross_episode=cross_episode)
    given = {
        state.numpy().tobytes(): divmod(i, played.shape[1])
        for i, state in enumerate(played["state"].flatten(0, 1))
    }
    assert len(given) == played.numel()  # each step is known by its state
    seen = set()
    for _ in range(20):
        batch = replay.sample()
        for row in batch.unbind(0):
            world, time = given[row["state"][0].numpy().tobytes()]
            seen.add((world, time))
            expected = played[world, time : time + WINDOW]
            for key in KEYS:
                assert torch.equal(row[key], expected[key]), (world, time)
                assert torch.equal(row["next", key], expected["next", key]), (world, time)
    first = max(0, sum(chunks) - 12) + COUNT - 1  # the older pictures of those before are gone
    begins = played["is_init"].squeeze(-1)
    assert seen == {
        (world, time)
        for world in range(N)
        for time in range(first, sum(chunks) - WINDOW + 1)
        if cross_episode or not begins[world, time + 1 : time + WINDOW].any()
    }


def test_ends_of_episodes_and_single_resets_are_among_them(played) -> None:
    """Or the test above could not fail where it matters."""
    begins = played["is_init"].squeeze(-1)
    assert begins.sum(1).tolist() == [7, 7, 7] and begins.float().std(0).max() > 0
    assert (played["pixels"][:, 1:, ..., :3] != played["pixels"][:, :-1, ..., :3]).any()


def kept_bytes(replay: Any) -> int:
    """All that the storage has allocated."""
    storage = replay.storage
    ends = storage._ends
    return storage._storage.bytes() + sum(x.nbytes for x in (ends.slots, ends.free, *ends.images.values()))


def test_each_image_is_kept_once(played) -> None:
    before = played.clone()
    stacked = filled(played, [9], stacked=KEYS)
    assert (played == before).all()
    image = len(KEYS) * 16 * 16 * 3
    singles = stacked[:]
    assert singles["pixels"].shape[-1] == 3
    assert filled_bytes(stacked) == singles.bytes()
    assert torch.equal(singles["next", "pixels"], played["next", "pixels"][:, :9, ..., -3:])
    # In two hundred steps the room for the ends of episodes of 50 is little.
    long = filled(played, [9], steps=200, stacked=KEYS)
    per_step = (kept_bytes(long) - 200 * N * (singles.bytes() // singles.numel() - 2 * image)) / (200 * N)
    assert image < per_step < 1.1 * image
    assert long.storage.bytes_per_step(played) == pytest.approx(kept_bytes(long) / (200 * N), rel=0.08)


def synthetic(worlds: int, steps: int, ends: float, seed: int) -> TensorDict:
    """Steps (worlds, time) with images of one number each; an episode may be one step long."""
    generator = torch.Generator().manual_seed(seed)
    begins = torch.rand(worlds, steps, 1, generator=generator) < ends
    begins[:, 0] = True
    image = torch.rand(worlds, steps + 1, 1, 1, 3, generator=generator)
    last = torch.rand(worlds, steps, 1, 1, 3, generator=generator)
    goes_on = torch.cat([~begins[:, 1:], torch.ones(worlds, 1, 1, dtype=torch.bool)], 1)
    led_to = torch.where(goes_on[..., None, None], image[:, 1:], last)
    after = {"pixels": led_to, "number": torch.arange(steps).expand(worlds, steps).unsqueeze(-1) + 1}
    root = {"pixels": image[:, :-1], "is_init": begins, "number": after["number"] - 1}
    return TensorDict(root | {"next": TensorDict(after, [worlds, steps])}, [worlds, steps])


@pytest.mark.parametrize("ends", [0.0, 0.1, 0.5, 1.0])
def test_whatever_comes_is_given_back(ends: float) -> None:
    """Compared with a storage that keeps everything twice: all chunks, wrapped around many times, ends of all kinds."""
    worlds, times, steps = 5, 41, 400
    for seed in range(3):
        data = synthetic(worlds, steps, ends, seed)
        options = {
            "capacity": worlds * times,
            "num_envs": worlds,
            "window": 2,
            "batch_size": 4,
            "device": "cpu",
        }
        replay = make_replay(**options, episode_length=7 if seed else 0)
        sizes = torch.randint(1, 2 * times, (20,), generator=torch.Generator().manual_seed(seed)).tolist()
        start = 0
        for size in [1, 1, times, times - 1, *sizes]:
            if start + size > steps:
                break
            replay.extend(data[:, start : start + size])
            start += size
            kept = data[:, max(0, start - times) : start]
            got = replay[:]
            order = got["number"][0, :, 0].argsort()
            assert (got[:, order] == kept).all(), (ends, seed, start)
            time = order.expand(worlds, -1)[:, :-1]
            world = torch.arange(worlds).unsqueeze(1).expand_as(time)
            assert (replay.storage.get((time, world)) == kept[:, :-1]).all()
        taken = (replay.storage._ends.slots >= 2).sum(0)
        ended = (data["is_init"][:, start - times + 1 : start, 0]).sum(1)
        assert torch.equal(taken, ended)  # none is lost, none is held for a step that is gone
        free = len(replay.storage._ends.images["pixels"]) - 2 - taken
        assert torch.equal(replay.storage._ends.count, free)
        assert ((taken > 0) & (taken < times - 1)).any() or ends in (0.0, 1.0)


def test_room_is_made_for_the_ends_that_come() -> None:
    """Not for as many as there might be: a checkpoint brings thousands of steps at once."""
    data = synthetic(5, 2000, 0.02, 0)
    options = {"capacity": 5 * 2000, "num_envs": 5, "window": 2, "batch_size": 4, "device": "cpu"}
    replay = make_replay(**options, episode_length=100)
    replay.extend(data[:, :1000])
    before = replay.storage.memory
    replay.extend(data[:, 1000:1001])
    assert replay.storage.memory == before  # nothing moved: what was captured of it still holds
    replay.extend(data[:, 1001:])
    assert replay.storage.memory != before
    most = int(data["is_init"].sum(1).max())
    assert most <= len(replay.storage._ends.images["pixels"]) <= 1.3 * most + 10
    assert (replay[:] == data).all()


def test_emptied_it_begins_anew() -> None:
    data = synthetic(3, 30, 0.2, 0)
    replay = make_replay(capacity=3 * 12, num_envs=3, window=2, batch_size=4, device="cpu")
    replay.extend(data[:, :8])
    replay.empty()
    replay.extend(data[:, 20:27])
    assert (replay[:] == data[:, 20:27]).all()


def test_images_that_do_not_follow_are_refused() -> None:
    """Rather than given back as if they did."""
    data = synthetic(3, 10, 0.2, 0)
    wrong = data.clone()
    wrong["next", "pixels"][1, 4] += 1.0
    assert not data["is_init"][1, 5]
    replay = make_replay(capacity=3 * 12, num_envs=3, window=2, batch_size=4, device="cpu")
    with pytest.raises(UserError, match="pixels: the image that a step begins with is not the one"):
        replay.extend(wrong)


def test_what_a_checkpoint_kept_is_taken_as_it_is(played) -> None:
    """Single pictures go in beside stacks: a run that goes on from a checkpoint."""
    torch.manual_seed(0)
    first = filled(played, [8], stacked=KEYS)
    again = filled(played, [], stacked=KEYS)
    again.extend(first[:])
    again.extend(played[:, 8:10])
    time = torch.arange(2, 10).expand(N, 8)
    world = torch.arange(N).unsqueeze(1).expand(N, 8)
    got = again.storage.get((time, world))
    for key in KEYS:
        assert torch.equal(got[key], played[key][:, 2:10])
        assert torch.equal(got["next", key], played["next", key][:, 2:10])


def test_stacks_are_looked_at_after_single_pictures_as_well(played) -> None:
    first = filled(played, [8], stacked=KEYS)
    again = filled(played, [], stacked=KEYS)
    again.extend(first[:])
    wrong = played[:, 8:10].clone()
    wrong["pixels"][0, 1, 0, 0, 0] ^= 1
    with pytest.raises(UserError, match="older images are not those"):
        again.extend(wrong)


def test_pictures_that_are_no_stacks_are_refused(played) -> None:
    wrong = played.clone()
    wrong["pixels"][1, 4, 0, 0, 0] ^= 1  # an older picture than the newest
    with pytest.raises(UserError, match="older images are not those"):
        filled(wrong, [8], stacked=KEYS)
    wrong = played.clone()
    wrong["next", "pixels_side"][0, 2, 0, 0, 3] ^= 1
    with pytest.raises(UserError, match="pixels_side: its older images"):
        filled(wrong, [8], stacked=KEYS)
    wrong["pixels"] = wrong["pixels"].repeat(1, 1, 1, 1, 2)
    with pytest.raises(UserError, match="18 channels"):
        replay = filled(played, [4], stacked=KEYS)
        replay.extend(wrong[:, 4:6])
    with pytest.raises(UserError, match="a window needs 4; collect more first"):
        filled(played, [3], stacked=KEYS).sample()
    with pytest.raises(UserError, match="use at least 15"):
        filled(played, [], steps=4, stacked=KEYS)


def test_without_pictures_there_is_nothing_to_stack(played) -> None:
    """A state's run with the option set, and a model that reads one camera alone."""
    replay = filled(played.exclude(*KEYS, *(("next", key) for key in KEYS)), [9], stacked=KEYS)
    assert "pixels" not in replay.sample().keys()  # noqa: SIM118
    replay = filled(played.exclude("pixels", ("next", "pixels")), [9], stacked=KEYS)
    assert replay.sample()["pixels_side"].shape == (64, WINDOW, 16, 16, 9)


def test_what_lies_on_a_gpu_comes_to_the_host_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """All worlds, also where there are more of them than times."""
    worlds, times, asked = 5, 4, []
    data = synthetic(worlds, times, 0.2, 0)
    replay = make_replay(capacity=worlds * times, num_envs=worlds, window=2, batch_size=4, device="cpu")
    replay.extend(data)
    storage, whole = replay.storage, data.transpose(0, 1)
    assert (storage.to_host() == whole).all()
    size = int(2.5e8 * worlds)  # room for two worlds at a time
    kept = SimpleNamespace(device=torch.device("cuda"), shape=whole.shape, bytes=lambda: size)
    monkeypatch.setattr(storage, "_storage", kept)
    monkeypatch.setattr(storage, "get", lambda index: (asked.append(index[1]), whole[index])[1])
    assert (storage.to_host() == whole).all()
    assert asked == [slice(0, 2), slice(2, 4), slice(4, 6)]


def test_room_that_a_gpu_has_told_of_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asking waits for the device; what is not there yet is not read."""
    replay = make_replay(capacity=3 * 12, num_envs=3, window=2, batch_size=4, device="cpu")
    replay.extend(synthetic(3, 8, 0.2, 0))
    ends, arrived, begins = replay.storage._ends, [False], torch.zeros(3, 3, dtype=torch.bool)
    told = torch.tensor(9), SimpleNamespace(query=lambda: arrived[0])
    monkeypatch.setattr(ends, "_told", told)
    for free in (0, 5):
        monkeypatch.setattr(ends, "_surely_free", free)
        ends._make_room(begins)
        assert ends._surely_free == (free - len(begins) if free else int(ends.count.min()))
    arrived[0] = True
    monkeypatch.setattr(ends, "count", None)
    ends._make_room(begins)
    assert ends._surely_free == 9 - len(begins)


@pytest.mark.gpu
@on_gpu
def test_captured_batches_have_stacks(played) -> None:
    replay = make_replay(
        capacity=12 * N,
        num_envs=N,
        window=WINDOW,
        batch_size=64,
        device="cuda",
        frame_stack=COUNT,
        stacked=KEYS,
    )
    sampling, start = CapturedSampling(replay), 0
    given = {
        state.numpy().tobytes(): divmod(i, played.shape[1])
        for i, state in enumerate(played["state"].flatten(0, 1))
    }
    for chunk in (9, 8, 8):
        replay.extend(played[:, start : start + chunk].to("cuda"))
        start += chunk
        for _ in range(4):
            for row in TensorDict(sampling().to_dict(), [64, WINDOW]).cpu().unbind(0):
                world, time = given[row["state"][0].numpy().tobytes()]
                expected = played[world, time : time + WINDOW]
                for key in KEYS:
                    assert torch.equal(row[key], expected[key])
                    assert torch.equal(row["next", key], expected["next", key])
