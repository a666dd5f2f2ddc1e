"""Policies that need no learning do what they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.discretize import discrete_action_table
from franka_wm.errors import UserError
from franka_wm.policies.scripted import DiscretePolicy, IKPolicy, NoopPolicy, SmoothRandomPolicy
from franka_wm.training import build


@pytest.fixture(scope="module")
def env(settled) -> FrankaEnv:
    """The reach preset, as train.py builds it."""
    return build.make_env(settled("env=reach", "device=cpu"), num_envs=16)


def first(num_envs: int, is_init: bool = False) -> TensorDict:
    return TensorDict({"is_init": torch.full((num_envs, 1), is_init)}, batch_size=[num_envs])


def test_noop() -> None:
    action = NoopPolicy()(first(4))["action"]
    assert action.shape == (4, 7) and action.dtype == torch.float32 and not action.any()


@pytest.mark.parametrize("env_name", ["reach", "lift"])
def test_noop_leaves_poses_as_they_are(settled, env_name: str) -> None:
    """Of poses 0 is the middle of the limits: there the arm would swing away."""
    env: Any = build.make_env(
        settled(f"env={env_name}", "device=cpu", "env.action_mode=joint_position"), num_envs=2
    )
    noop, observation = build.make_scripted_policies(env)["noop"], env.reset(seed=0)
    before, targets = env.joint_positions(), env.joint_targets()[:, :7]
    for _ in range(10):
        observation = env.step(noop(observation))["next"]
    torch.testing.assert_close(env.joint_targets()[:, :7], targets, atol=1e-5, rtol=0)
    assert (env.joint_positions() - before).abs().max() < 0.01
    with pytest.raises(UserError, match="policy=noop reads joint_target"):
        noop(first(2))


def test_smooth_random_is_smooth_bounded_and_starts_anew() -> None:
    policy = SmoothRandomPolicy(smoothness=0.8, generator=torch.Generator().manual_seed(0))
    actions = torch.stack([policy(first(300))["action"] for _ in range(30)], 1)
    assert actions.abs().max() == 1.0

    def correlation(a: torch.Tensor, b: torch.Tensor) -> float:
        return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1].item()

    assert correlation(actions[:, :-1], actions[:, 1:]) == pytest.approx(0.8, abs=0.06)
    assert abs(correlation(actions[:, :-10], actions[:, 10:])) < 0.2
    spread = actions.transpose(0, 1).flatten(1).std(1)
    torch.testing.assert_close(spread, spread.mean().expand(30), rtol=0.1, atol=0)
    # A new episode forgets; the other worlds do not.
    mixed = first(300)
    mixed["is_init"][:150] = True
    following = policy(mixed)["action"]
    assert abs(correlation(actions[:150, -1], following[:150])) < 0.1
    assert correlation(actions[150:, -1], following[150:]) == pytest.approx(0.8, abs=0.08)


def test_smooth_random_takes_another_number_of_worlds() -> None:
    policy = SmoothRandomPolicy()
    assert policy(first(4))["action"].shape == (4, 7)
    assert policy(first(9))["action"].shape == (9, 7)


def test_impossible_smoothness() -> None:
    with pytest.raises(UserError):
        SmoothRandomPolicy(smoothness=1.0)


def test_ik_reaches_every_goal(env: FrankaEnv) -> None:
    ik = IKPolicy(env.kinematics, env.config)
    observation = env.reset(seed=0)
    start = env.goal_distance()
    for _ in range(30):
        observation = env.step(ik(observation))["next"]
    assert start.mean() > 0.1
    assert observation["state"][:, 17:].norm(dim=-1).max() < 0.01
    assert observation["success"].all()


@pytest.fixture(scope="module")
def moving(settled) -> Callable[..., Any]:
    """The reach preset with numbered moves, as train.py builds it for MuZero."""

    def make(**changes: Any) -> Any:
        cfg = settled("env=reach", "device=cpu", "model=muzero", "planner=gumbel")
        return build.make_env(cfg, num_envs=16, **changes)

    return make


def final_distance(env: Any, policy: Any, steps: int) -> torch.Tensor:
    observation = env.reset(seed=0)
    for _ in range(steps):
        observation = env.step(policy(observation))["next"]
    return observation["state"][:, 17:].norm(dim=-1)


def test_ik_with_discrete_actions_is_better_than_the_nearest_row_of_the_table(moving) -> None:
    env = moving()
    reached = final_distance(env, build.make_scripted_policies(env)["ik"], 40)
    rounded = DiscretePolicy(IKPolicy(env.kinematics, env.config), env.transform.table)
    assert reached.mean() < 0.01 and reached.max() < 0.025
    assert reached.mean() < 0.6 * final_distance(env, rounded, 40).mean()


def test_ik_with_moves_of_the_tool_ends_where_no_move_helps(moving) -> None:
    env = moving(action_mode="ee_delta")
    reached = final_distance(env, build.make_scripted_policies(env)["ik"], 30)
    assert reached.max() < 0.06  # of a grid of 5 cm, 4.3 cm to the farthest point


def test_ik_with_moves_to_poses_takes_the_best(moving) -> None:
    """There, a move is a pose, whatever was before."""
    env = moving(action_mode="joint_position")
    observation, k = env.reset(seed=0), env.kinematics
    move = build.make_scripted_policies(env)["ik"](observation)["action"]
    poses = k.lower + (env.transform.table + 1) / 2 * (k.upper - k.lower)
    distances = (k.forward(poses) - observation["goal"].unsqueeze(1)).norm(dim=-1)
    assert torch.equal(move, distances.argmin(1))
    assert "noop" not in build.make_scripted_policies(env)  # each is some pose


def test_doing_nothing_with_discrete_actions_leaves_the_fingers_open() -> None:
    """Where they begin; a command of half the width lies between the two that there are."""
    table = discrete_action_table(8, gripper=True)
    assert DiscretePolicy(NoopPolicy(8), table)(first(2))["action"].tolist() == [14, 14]


def test_ik_needs_the_targets() -> None:
    with pytest.raises(UserError, match="joint_target"):
        IKPolicy(None, FrankaConfig())(TensorDict({"goal": torch.zeros(1, 3)}, batch_size=[1]))  # type: ignore[arg-type]


def test_inverse_kinematics_of_the_tool_alone_refuses_a_gripper() -> None:
    with pytest.raises(UserError, match="task=lift has; use policy=expert"):
        IKPolicy(None, FrankaConfig(task="lift"))  # type: ignore[arg-type]
