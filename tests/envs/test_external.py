"""Other simulators' environments under the same keys."""

from __future__ import annotations

import multiprocessing
import os
import signal
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from franka_wm.envs.external import ExternalEnv, _ToDevice, check_external
from franka_wm.envs.external_config import ExternalConfig, external_config
from franka_wm.errors import UserError
from franka_wm.training.spaces import Spaces

gymnasium = pytest.importorskip("gymnasium")


def test_moves_and_statistics() -> None:
    env = ExternalEnv(ExternalConfig(kind="gym", name="CartPole-v1"), num_envs=3, seed=1)
    assert Spaces.of_env(env) == Spaces(
        observation_sizes={"state": 4}, num_actions=2, episode_length=500, terminates=True
    )
    torch.manual_seed(0)
    data = env.rollout(80, break_when_any_done=False)
    done = data["next", "done"]
    assert data["state"].dtype == torch.float32 and data["action"].shape == (3, 80)
    assert done.any() and data["is_init"].sum() >= 3
    # An episode's return is its length: one for each step.
    numbers = env.statistics()
    assert numbers["episodes"] == done.sum()
    assert numbers["return"] == pytest.approx(numbers["length"])
    # Each episode that ended began at an is_init: from there to its end are as many steps as the last count says.
    world, last = done[..., 0].nonzero()[0].tolist()
    assert data["next", "step_count"][world, last] == last + 1
    assert env.statistics() == {"episodes": 0}, (
        "nothing has ended since: no means, which a run would log as 0"
    )


def test_continuous_actions_fill_their_range() -> None:
    """Pendulum's torque is ±2 N·m; here actions are in [−1, 1]."""
    env = ExternalEnv(ExternalConfig(kind="gym", name="Pendulum-v1", episode_length=5), num_envs=2)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    assert (low == -1).all() and (high == 1).all()
    tensordict = env.reset(seed=0)
    start = tensordict["state"].clone()
    full = env.step(tensordict.clone().set("action", torch.ones(2, 1)))["next", "state"]
    angle = torch.atan2(start[:, 1], start[:, 0])
    expected = (
        start[:, 2] + (15 * torch.sin(angle) + 3 * 2.0) * 0.05
    )  # of Gymnasium's documentation: g=10, m=l=1
    torch.testing.assert_close(full[:, 2], expected.clamp(-8, 8), rtol=1e-4, atol=1e-4)
    data = env.rollout(12, break_when_any_done=False)
    assert data["next", "truncated"].any() and not data["next", "terminated"].any()


def test_observations_by_name() -> None:
    pytest.importorskip("dm_control")
    config = external_config(
        {
            "kind": "dm_control",
            "name": "reacher",
            "task": "hard",
            "frame_skip": 2,
            "observations": {"state": ["position", "velocity"], "target": "to_target"},
        }
    )
    env = ExternalEnv(config, num_envs=2)
    assert Spaces.of_env(env).observation_sizes == {"state": 4, "target": 2}


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"kind": "gym", "name": "Nope-v1"}, "Nope"),
        ({"kind": "gym", "name": "CartPole-v1", "observations": {"state": ["wheel"]}}, "wheel"),
        ({"kind": "gym", "name": "CartPole-v1", "observations": {"state": []}}, "must be keys with lists"),
        ({"kind": "gym", "name": "CartPole-v1", "observations": {"state": 3}}, "must be keys with lists"),
        (
            {"kind": "gym", "name": "CartPole-v1", "observations": {"reward": ["observation"]}},
            "called 'reward'",
        ),
        ({"kind": "gym", "name": "CartPole-v1", "observations": {"a.b": ["observation"]}}, "called 'a.b'"),
        ({"kind": "gym", "name": "FrozenLake-v1"}, "no vector of real numbers"),
        ({"kind": "gym", "name": "CartPole-v1", "frame_skip": 0}, "frame_skip"),
        ({"kind": "gym", "name": "CartPole-v1", "wheels": 2}, "wheels"),
        ({"kind": "atari", "name": "Pong"}, "atari"),
    ],
)
def test_refusals(values: dict, named: str) -> None:
    with pytest.raises(UserError) as caught:
        ExternalEnv(external_config(values), num_envs=1)
    assert named in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "actions",
    [
        gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        gymnasium.spaces.Box(-3e38, 3e38, (2,), np.float32),  # finite, but not how wide it is
        gymnasium.spaces.Box(-1.0, 1.0, (2, 2), np.float32),
        gymnasium.spaces.MultiDiscrete([2, 3]),
        gymnasium.spaces.MultiBinary(3),
    ],
    ids=["unbounded", "wide", "matrix", "several", "bits"],
)
def test_actions_that_no_model_chooses_are_one_line(actions: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bits were taken for one choice of two, a matrix for a vector of its last side."""

    class Odd(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

        def __init__(self) -> None:
            self.action_space = actions

    monkeypatch.setitem(
        gymnasium.registry, "Odd-v0", gymnasium.envs.registration.EnvSpec("Odd-v0", entry_point=Odd)
    )
    config = ExternalConfig(kind="gym", name="Odd-v0")
    for make in (check_external, ExternalEnv):
        with pytest.raises(UserError, match="its actions must be one vector with finite bounds"):
            make(config)


def test_worlds_stay_on_the_cpu() -> None:
    """With a device that every machine has in place of a GPU."""
    device = torch.device("meta")
    env = ExternalEnv(ExternalConfig(kind="gym", name="CartPole-v1"), num_envs=3, device=device)
    assert (env.base_env.device, env.device) == (torch.device("cpu"), device)


def test_worlds_are_given_what_they_read_alone() -> None:
    """A policy's memory would be copied from the device at every step."""
    given = {
        key: torch.zeros(3, 1)
        for key in ("action", "step_count", "episode_reward", "state", "context", "plan")
    }
    read = _ToDevice("meta", orig_device="cpu").inv(
        TensorDict({**given, "done": torch.zeros(3, 1, dtype=torch.bool)}, [3])
    )
    assert {*read.keys()} == {"action", "step_count", "episode_reward", "done"}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("workers", [0, 1])
def test_episodes_end_and_begin_on_the_gpu_as_on_the_cpu(workers: int) -> None:
    """The simulator stays on the CPU, also for the masks of a reset."""
    rollouts = []
    for device in ("cpu", "cuda"):
        env = ExternalEnv(
            ExternalConfig(kind="gym", name="CartPole-v1"),
            num_envs=3,
            seed=1,
            device=torch.device(device),
            workers=workers,
        )
        tensordict, rows = env.reset(), []
        for _ in range(30):
            action = torch.ones(3, dtype=torch.int64, device=device)  # falls within a dozen steps
            step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            rows.append(step["next", "state"].cpu())
            assert step["next", "state"].device.type == tensordict["state"].device.type == device
        rollouts.append(torch.stack(rows))
        env.close()
    torch.testing.assert_close(*rollouts)


@pytest.mark.slow
def test_processes_of_their_own_play_the_same_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes are drawn and end as in one process after the other, at different times in different worlds."""
    import multiprocessing

    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)  # fewer are taken where there are more than one
    said: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", said.append)
    env = ExternalEnv(ExternalConfig(kind="gym", name="Pendulum-v1"), num_envs=2, workers=1)
    assert env.step(env.rand_action(env.reset()))["action"].shape == (2, 1)
    assert said == []  # the learner keeps its own
    env.close()
    config = ExternalConfig(kind="gym", name="CartPole-v1", episode_length=30)
    rollouts = []
    for workers in (0, 2):
        env = ExternalEnv(config, num_envs=4, seed=3, workers=workers)
        assert len(multiprocessing.active_children()) == workers
        carry, steps = env.reset(), []
        for _ in range(40):
            step, carry = env.step_and_maybe_reset(carry.set("action", torch.tensor([0, 1, 1, 0])))
            steps.append(step)
        carry = env.reset(carry.set("_reset", torch.tensor([[True], [False], [False], [True]])))
        steps.append(env.step(carry.set("action", torch.tensor([1, 0, 1, 0]))))
        rollouts.append((torch.stack(steps).to_tensordict(), env.statistics()))
        env.close()
    (one, told), (other, said) = rollouts
    ends = one["next", "done"].sum(1)
    assert told == said and told["episodes"] == ends.sum() and ((ends > 0) & (ends < 4)).any()
    for key in (
        "state",
        "is_init",
        ("next", "state"),
        ("next", "reward"),
        ("next", "done"),
        ("next", "step_count"),
    ):
        assert torch.equal(one[key], other[key]), key
    assert not multiprocessing.active_children()


def test_a_configuration_that_names_too_much_or_too_little_is_one_line() -> None:
    with pytest.raises(UserError, match=r"env\.task=hard: Gymnasium's environments have one"):
        ExternalConfig(kind="gym", name="CartPole-v1", task="hard")
    with pytest.raises(UserError, match=r"env\.kind and env\.name: both are needed"):
        external_config({"kind": "gym"})


def test_signals_to_the_whole_group_are_not_for_workers() -> None:
    """Ctrl-C is sent to all in it: who has started them could not save what it is at without its worlds."""
    group = os.getpgrp()
    env = ExternalEnv(ExternalConfig(kind="gym", name="Pendulum-v1"), num_envs=2, workers=2)
    try:
        groups = [os.getpgid(process.pid) for process in multiprocessing.active_children()]  # type: ignore[arg-type]
        assert len(groups) == 2 and group not in groups and os.getpgrp() == group
        env.rollout(3)
    finally:
        env.close()
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("asked", ["step", "reset", "set_seed"])
def test_a_worker_that_is_killed_is_one_line(asked: str) -> None:
    """Whatever TorchRL notices it by."""
    env = ExternalEnv(ExternalConfig(kind="gym", name="Pendulum-v1"), num_envs=4, workers=2)
    tensordict = env.rand_action(env.reset())
    process = multiprocessing.active_children()[0]
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with pytest.raises(UserError, match=r"collector\.workers=2: a worker has died, .* resume=FOLDER"):
        env.set_seed(3) if asked == "set_seed" else env.step(tensordict) if asked == "step" else env.reset()
    env.close()  # as collectors do on the way out
    for one in multiprocessing.active_children():
        one.join(10)
    assert not multiprocessing.active_children()
