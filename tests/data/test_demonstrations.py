"""Demonstrations in batches: as many as asked for, whole windows of their episodes, nothing else changed."""

from typing import Any

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict, TensorDictBase

from franka_wm.data.captured import CapturedSampling
from franka_wm.data.demonstrations import Demonstrations
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.replay import make_replay
from franka_wm.errors import UserError

WINDOW, BATCH = 3, 32
LENGTHS = (5, 3, 4)  # of the demonstrations' episodes
DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    ),
]


def steps(first: int, lengths: tuple[int, ...]) -> TensorDict:
    """(T, 1) transitions of episodes, numbered from ``first`` on."""
    total = sum(lengths)
    number = torch.arange(first, first + total, dtype=torch.float32).view(-1, 1, 1)
    begins = torch.cat([torch.arange(n) == 0 for n in lengths]).view(-1, 1, 1)
    after: Any = TensorDict({"x": number + 0.5, "reward": -number}, [total, 1])
    return TensorDict({"x": number, "action": number, "is_init": begins, "next": after}, [total, 1])


def mixed(device: str, demonstrations: Demonstrations | None, window: int = WINDOW, burn_in: int = 0) -> Any:
    replay = make_replay(
        capacity=200,
        num_envs=2,
        window=window,
        burn_in=burn_in,
        batch_size=BATCH,
        device=device,
        demonstrations=demonstrations,
    )
    replay.extend(torch.stack([steps(1000 * k, (10,) * 5).squeeze(1) for k in (1, 2)]).to(device))
    return replay if device == "cpu" else CapturedSampling(replay)


def draw(replay: Any) -> TensorDictBase:
    return (replay.sample() if hasattr(replay, "sample") else replay()).clone().cpu()


@pytest.mark.parametrize("device", DEVICES)
def test_so_many_windows_are_demonstrations_and_they_are_marked(device: str) -> None:
    shown = Demonstrations(steps(0, LENGTHS).to(device), window=WINDOW, most=20)
    replay = mixed(device, shown)
    for count in (20, 7, 0, 20):
        shown.use(count)
        for _ in range(4):  # on a GPU the later ones are replayed by a graph
            batch = draw(replay)
            theirs = batch["x"][:, 0, 0] < 1000
            assert theirs.sum() == count
            assert torch.equal(batch["demonstrated"], theirs.view(-1, 1, 1).expand(-1, WINDOW, 1))
            assert torch.equal(batch["next", "x"], batch["x"] + 0.5)
            assert torch.equal(batch["action"], batch["x"]) and torch.equal(
                batch["next", "reward"], -batch["x"]
            )


@pytest.mark.parametrize("device", DEVICES)
def test_steps_before_a_window_come_with_it(device: str) -> None:
    """Also across episodes, whose starts are marked; those before the first one are that one, marked."""
    shown = Demonstrations(steps(0, LENGTHS).to(device), window=WINDOW, burn_in=2, most=BATCH)
    replay = mixed(device, shown, burn_in=2)
    seen = set()
    for _ in range(6):
        batch = draw(replay)
        for x, is_init in zip(
            batch["x"].flatten(1).tolist(), batch["is_init"].flatten(1).tolist(), strict=True
        ):
            start = int(x[2])
            assert x == [max(0, start + k) for k in range(-2, WINDOW)]
            repeated = [False, *(a == b for a, b in zip(x[1:], x, strict=False))]
            assert is_init == [a in (0, 5, 8) or b for a, b in zip(x, repeated, strict=True)]
            seen.add(start)
    assert seen == {0, 1, 2, 5, 8, 9}


def test_windows_are_uniform_over_those_within_an_episode() -> None:
    replay = mixed("cpu", Demonstrations(steps(0, LENGTHS), window=WINDOW, most=BATCH))
    firsts = torch.cat([draw(replay)["x"][:, :, 0] for _ in range(60)])
    assert torch.equal(firsts - firsts[:, :1], torch.arange(3.0).expand_as(firsts))
    counts = firsts[:, 0].long().bincount(minlength=12)
    whole = [0, 1, 2, 5, 8, 9]  # of 5, 3 and 4 steps
    assert counts.sum() == counts[whole].sum()
    assert chisquare(counts[whole]).pvalue > 1e-3


def test_an_episode_shorter_than_a_window_is_no_demonstration() -> None:
    for window in (6, 12, 13, 15, 30):  # all of them together have 12 steps
        with pytest.raises(UserError, match=f"no demonstration has {window} steps"):
            Demonstrations(steps(0, LENGTHS), window=window, most=4)


def test_without_demonstrations_batches_are_as_before() -> None:
    torch.manual_seed(0)
    plain = draw(mixed("cpu", None))
    torch.manual_seed(0)
    shown = Demonstrations(steps(0, LENGTHS), window=WINDOW, most=4)
    shown.use(0)
    batch = draw(mixed("cpu", shown))
    assert "demonstrated" not in plain.keys(True, True)
    for key in plain.keys(True, True):
        assert torch.equal(plain[key], batch[key]), key


@pytest.mark.parametrize("window", [1, 2, 3])
def test_their_goals_in_hindsight_are_places_of_their_own_episode(window: int) -> None:
    """Also after windows so short that they end with the first steps of all."""

    def relabel(batch: TensorDictBase, goal: torch.Tensor) -> TensorDict:
        return TensorDict({"action": goal.unsqueeze(1).expand_as(batch["action"])}, batch.batch_size)

    hindsight = Hindsight(relabel, achieved=("x", slice(0, 1)), reads=["x"], share=1.0, episode_length=5)
    shown = Demonstrations(steps(0, LENGTHS), window=window, most=BATCH, hindsight=hindsight)
    replay, seen = mixed("cpu", shown, window), set()
    for _ in range(40):
        batch = draw(replay)
        seen |= {*zip(batch["x"][:, 0, 0].tolist(), batch["action"][:, 0, 0].tolist(), strict=True)}
    ends = {
        first: end for begin, end in ((0, 5), (5, 8), (8, 12)) for first in range(begin, end - window + 1)
    }
    assert seen == {
        (first, step + 0.5) for first, end in ends.items() for step in range(first + window - 1, end)
    }
