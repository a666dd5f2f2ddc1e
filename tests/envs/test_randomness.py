"""Episodes depend on seed, world and episode number; on nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from franka_wm.envs import FrankaEnv

RESETS = {"goal_sampling": "reachable", "episode_length": 5}


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(4, **RESETS)


@pytest.fixture(scope="module")
def twin(small_env) -> FrankaEnv:
    return small_env(4, **RESETS)


def starts(env: FrankaEnv, seed: int, episodes: int) -> torch.Tensor:
    """Joint angles and goal at the start of successive episodes, (episodes, N, 10)."""
    found = []
    for k in range(episodes):
        observation = env.reset(seed=seed if k == 0 else None)
        found.append(torch.cat([observation["state"][:, :7], observation["goal"]], -1))
    return torch.stack(found)


def test_worlds_do_not_depend_on_their_number(small_env, random_actions) -> None:
    played = []
    for n in (2, 5):
        env = small_env(n, **RESETS)
        played.append(env.rollout_actions(random_actions(n, 12), seed=7)[:2])
    for key in ("state", "reward", "done"):
        assert torch.equal(played[0][key], played[1][key]), key


def test_repeats_are_exact(env: FrankaEnv, twin: FrankaEnv, random_actions) -> None:
    actions = random_actions(4, 12)
    first = env.rollout_actions(actions, seed=7)
    assert torch.equal(first["state"], env.rollout_actions(actions, seed=7)["state"])
    assert torch.equal(first["state"], twin.rollout_actions(actions, seed=7)["state"])


def test_seeds(env: FrankaEnv) -> None:
    first = starts(env, 3, 4)
    assert torch.equal(first, starts(env, 3, 4))
    other = starts(env, 4, 4)
    # Every angle and goal of every episode of every world is another one.
    everything = torch.cat([first, other]).flatten(0, 1)
    for column in everything.unbind(-1):
        assert column.unique().numel() == column.numel()


def test_seeds_beyond_32_bits(env: FrankaEnv) -> None:
    for seed in (-1, 2**31, 2**40 + 5):
        assert torch.isfinite(starts(env, seed, 1)).all()


def test_set_seed_is_reset_with_a_seed(env: FrankaEnv) -> None:
    env.set_seed(11)
    first = env.reset()["state"]
    assert torch.equal(first, env.reset(seed=11)["state"])


def test_seed_given_at_construction(small_env, env: FrankaEnv) -> None:
    fresh = small_env(4, seed=13, **RESETS)
    assert torch.equal(fresh.reset()["state"], env.reset(seed=13)["state"])


def test_initial_poses_are_uniform_around_home(small_env) -> None:
    env = small_env(500)
    home = small_env(1, pose_noise=0.0).reset()["state"][0, :7]
    noise = env.reset(seed=0)["state"][:, :7] - home
    half = env.config.pose_noise
    assert noise.abs().max() <= half + 1e-6
    assert (noise.mean(0).abs() < 4 * half / (3 * 500) ** 0.5).all()
    torch.testing.assert_close(noise.std(0), torch.full((7,), half / 3**0.5), rtol=0.1, atol=0)
    correlation = torch.corrcoef(noise.T) - torch.eye(7)
    assert correlation.abs().max() < 0.2


def test_goals_vary_and_can_be_reached(small_env) -> None:
    env = small_env(200, goal_sampling="reachable")
    goals = torch.cat([env.reset(seed=0)["goal"], env.reset()["goal"]])
    assert goals.unique(dim=0).shape[0] == 400
    assert (goals.std(0) > 0.1).all()
    assert (goals[:, 2] > 0.10).all() and (goals[:, :2].norm(dim=-1) > 0.25).all()
    kinematics = env.kinematics
    best = torch.full((400,), torch.inf)
    generator = torch.Generator().manual_seed(0)
    for _ in range(8):  # damped least squares may meet a joint limit: some start reaches each goal
        low, high = kinematics.lower, kinematics.upper
        start = low + (high - low) * torch.rand(400, 7, generator=generator)
        reached = kinematics.forward(kinematics.solve(goals, start, iterations=40))
        best = torch.minimum(best, (reached - goals).norm(dim=-1))
    assert best.max() < 5e-3


def test_fixed_goal_is_the_config_s(small_env) -> None:
    env = small_env(2, goal=(0.4, 0.1, 0.3))
    observation = env.reset()
    expected = torch.tensor([0.4, 0.1, 0.3]).expand(2, 3)
    assert torch.equal(observation["goal"], expected) and torch.equal(env.goal, expected)
    torch.testing.assert_close(observation["state"][:, 17:], observation["state"][:, 14:17] - expected)


def test_masked_reset_leaves_the_others_untouched(env: FrankaEnv, twin: FrankaEnv, random_actions) -> None:
    actions = random_actions(4, 8).transpose(0, 1)
    for one in (env, twin):
        one.reset(seed=5)
        for action in actions[:3]:
            last = one.step(TensorDict({"action": action}, batch_size=[4]))
    mask = torch.tensor([[False], [True], [False], [True]])
    before = env.state_observation()
    fresh = env.reset(last["next"].clone().set("_reset", mask))
    same, new = ~mask.squeeze(-1), mask.squeeze(-1)
    assert torch.equal(fresh["is_init"], mask)
    assert torch.equal(fresh["state"][same], before[same])
    assert (fresh["state"][new, 7:14] == 0).all()
    assert not torch.equal(fresh["goal"][new], twin.goal[new])
    for k, action in enumerate(actions[3:5]):
        ours, theirs = (
            one.step(TensorDict({"action": action}, batch_size=[4]))["next"] for one in (env, twin)
        )
        for key in ("state", "joint_target", "goal", "reward", "done"):
            assert torch.equal(ours[key][same], theirs[key][same]), (key, k)
    # At step 5 the untouched worlds are out of time, the restarted ones are not.
    assert torch.equal(ours["done"].squeeze(-1), same)
    # The restarted worlds are in their episode 1, as if both had been restarted there.
    assert torch.equal(fresh["state"][new], starts_of_episode(twin, 5, 1)[new])


def starts_of_episode(env: FrankaEnv, seed: int, number: int) -> torch.Tensor:
    observation = env.reset(seed=seed)
    for _ in range(number):
        observation = env.reset()
    return observation["state"]


def test_each_purpose_draws_from_a_stream_of_its_own(root: Path) -> None:
    """But for a task's goal that is chosen anew as its uniform numbers were."""
    rng = re.compile(r"episode_rng\(seed\[0\], seed\[1\] \+ world, [^,]+, (\d+)\)")
    used = [
        int(n) for file in (root / "franka_wm" / "envs").rglob("*.py") for n in rng.findall(file.read_text())
    ]
    assert sorted(used) == sorted([*range(16), 7])
