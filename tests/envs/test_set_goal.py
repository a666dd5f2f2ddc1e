"""``set_goal``: goals moved by hand, in the middle of an episode."""

from __future__ import annotations

import pytest
import torch

from franka_wm.envs.tasks import goal_distance, reach_reward
from franka_wm.errors import UserError

N = 3
GOALS = torch.tensor([[0.35, 0.2, 0.5], [0.45, -0.2, 0.4], [0.3, 0.0, 0.7]])


def zeros(env) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.action_dim)


def test_what_is_observed_rewarded_and_judged_follows_the_new_goal(small_env, random_actions) -> None:
    env = small_env(N, goal_sampling="reachable")
    root = env.reset(seed=0)
    for t in range(3):
        root = env.step_and_maybe_reset(root.set("action", random_actions(N, 3)[:, t]))[1]
    joints = env.joint_positions()
    now = env.set_goal(GOALS)
    assert torch.equal(now["goal"], GOALS)
    assert torch.equal(env.goal, GOALS)
    assert torch.equal(env.joint_positions(), joints), "the arm must not move"
    torch.testing.assert_close(now["state"][:, 17:], env.tool_position() - GOALS)
    assert not now["is_init"].any()

    step, _ = env.step_and_maybe_reset(now.set("action", zeros(env)))
    after = step["next"]
    assert torch.equal(after["goal"], GOALS)
    torch.testing.assert_close(after["reward"], reach_reward(after["state"], zeros(env)))
    assert torch.equal(after["success"].squeeze(-1), goal_distance(after["state"]) < 0.05)


def test_a_goal_at_the_tool_is_a_success(small_env) -> None:
    env = small_env(N, goal_sampling="reachable")
    env.reset(seed=0)
    now = env.set_goal(env.tool_position())
    assert env.step(now.set("action", zeros(env)))["next", "success"].all()


def test_it_lasts_until_the_next_episode_of_a_world(small_env) -> None:
    env, other = (small_env(N, goal_sampling="reachable", episode_length=4) for _ in range(2))
    root, expected = env.reset(seed=1), other.reset(seed=1)
    root = env.set_goal(GOALS)
    for _ in range(4):
        assert torch.equal(root["goal"], GOALS)
        root = env.step_and_maybe_reset(root.set("action", zeros(env)))[1]
        expected = other.step_and_maybe_reset(expected.set("action", zeros(env)))[1]
    assert root["is_init"].all()
    assert torch.equal(root["goal"], expected["goal"]), "the second episode's goal is drawn as ever"


def test_a_moving_goal_goes_on_from_there(small_env) -> None:
    env, other = (small_env(N, task="track", track_period=1.0, goal_sampling="reachable") for _ in range(2))
    root, untouched = env.reset(seed=1), other.reset(seed=1)
    shift = torch.tensor([0.05, -0.1, 0.02])
    root = env.set_goal(root["goal"] + shift)
    for _ in range(6):
        root = env.step_and_maybe_reset(root.set("action", zeros(env)))[1]
        untouched = other.step_and_maybe_reset(untouched.set("action", zeros(env)))[1]
        torch.testing.assert_close(root["goal"], untouched["goal"] + shift, rtol=0, atol=1e-6)


def test_a_circle_that_touches_the_ground_passes_where_the_goal_was_set(small_env) -> None:
    """Also where it is set while it is kept above the ground: after one turn it is there again."""
    env = small_env(N, task="track", track_radius=0.6, track_period=0.4, goal_sampling="reachable")
    turn = round(0.4 * env.config.fps)
    root = env.reset(seed=0)
    for _ in range(turn):
        if (kept := root["goal"][:, 2] == 0.05).any():
            break
        root = env.step_and_maybe_reset(root.set("action", zeros(env)))[1]
    assert kept.any()
    root = env.set_goal(GOALS)
    for _ in range(turn):
        before, root = root["goal"], env.step_and_maybe_reset(root.set("action", zeros(env)))[1]
        assert ((root["goal"] - before).norm(dim=-1) <= 0.6 * 2 * torch.pi / turn + 1e-5).all(), "it jumps"
    torch.testing.assert_close(root["goal"], GOALS, rtol=0, atol=1e-5)
    for low, said in ((0.04, "has a goal 0.04 m high; this task keeps them at 0.05 m"), (-5.0, "-5 m")):
        with pytest.raises(UserError, match=said):
            env.set_goal([0.4, 0.0, low])
    assert torch.equal(env.goal, root["goal"])
    assert (env.set_goal([0.4, 0.0, 0.05])["goal"][:, 2] == 0.05).all()


def test_goal_pictures_show_the_new_goal(small_env) -> None:
    env = small_env(
        2, observations=("pixels", "goal_pixels", "state"), image_size=32, goal_sampling="reachable"
    )
    before = env.reset(seed=2)
    now = env.set_goal(before["goal"].flip(0))
    reached = env.kinematics.forward(env.simulation.tensors.goal_q)
    torch.testing.assert_close(reached, now["goal"], rtol=0, atol=2e-3)
    assert (now["goal_pixels"] != before["goal_pixels"]).any()
    assert torch.equal(now["pixels"], before["pixels"]), "the arm has not moved"


def test_the_marker_moves_in_the_picture(small_env) -> None:
    env = small_env(1, observations=("pixels", "state"), image_size=64, show_goal=True)
    before = env.reset(seed=2)
    now = env.set_goal(torch.tensor([0.3, -0.3, 0.3]))
    assert (now["pixels"] != before["pixels"]).any()


def test_one_goal_may_serve_all_worlds_and_bad_ones_change_nothing(small_env) -> None:
    env = small_env(N)
    env.reset(seed=0)
    assert torch.equal(env.set_goal(GOALS[0])["goal"], GOALS[:1].expand(N, 3))
    for bad, said in (
        (torch.zeros(2, 3), r"set_goal: got shape \(2, 3\).*\(3, 3\) or \(3,\)"),
        (torch.zeros(N, 2), r"set_goal: got shape \(3, 2\)"),
        ("x", r"set_goal: 'x' must be numbers"),
        ([0.0, float("nan"), 0.0], r"set_goal: has nan; all numbers must be finite"),
    ):
        with pytest.raises(UserError, match=said):
            env.set_goal(bad)
    assert torch.equal(env.goal, GOALS[:1].expand(N, 3))
