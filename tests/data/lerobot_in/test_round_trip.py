"""Replay → dataset → cache → windows gives the replay's windows, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.run import Run

KEYS = ["pixels", "state", "joint_target", "goal"]
FLAGS = ["reward", "done", "terminated", "truncated", "success"]
WINDOW = 3


def replay_windows(replay: Any) -> dict[tuple[float, ...], TensorDictBase]:
    """Every window of a whole episode, by the numbers of its first state."""
    data = replay[:]  # (worlds, time)
    worlds, steps = data.batch_size
    out = {}
    for world in range(worlds):
        init = data["is_init"][world, :, 0].tolist()
        done = data["next", "done"][world, :, 0].tolist()
        starts = [t for t in range(steps) if init[t]]
        for start in starts:
            end = next((t for t in range(start, steps) if done[t]), None)
            if end is None:
                continue  # not a whole episode: not exported
            for t in range(start, end + 2 - WINDOW):
                piece = data[world, t : t + WINDOW]
                out[tuple(piece["state"][0].tolist())] = piece
    return out


def test_bit_for_bit(exact: Any, opened: Callable) -> None:
    theirs = replay_windows(exact.replay)
    windows = opened(exact.root, window=WINDOW)
    assert len(windows) == len(theirs) == 9 * 4
    assert windows.action_low is None and windows.episode_length == 6 and windows.fps == 30
    assert windows.image_sizes == {"pixels": (64, 64, 3)}
    assert windows.observation_sizes == {"state": 20, "goal": 3, "joint_target": 7}
    for batch in windows.batches(1):
        mine = batch[0]
        original = theirs.pop(tuple(mine["state"][0].tolist()))
        for key in [*KEYS, "action", "is_init", *[("next", key) for key in (*KEYS, *FLAGS)]]:
            assert mine[key].dtype == original[key].dtype, key
            assert torch.equal(mine[key], original[key]), key
    assert not theirs  # every window of the replay, the last action of each episode among them


def test_a_run_gets_frames_reached_later_from_it(exact: Any, settled: Callable, tmp_path: Any) -> None:
    words = ("scale=smoke", "device=cpu", "env=reach_goal_image", "model=lewm", "model.goal_policy_coef=1")
    words += (
        "dataset=lerobot",
        "trainer=offline",
        f"dataset.root={exact.root}",
        f"dataset.cache_dir={tmp_path}",
    )
    for asked in (False, True):
        cfg = settled(*words, "dataset.workers=1", f"replay.future={asked}", "env.image_size=64")
        train, validation = build.open_recorded(cfg, torch.device("cpu"))
        assert validation is not None
        for windows in (train, validation):
            assert ("future" in windows.sample(2).keys()) == asked  # noqa: SIM118


def test_a_run_gets_stacks_from_it(exact: Any, settled: Callable, tmp_path: Any) -> None:
    """`env.frame_stack` with `dataset=lerobot`: what the model is built for is what batches hold."""
    overrides = (
        "scale=smoke",
        "device=cpu",
        "env=reach_fixed_pixels",
        "model=tdmpc2_pixels",
        "dataset=lerobot",
        "trainer=offline",
        f"dataset.root={exact.root}",
        f"dataset.cache_dir={tmp_path}",
        "dataset.workers=1",
    )
    cfg = settled(*overrides, "env.frame_stack=3")
    check(cfg)
    train, validation = build.open_recorded(cfg, torch.device("cpu"))
    assert train.image_sizes == {"pixels": (64, 64, 9)} == validation.image_sizes
    _, spaces = Run(settings=cfg, folder=tmp_path).build_experience(None)
    assert spaces.image_sizes == train.image_sizes and not spaces.terminates
    rewards = torch.stack([piece["next", "reward"] for piece in replay_windows(exact.replay).values()])
    least, largest = spaces.reward_bounds
    assert least == rewards.min() and rewards.max() <= largest <= 0.0  # rows after an end may hold 0
    single = build.open_recorded(settled(*overrides, "env.frame_stack=1"), torch.device("cpu"))
    for windows, alone in zip((train, validation), single, strict=True):
        h = windows.window
        per_episode = windows.episode_length - h + 1
        assert len(windows) == len(alone) == per_episode * len(windows.episodes) > 0
        for episode in range(len(windows.episodes)):
            pieces = [alone.windows(torch.tensor([episode * per_episode + t]))[0] for t in range(per_episode)]
            rest = pieces[-1]["next", "pixels"]  # the observation after the last action among them
            seen = [*(piece["pixels"][0] for piece in pieces), *rest]
            assert len(seen) == windows.episode_length + 1
            for t in range(per_episode):
                got = windows.windows(torch.tensor([episode * per_episode + t]))[0]
                for k in range(h):
                    for at, stack in ((t + k, got["pixels"][k]), (t + k + 1, got["next", "pixels"][k])):
                        assert torch.equal(
                            stack, torch.cat([seen[max(0, at - back)] for back in (2, 1, 0)], -1)
                        )


def test_what_the_replay_samples_can_be_sampled(exact: Any, opened: Callable) -> None:
    """Same entries, shapes and types as the replay's batches: a learner cannot tell them apart."""
    torch.manual_seed(0)
    batch, original = opened(exact.root, window=WINDOW, keys=KEYS).sample(8), exact.replay.sample()
    for key in batch.keys(include_nested=True, leaves_only=True):
        assert batch[key].shape == original[key].shape and batch[key].dtype == original[key].dtype, key


def test_without_the_terminal_observations(exact: Any, opened: Callable, tmp_path: Any) -> None:
    """LeRobot's tools drop our side files: said, and only the last action of each episode is lost."""
    import shutil

    shutil.copytree(exact.root, tmp_path / "data")
    shutil.rmtree(tmp_path / "data" / "meta" / "franka_wm" / "terminal")
    windows = opened(tmp_path / "data", window=WINDOW)
    assert len(windows) == 9 * 3
    assert any("9 of 9 episodes have no terminal observation" in note for note in windows.notes)
    for batch in windows.batches(1):
        assert not batch["next", "done"].any()


@pytest.mark.slow
@pytest.mark.parametrize("format", ["video", "video_near_lossless"])
def test_video(format: str, export: Callable, opened: Callable) -> None:
    """Numbers bit for bit; pictures near; the last observation exact, for it is a PNG in every format."""
    recorded = export(format)
    theirs = replay_windows(recorded.replay)
    windows = opened(recorded.root, window=WINDOW)
    assert len(windows) == len(theirs)
    limit = 2 if format == "video_near_lossless" else 255
    for batch in windows.batches(1):
        mine = batch[0]
        original = theirs[tuple(mine["state"][0].tolist())]
        for key in ("state", "goal", "action", ("next", "state"), ("next", "reward"), ("next", "done")):
            assert torch.equal(mine[key], original[key]), key
        error = (mine["pixels"].int() - original["pixels"].int()).abs()
        assert error.max() <= limit and error.float().mean() < 6
        if bool(original["next", "done"][-1]):
            assert torch.equal(mine["next", "pixels"][-1], original["next", "pixels"][-1])
