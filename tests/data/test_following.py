"""Batches of a replay go on where the last one ended, or begin episodes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from franka_wm.data.replay import WindowReplay, make_replay
from franka_wm.errors import UserError

WORLDS = 4


def steps(first: int, until: int, *, begins: tuple[int, ...] = ()) -> TensorDict:
    """(WORLDS, until - first): a state that goes on, one that does not, and numbers of the policy."""
    time = torch.arange(first, until).expand(WORLDS, -1)
    world = torch.arange(WORLDS).unsqueeze(1).expand_as(time)
    is_init = torch.zeros(WORLDS, until - first, 1, dtype=torch.bool)
    is_init[list(begins), 0] = True
    after = {"state": torch.stack([time + 1.0, world], -1), "context": torch.rand(*time.shape, 3)}
    return TensorDict(
        {
            "state": torch.stack([time + 0.0, world], -1),
            "context": torch.rand(*time.shape, 3),
            "is_init": is_init,
            "action": torch.zeros(*time.shape, 2),
            "next": TensorDict(after, time.shape),
        },
        time.shape,
    )


def replay() -> WindowReplay:
    return make_replay(capacity=100 * WORLDS, num_envs=WORLDS, window=2, batch_size=8, device="cpu")


@pytest.mark.parametrize("size", [1, 5])
def test_batches_that_do_not_follow_are_refused(size: int) -> None:
    """Also of one step each; what is kept stays as it was, and the right batch is taken afterwards."""
    kept = replay()
    for k in range(0, 5 + size, size):
        kept.extend(steps(k, k + size))
    with pytest.raises(
        UserError, match=r"where the last one ended \(world 3 does not\): give every batch in turn"
    ):
        kept.extend(steps(9 + k + size, 14 + k + size, begins=(0, 1, 2)))
    assert len(kept) == (k + size) * WORLDS
    kept.extend(steps(k + size, k + 9))
    kept.extend(steps(90, 95, begins=(0, 1, 2, 3)))


def test_images_go_on_too() -> None:
    """Each is kept once, so what a step led to would be another one."""

    def images(first: int, until: int) -> TensorDict:
        batch = steps(first, until).exclude("state", ("next", "state"))
        time = torch.arange(first, until + 1, dtype=torch.uint8).expand(WORLDS, -1)[..., None, None, None]
        seen = time.expand(-1, -1, 2, 2, 3)
        return batch.set("pixels", seen[:, :-1].clone()).set(("next", "pixels"), seen[:, 1:].clone())

    kept = replay()
    kept.extend(images(0, 3))
    kept.extend(images(3, 5))
    with pytest.raises(UserError, match="world 0 does not"):
        kept.extend(images(50, 52))


def test_an_empty_replay_begins_with_anything() -> None:
    kept = replay()
    kept.extend(steps(0, 5))
    kept.empty()
    kept.extend(steps(20, 25))
    with pytest.raises(UserError, match="world 0 does not"):
        kept.extend(steps(26, 30))
    kept.following.forget()
    kept.extend(steps(26, 30))


def test_what_is_no_number_goes_on_as_anything() -> None:
    """Tasks of one's own may make some; a run says so elsewhere."""
    kept, broken = replay(), steps(0, 5)
    broken["next", "state"][1, -1] = torch.nan
    kept.extend(broken)
    kept.extend(steps(5, 10))


def test_a_collector_s_batch_that_is_left_out_is_noticed(small_env) -> None:
    from torchrl.collectors import Collector

    env = small_env(WORLDS, observations=("state",), episode_length=10)
    options = {"policy": None, "frames_per_batch": 4 * WORLDS, "total_frames": 32 * WORLDS}
    batches = [batch.clone() for batch in Collector(env, **options)]
    kept = replay()
    for batch in batches:
        kept.extend(batch)
    kept = replay()
    kept.extend(batches[0])
    with pytest.raises(UserError, match="a batch must go on"):
        kept.extend(batches[2])
