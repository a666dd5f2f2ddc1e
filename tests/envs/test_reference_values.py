"""The arm does what the reference environment was measured to do, with the default configuration."""

from __future__ import annotations

import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.config import HOME
from franka_wm.envs.tasks import goal_distance, reach_reward


@pytest.fixture(scope="module")
def env() -> FrankaEnv:
    """The default configuration without noise; six worlds, one for each swept joint."""
    return FrankaEnv(
        FrankaConfig(pose_noise=0.0, observations=("state", "joint_target")), num_envs=6, device="cpu"
    )


def test_home_pose(env: FrankaEnv) -> None:
    observation = env.reset()
    torch.testing.assert_close(env.joint_positions(), torch.tensor(HOME).expand(6, 7), atol=1e-6, rtol=0)
    torch.testing.assert_close(env.joint_targets(), env.joint_positions(), atol=0, rtol=0)
    assert (observation["state"][:, 7:14] == 0).all()
    home = torch.tensor([0.427, 0.0, 0.517]).expand(6, 3)
    torch.testing.assert_close(env.tool_position(), home, atol=5e-4, rtol=0)


def test_reward_at_home(env: FrankaEnv) -> None:
    env.reset()
    torch.testing.assert_close(env.goal_distance(), torch.full((6,), 0.1994), atol=1e-4, rtol=0)
    idle = env.reward(torch.zeros(6, 7))
    torch.testing.assert_close(idle, torch.full((6, 1), -0.1968), atol=1e-4, rtol=0)
    assert torch.allclose(env.reward(torch.ones(6, 7)), idle - 0.01, atol=1e-6)


def test_sweep_of_each_joint(env: FrankaEnv) -> None:
    """Six +1 steps. The published ranges, plus 2 cm: servo and integrator differ in detail."""
    actions = torch.zeros(6, 6, 7)
    actions[torch.arange(6), :, torch.arange(6)] = 1.0
    tool = env.rollout_actions(actions)["tool"]
    moved = (tool[:, -1] - tool[:, 0]).norm(dim=-1)
    assert ((moved[:4] > 0.41 - 0.02) & (moved[:4] < 0.54 + 0.02)).all(), moved
    assert ((moved[4:] > 0.17 - 0.02) & (moved[4:] < 0.24 + 0.02)).all(), moved


def test_return_of_doing_nothing(env: FrankaEnv) -> None:
    """−9.8 for 50 steps; the uncompensated arm sags away from the goal by 2 cm, which costs a little more."""
    rewards = env.rollout_actions(torch.zeros(6, 50, 7))["reward"]
    assert ((rewards.sum(1) + 9.8).abs() < 0.3).all(), rewards.sum(1)


def test_reward_of_the_kernel_is_the_function_in_torch(env: FrankaEnv) -> None:
    actions = 3 * torch.randn(6, 20, 7, generator=torch.Generator().manual_seed(0))  # many are clipped
    played = env.rollout_actions(actions, seed=1)
    expected = reach_reward(played["state"][:, 1:], actions, action_penalty=env.config.action_penalty)
    torch.testing.assert_close(played["reward"], expected, atol=2e-6, rtol=0)
    assert torch.equal(goal_distance(played["state"]), (played["tool"] - env.goal.unsqueeze(1)).norm(dim=-1))


def test_actions_move_targets_by_their_scale_and_stay_in_the_limits(env: FrankaEnv) -> None:
    env.reset(seed=0)
    start = env.joint_targets()
    actions = torch.zeros(6, 7)
    actions[0, 0], actions[1, 1], actions[2, 2] = 1.0, -0.5, 7.0
    env.step(env.reset(seed=0).set("action", actions))
    moved = env.joint_targets() - start
    assert torch.allclose(moved, env.config.action_scale * actions.clamp(-1, 1), atol=1e-6)
    env.rollout_actions(torch.ones(6, 40, 7))
    torch.testing.assert_close(env.joint_targets(), env.kinematics.upper.expand(6, 7), atol=0, rtol=0)
    env.rollout_actions(-torch.ones(6, 40, 7))
    torch.testing.assert_close(env.joint_targets(), env.kinematics.lower.expand(6, 7), atol=0, rtol=0)


@pytest.mark.parametrize("compensated", [True, False])
def test_gravity_compensation(compensated: bool, small_env) -> None:
    """With it the idle arm holds its pose, as the real one does; without it it sags by 0.03 rad."""
    env = small_env(2, substeps=4, pose_noise=0.0, gravity_compensation=compensated)
    joints = env.rollout_actions(torch.zeros(2, 12, 7))["joint_q"]
    drift = (joints[:, -1] - joints[:, 0]).abs().max()
    assert (drift < 0.007) if compensated else (0.015 < drift < 0.06), drift


def test_featherstone_moves_the_arm_alike(small_env) -> None:
    """The other solver: same servo, same motion to 5 mm at the tool."""
    actions = 0.3 * torch.ones(1, 6, 7)
    played = [
        small_env(1, solver=solver, substeps=32, pose_noise=0.0, gravity_compensation=False).rollout_actions(
            actions
        )["tool"][0]
        for solver in ("mujoco", "featherstone")
    ]
    assert (played[0][-1] - played[0][0]).norm() > 0.05
    torch.testing.assert_close(played[0], played[1], atol=0.005, rtol=0)


def test_featherstone_compensates_gravity_as_well(small_env) -> None:
    env = small_env(1, solver="featherstone", substeps=32, pose_noise=0.0)
    joints = env.rollout_actions(torch.zeros(1, 12, 7))["joint_q"]
    assert (joints[:, -1] - joints[:, 0]).abs().max() < 0.007
