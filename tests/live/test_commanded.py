"""The path that a plan commands is where the environment's own targets go."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from franka_wm.live.commanded import KinematicModel, commanded_path, kinematic_planner, planned_path


@pytest.mark.parametrize("mode", ["joint_delta", "joint_position", "ee_delta"])
def test_it_is_what_the_environment_makes_of_the_same_actions(small_env, mode: str) -> None:
    env = small_env(3, action_mode=mode, action_scale=0.05, ee_scale=0.02)
    now = env.reset(seed=1)
    plan = 1.5 * torch.randn(3, 5, env.action_dim, generator=torch.Generator().manual_seed(0))
    path = commanded_path(env, plan)
    assert path.shape == (3, 6, 3)
    torch.testing.assert_close(path[:, 0], env.kinematics.forward(env.joint_targets()))
    for t in range(5):
        now = env.step_and_maybe_reset(now.set("action", plan[:, t]))[1]
        commanded = env.kinematics.forward(env.joint_targets())
        torch.testing.assert_close(path[:, t + 1], commanded, rtol=0, atol=2e-4)


@pytest.mark.parametrize("mode", ["joint_delta", "joint_position", "ee_delta"])
def test_a_gripper_does_not_move_the_tool(small_env, mode: str) -> None:
    """Its command is the last number of an action, and its place the last of the targets."""
    options = {"action_mode": mode, "action_scale": 0.05, "ee_scale": 0.02}
    arm, hand = small_env(2, **options), small_env(2, gripper=True, **options)
    plan = torch.randn(2, 4, hand.action_dim, generator=torch.Generator().manual_seed(0))
    for env in (arm, hand):
        env.reset(seed=1)
    path = planned_path(hand, TensorDict({"plan": plan}, [2]))
    assert path is not None and path.equal(commanded_path(arm, plan[..., : arm.action_dim]))


def test_it_stays_within_the_joint_limits(small_env) -> None:
    env = small_env(1, action_scale=0.5)
    env.reset(seed=0)
    path = commanded_path(env, torch.ones(1, 30, 7))
    torch.testing.assert_close(path[0, -1], env.kinematics.forward(env.kinematics.upper))


def test_the_planner_without_a_checkpoint_closes_in_on_the_goal(small_env) -> None:
    env = small_env(2, goal_sampling="reachable", action_scale=0.085, limit_velocity=True)
    torch.manual_seed(0)
    policy = kinematic_planner(env)
    now = env.reset(seed=3)
    first = env.goal_distance()
    for _ in range(25):
        now = env.step_and_maybe_reset(policy(now))[1]
    assert (env.goal_distance() < 0.05).all(), (first, env.goal_distance())


def test_its_score_prefers_nearer_and_calmer_plans(small_env) -> None:
    env = small_env(1)
    now = env.reset(seed=0)
    model = KinematicModel(env)
    z = model.encode(now)
    here = TensorDict(
        {"joint_target": now["joint_target"], "goal": env.kinematics.forward(now["joint_target"])}, [1]
    )
    at_goal = model.encode(here)

    def score(start: torch.Tensor, actions: torch.Tensor) -> float:
        latents = [start]
        for action in actions.unbind(1):
            latents.append(model.next(latents[-1], action))
        return float(model.score(torch.stack(latents, 1).unsqueeze(1), actions.unsqueeze(1)))

    rest, wave = torch.zeros(1, 3, 7), torch.full((1, 3, 7), 0.5)
    assert score(at_goal, rest) == pytest.approx(0.0, abs=1e-5)
    assert score(at_goal, wave) < score(at_goal, rest)
    assert score(z, rest) < score(at_goal, rest)
