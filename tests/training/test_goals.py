"""Runs whose model has heads for goals: who acts, who proposes, and what is refused."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from franka_wm.errors import UserError
from franka_wm.policies.planner import GoalGuide
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.spaces import Spaces


def test_a_policy_towards_goals_acts_where_their_images_are_seen(settled) -> None:
    words = (
        "scale=smoke",
        "device=cpu",
        "env=reach_goal_image",
        "model=lewm",
        "planner=cem",
        "env.image_size=16",
    )
    run = settled(
        *words, "model.goal_policy_coef=1", "planner.num_policy_samples=2", "objective.steps_weight=1"
    )
    with pytest.raises(UserError, match=r"steps_weight=1: needs model\.goal_steps_coef above 0"):
        check(run)
    run = settled(*words, "model.goal_policy_coef=1", "planner.num_policy_samples=2")
    env = build.make_env(run, num_envs=2)
    model = build.make_model(run, env).eval()
    policies = build.make_agent_policies(run, model, env, Spaces.of_env(env))
    assert isinstance(policies["planner"].prior, GoalGuide) and "goal_pixels" in policies["policy"].in_keys
    seen = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert not torch.equal(
            policies["policy"](seen.clone())["action"], policies["noop"](seen.clone())["action"]
        )
        policies["planner"](seen)
    model = build.make_model(settled(*words), env)
    assert "policy" not in build.make_agent_policies(run, model, env, Spaces.of_env(env))


SMALL = ("scale=smoke", "device=cpu", "model=lewm", "planner=cem", "env.image_size=16")


def test_a_policy_towards_goals_gathers_where_it_is_asked_to(settled) -> None:
    words = (*SMALL, "env=reach_goal_image")
    assert settled(*words, "model.goal_policy_coef=1").actor == "random"  # by auto, as without
    run = settled(*words, "model.goal_policy_coef=1", "collector.policy=policy")
    check(run)
    assert run.actor == "policy"
    without = settled(*words, "collector.policy=policy")
    with pytest.raises(UserError, match=r"of auto, planner, .*expert, or model\.goal_policy_coef above 0"):
        check(without)
    with pytest.raises(UserError, match="needs goal_pixels"):
        check(settled(*SMALL, "env=reach_pixels", "model.goal_policy_coef=1", "collector.policy=policy"))
