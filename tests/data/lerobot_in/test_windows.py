"""Windows: of one episode, uniform, split by episodes, the same from memory and disk, alike to a replay's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from franka_wm import processes
from franka_wm.data.lerobot import opening
from franka_wm.data.lerobot.episodes import complete
from franka_wm.data.lerobot.schema import DONE, EPISODE_KEY, SEED, TRUNCATED, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter
from franka_wm.envs import FrankaConfig
from franka_wm.errors import UserError

LENGTHS = (5, 4, 7)


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("window", [1, 3])
def test_within_episodes_and_uniform(pictures: Path, opened: Callable, window: int, in_memory: bool) -> None:
    windows = opened(pictures, window=window, in_memory=in_memory, keys=["joints"])
    # The observation after the last action is not recorded: L rows are L − 1 transitions.
    expected = {(e, t) for e, length in enumerate(LENGTHS) for t in range(length - window)}
    assert len(windows) == len(expected)
    counts: Counter = Counter()
    for _ in range(40):
        batch = windows.sample(200)
        assert batch.batch_size == (200, window)
        joints, after = batch["joints"], batch["next", "joints"]
        assert (joints[..., 0] == joints[:, :1, 0]).all() and (after[..., 0] == joints[..., 0]).all()
        assert (joints[..., 1] == joints[:, :1, 1] + torch.arange(window)).all()
        assert (after[..., 1] == joints[..., 1] + 1).all()
        assert (batch["is_init"].squeeze(-1) == (joints[..., 1] == 0)).all()
        assert torch.allclose(batch["next", "reward"].squeeze(-1), -joints[..., 1] / 10)
        counts.update(tuple(pair) for pair in joints[:, 0].int().tolist())
    assert set(counts) == expected
    assert chisquare([counts[w] for w in sorted(expected)]).pvalue > 1e-3


@pytest.mark.parametrize("in_memory", [True, False])
def test_steps_before_a_window_come_with_it(pictures: Path, opened: Callable, in_memory: bool) -> None:
    """Those of its episode; before that one began, its first step, each time as a first one."""
    windows = opened(pictures, window=3, in_memory=in_memory, keys=["joints"])
    longer = opened(pictures, window=3, burn_in=2, in_memory=in_memory, keys=["joints"])
    assert len(longer) == len(windows) and longer.split("all").burn_in == 2
    alone, batch = next(windows.batches()), next(longer.batches())
    assert batch.batch_size == (len(windows), 5)
    assert (batch[:, 2:] == alone).all()
    earlier, first = batch[:, :2], alone["joints"][:, 0]
    for back, k in ((2, 0), (1, 1)):
        assert torch.equal(earlier["joints"][:, k, 1], (first[:, 1] - back).clamp_min(0))
        assert torch.equal(earlier["joints"][:, k, 0], first[:, 0])
        assert torch.equal(earlier["is_init"][:, k, 0], first[:, 1] <= back)


def test_processes_divide_each_batch(pictures: Path, opened: Callable, monkeypatch) -> None:
    """Side by side their windows, and the frames reached later, are those that one process draws."""

    def drawn(count: int, rank: int) -> list[torch.Tensor]:
        monkeypatch.setattr(processes, "count", lambda: count)
        monkeypatch.setattr(processes, "rank", lambda: rank)
        monkeypatch.setattr(processes, "objects", lambda mine: [mine] * count)
        windows = opened(pictures, keys=["joints"], batch_size=12 // count, future=True)
        batches = [windows.sample() for _ in range(3)]
        return [torch.cat((one["joints"], one["future", "joints"]), -1) for one in batches]

    parts = zip(*(drawn(3, rank) for rank in range(3)), strict=True)
    for part, whole in zip(parts, drawn(1, 0), strict=True):
        assert [len(one) for one in part] == [4, 4, 4] and torch.equal(torch.cat(part), whole)


@pytest.mark.parametrize(
    ("free", "other_fits", "in_memory"), [(10**12, True, True), (10**12, False, False), (0, True, False)]
)
def test_processes_agree_on_where_the_data_lies(
    free: int, other_fits: bool, in_memory: bool, pictures: Path, opened: Callable, monkeypatch
) -> None:
    """One GPU may have less room than another one: with generators of two kinds their parts would overlap."""
    monkeypatch.setattr(opening, "free_memory", lambda device: free)
    monkeypatch.setattr(processes, "objects", lambda mine: [mine, other_fits])
    assert opened(pictures, keys=["joints"]).recording.in_memory == in_memory


def test_rewards_are_bounded_by_all_that_were_recorded(pictures: Path, opened: Callable) -> None:
    windows = opened(pictures, keys=["joints"], validation_fraction=0.4)
    least, largest = windows.reward_bounds
    assert largest == 0.0 and least == pytest.approx(-(max(LENGTHS) - 1) / 10)
    assert windows.split("validation").reward_bounds == (least, largest)


def test_pictures_belong_to_their_rows(pictures: Path, foreign, opened: Callable) -> None:
    for batch in opened(pictures).batches(1):
        for step in batch[0]:
            episode, frame = step["joints"].int().tolist()
            assert np.array_equal(step["pixels"], foreign.picture(episode, frame, 0))
            assert np.array_equal(step["next", "pixels_side"], foreign.picture(episode, frame + 1, 1))


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("window", [1, 3])
def test_stacks_are_of_their_episode(
    pictures: Path, foreign, opened: Callable, window: int, in_memory: bool
) -> None:
    """The pictures before, oldest first, back to the episode's first; two datasets, as one is cut into parts."""
    windows = opened([pictures, pictures], window=window, frame_stack=3, in_memory=in_memory)
    assert windows.image_sizes["pixels"][-1] == windows.image_sizes["pixels_side"][-1] == 9
    assert windows.split("train").image_sizes == windows.image_sizes
    seen = 0
    for batch in windows.batches(7):
        for step in batch.reshape(-1):
            episode, frame = step["joints"].int().tolist()
            for last, where in ((frame, step), (frame + 1, step["next"])):
                for camera, key in enumerate(("pixels", "pixels_side")):
                    stack = [foreign.picture(episode, max(0, last - back), camera) for back in (2, 1, 0)]
                    assert np.array_equal(where[key], np.concatenate(stack, -1)), (episode, last, key)
                    seen += 1
    assert seen == 4 * window * len(windows)
    with pytest.raises(UserError, match="frame_stack=0: must be a whole number of at least 1"):
        opened(pictures, frame_stack=0)


@pytest.mark.parametrize("in_memory", [True, False])
def test_frames_reached_later(pictures: Path, foreign, opened: Callable, in_memory: bool) -> None:
    """Of the window's episode, from its last frame on to the episode's; from half the way where nothing is drawn."""
    windows = opened(pictures, window=2, frame_stack=2, in_memory=in_memory, future=True)
    plain = opened(pictures, window=2, frame_stack=2, in_memory=in_memory)
    seen: Counter = Counter()
    for _ in range(20):
        batch = windows.sample(50)
        future, end = batch["future"], batch["next", "joints"][:, -1]
        assert torch.equal(future["joints"][..., 0], batch["joints"][..., 0])
        assert torch.equal(future["steps"].squeeze(-1), (future["joints"] - batch["joints"])[..., 1].long())
        seen.update(map(tuple, torch.cat((end, future["joints"][:, 0, 1:2]), 1).int().tolist()))
    ends = {(e, t) for e, length in enumerate(LENGTHS) for t in range(2, length)}
    assert set(seen) == {(e, t, later) for e, t in ends for later in range(t, LENGTHS[e])}
    for batch, same in zip(windows.batches(7), plain.batches(7), strict=True):
        ((episode, frame),) = {tuple(pair) for pair in batch["future", "joints"][:1, 0].int().tolist()}
        end = int(batch["next", "joints"][0, -1, 1])
        assert frame == end + (LENGTHS[episode] - end) // 2
        stack = [foreign.picture(episode, frame - back, 0) for back in (1, 0)]
        assert np.array_equal(batch["future", "pixels"][0, 1], np.concatenate(stack, -1))
        del batch["future"]
        assert (batch == same).all()
    assert windows.split("train").future and "future" not in plain.sample(3).keys()  # noqa: SIM118


def test_video(video: Path, foreign, opened: Callable) -> None:
    """Every frame is closest to its own picture of all, and is what LeRobot's own reader gives."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    theirs = LeRobotDataset("someone/else", root=video, video_backend="pyav")
    windows = opened(video, window=1)
    truth = {
        (e, t): foreign.picture(e, t).astype(float) for e, length in enumerate(LENGTHS) for t in range(length)
    }
    first = np.cumsum([0, *LENGTHS])
    for batch in windows.batches(1):
        episode, frame = batch["joints"][0, 0].int().tolist()
        picture = batch["pixels"][0, 0].numpy()
        errors = {place: np.abs(other - picture).mean() for place, other in truth.items()}
        assert min(errors, key=errors.__getitem__) == (episode, frame)
        item = theirs[int(first[episode]) + frame]["observation.images.top"]
        assert torch.equal((item * 255).round().to(torch.uint8).permute(1, 2, 0), batch["pixels"][0, 0])


def test_actions_of_others_are_scaled(pictures: Path, foreign, opened: Callable) -> None:
    windows = opened(pictures)
    every = np.stack([foreign.action(e, t) for e, length in enumerate(LENGTHS) for t in range(length)])
    assert np.array_equal(windows.action_low, every.min(0)) and np.array_equal(
        windows.action_high, every.max(0)
    )
    assert any("scaled" in note for note in windows.notes)
    seen = []
    for batch in windows.batches(3):
        episode, frame = batch["joints"].int().unbind(-1)
        raw = np.array(
            [
                [foreign.action(int(e), int(t)) for e, t in zip(*row, strict=True)]
                for row in zip(episode, frame, strict=True)
            ]
        )
        assert np.allclose(windows.recorded_action(batch["action"]), raw, atol=1e-4)
        seen.append(batch["action"])
    action = torch.cat(seen)
    assert action.min() >= -1 and action.max() <= 1 and (action[..., 2] == 0).all()
    with pytest.raises(UserError, match=r"set dataset\.normalize_actions=true"):
        opened(pictures, normalize_actions=False)
    with pytest.raises(
        UserError, match=r"use env=none dataset\.normalize_actions=true"
    ):  # else refused again
        opened(pictures, normalize_actions=False, action_dim=action.shape[-1])


def test_an_action_that_only_trembles_never_changes(
    foreign, tmp_path: Path, opened: Callable, monkeypatch
) -> None:
    """Noise of 7e-7 would fill [−1, 1]; a component of another unit, a thousandth of the largest, is learned."""
    monkeypatch.setattr(
        foreign, "action", lambda episode, t: np.array([t, 0.001 * t, 7e-7 * (t % 2)], np.float32)
    )
    windows = opened(foreign.make_foreign(tmp_path / "trembling", pictures=False))
    for batch in windows.batches(3):
        assert (batch["action"][..., 2] == 0).all()
        assert torch.allclose(batch["action"][..., 0], batch["action"][..., 1], atol=1e-5)
    statistics = windows.statistics()["action"]
    assert statistics.std[2] == 0 and statistics.std[1] > 0.1
    assert any("component 2 never changes and becomes 0" in note for note in windows.notes)


def test_discrete_actions(foreign, tmp_path: Path, opened: Callable) -> None:
    moves = {"action": {"dtype": "int64", "shape": (1,), "names": None}}
    windows = opened(foreign.make_foreign(tmp_path / "moves", pictures=False, **moves))
    action = windows.sample(4)["action"]
    assert action.shape == (4, 2) and action.dtype == torch.int64
    assert windows.action_dim == 0 and windows.num_actions == 1 and windows.action_low is None


def test_splits(pictures: Path, foreign, tmp_path: Path, opened: Callable) -> None:
    root = foreign.make_foreign(tmp_path / "many", lengths=(4,) * 20, pictures=False)
    train = opened(root, split="train", validation_fraction=0.2, seed=3)
    validation = train.split("validation")
    assert len(train.episodes) == 16 and len(validation.episodes) == 4
    assert not set(train.episodes) & set(validation.episodes)
    seen = {int(e) for batch in validation.batches() for e in batch["joints"][:, 0, 0]}
    assert seen == {index for _, index in validation.episodes}
    assert train.split("validation").episodes == validation.episodes
    others = [opened(root, split="validation", validation_fraction=0.2, seed=s).episodes for s in (4, 5, 6)]
    assert any(other != validation.episodes for other in others)
    with pytest.raises(UserError, match="no episode is left for validation"):
        opened(root, split="validation", validation_fraction=0.0)
    assert opened(root, split="train", validation_fraction=0.0).validation() is None
    same = train.validation()
    assert same is not None and same.episodes == validation.episodes
    mean, deviation = train.statistics()["joints"][:2]  # what a trainer takes
    assert torch.equal(mean, train.statistics()["joints"].mean) and deviation.shape == (2,)


def test_same_seed_same_windows(pictures: Path, opened: Callable) -> None:
    a, b, c = (opened(pictures, seed=seed) for seed in (1, 1, 2))
    first, same, other = (w.sample(64) for w in (a, b, c))
    assert (first == same).all() and not (first["joints"] == other["joints"]).all()
    assert not (first["joints"] == a.sample(64)["joints"]).all()


@pytest.mark.parametrize("in_memory", [True, False])
def test_several_datasets(pictures: Path, foreign, tmp_path: Path, opened: Callable, in_memory: bool) -> None:
    """Joined, scaled by what both span, and no window from one into the other."""
    other = foreign.make_foreign(tmp_path / "other", lengths=(3, 9))
    windows = opened([pictures, other], in_memory=in_memory)
    assert [d for d, _ in windows.episodes] == [0, 0, 0, 1, 1]
    assert len(windows) == sum(n - 2 for n in (*LENGTHS, 3, 9))
    spans = np.array([foreign.action(e, t) for e, n in ((0, 5), (1, 4), (2, 7), (1, 9)) for t in range(n)])
    assert np.array_equal(windows.action_high, spans.max(0)) and np.array_equal(
        windows.action_low, spans.min(0)
    )
    for batch in windows.batches(1):
        episode, frame = batch["joints"][0, 1].int().tolist()
        assert np.array_equal(batch["pixels"][0, 1], foreign.picture(episode, frame))
        assert torch.equal(batch["joints"][0, 0] + torch.tensor([0, 1]), batch["joints"][0, 1])
    drawn = windows.sample(500)
    assert (drawn["joints"][:, 0, 1] >= 6).any()  # only the other's long episode gets there


def test_statistics(foreign, tmp_path: Path, opened: Callable) -> None:
    root = foreign.make_foreign(tmp_path / "many", lengths=(4, 6, 5, 3, 8), pictures=False)
    train = opened(root, split="train", validation_fraction=0.4)
    rows = np.array(
        [foreign.state(e, t) for _, e in train.episodes for t in range((4, 6, 5, 3, 8)[e])], np.float64
    )
    statistics = train.statistics()
    for name, value in (
        ("mean", rows.mean(0)),
        ("std", rows.std(0)),
        ("min", rows.min(0)),
        ("max", rows.max(0)),
    ):
        assert np.allclose(getattr(statistics["joints"], name), value, atol=1e-6), name
    assert (statistics["action"].min >= -1).all() and float(statistics["action"].std[2]) == 0


def test_moments_of_images(foreign, pictures: Path, opened: Callable) -> None:
    train = opened(pictures, split="train", validation_fraction=0.4)
    assert len(train.episodes) == 2
    frames = [foreign.picture(e, t) for _, e in train.episodes for t in range((5, 4, 7)[e])]
    seen = torch.from_numpy(np.stack(frames)).double() / 255.0
    mean, std = train.image_moments(["pixels"])["pixels"]
    torch.testing.assert_close(mean.double(), seen.mean(0), rtol=0, atol=1e-6)
    torch.testing.assert_close(std.double(), seen.std(0, correction=0), rtol=0, atol=1e-6)
    few = train.image_moments(["pixels"], most=2)["pixels"][0]  # the first and the last one
    torch.testing.assert_close(few.double(), seen[[0, -1]].mean(0), rtol=0, atol=1e-6)


def test_what_does_not_fit_the_environment_is_refused(pictures: Path, opened: Callable) -> None:
    opened(pictures, keys=["joints", "pixels"], fps=10)
    for options, message in (
        ({"keys": ["state"]}, "gives no 'state'; observations there: joints, gripper, pixels"),
        ({"fps": 30.0}, "10 frames per second, the environment 30"),
        ({"action_dim": 7}, "have 3 numbers, the environment's 7"),
        ({"action_dim": 3}, "would be scaled"),
    ):
        with pytest.raises(UserError, match=message):
            opened(pictures, **options)


def test_refused(pictures: Path, foreign, tmp_path: Path, opened: Callable) -> None:
    with pytest.raises(UserError, match="no window of 7 transitions fits: the longest episode of all has 6"):
        opened(pictures, window=7)
    assert len(opened(pictures, window=6)) == 1
    for options in (
        {"window": 0},
        {"batch_size": 0},
        {"burn_in": -1},
        {"split": "test"},
        {"validation_fraction": 1.0},
    ):
        with pytest.raises(UserError):
            opened(pictures, **options)
    slow = foreign.make_foreign(tmp_path / "slow", fps=5)
    with pytest.raises(UserError, match=r"10 frames per second.* 5; train on them separately"):
        opened([pictures, slow])
    wide = foreign.make_foreign(tmp_path / "wide", width=48)
    with pytest.raises(UserError, match=r"must be alike.*dataset\.image_size"):
        opened([pictures, wide])
    assert opened([pictures, wide], image_size=32).image_sizes["pixels"] == (32, 32, 3)
    with pytest.raises(UserError, match=r"dataset\.root=FOLDER or dataset\.repo_id"):
        opened(None)


def test_actions_are_those_of_rows_that_have_one(opened: Callable, tmp_path: Path) -> None:
    """The row of the last observation holds none, but a 0, which is far from these."""
    schema = schema_for(FrankaConfig(observations=("state", "joint_target")))
    rng, actions = np.random.default_rng(0), []
    with DatasetWriter(tmp_path / "set", schema, provenance={"config": {}}, workers=0) as writer:
        for number in range(3):
            rows, terminal = {}, {}
            for name, feature in schema.features.items():
                if name in (SEED, EPISODE_KEY):
                    continue
                values = rng.uniform(0.5, 0.9, (5, *feature["shape"])).astype(schema.numpy_dtype(name))
                rows[name] = values[:4].copy()
                if name in schema.observed:
                    terminal[name] = values[4]
                if feature["dtype"] == "bool":
                    rows[name][:] = False
            rows[DONE][-1] = rows[TRUNCATED][-1] = True
            actions.append(rows["action"])
            writer.add([complete(rows, terminal, seed=(0, number, 0))])
        writer.finish()
    recorded = np.concatenate(actions)
    windows = opened(tmp_path / "set")
    assert len(windows) == 3 * 3 and windows.recording.mapping.ours  # the last observation is known
    assert np.array_equal(windows.statistics()["action"].min, recorded.min(0))
    assert np.allclose(windows.statistics()["action"].mean, recorded.mean(0), atol=1e-6)
    scaled = opened(tmp_path / "set", normalize_actions=True)
    assert np.array_equal(scaled.action_low, recorded.min(0))
    assert np.array_equal(scaled.action_high, recorded.max(0))
