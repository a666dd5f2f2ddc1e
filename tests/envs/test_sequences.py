"""Sequences of actions: what they look like, and what the arm does with them."""

from __future__ import annotations

import pytest
import torch

from franka_wm.envs import FrankaEnv
from franka_wm.envs.sequences import smooth_actions
from franka_wm.errors import UserError


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(2, observations=("pixels", "state"), image_size=16, episode_length=50)


@pytest.mark.parametrize("smoothness", [0.0, 0.7, 0.95])
def test_smooth_actions(smoothness: float) -> None:
    actions = smooth_actions(400, 60, 7, smoothness=smoothness, generator=torch.Generator().manual_seed(0))
    assert actions.shape == (400, 60, 7) and actions.abs().max() == 1.0
    now, then = actions[:, :-1].flatten(), actions[:, 1:].flatten()
    correlation = torch.corrcoef(torch.stack([now, then]))[0, 1].item()
    assert correlation == pytest.approx(smoothness, abs=0.06)  # clipping costs a little
    across = torch.corrcoef(torch.stack([actions[..., 0].flatten(), actions[..., 1].flatten()]))[0, 1]
    assert abs(across) < 0.1
    # Every step has the same distribution, the first one too.
    deviation = actions.transpose(0, 1).flatten(1).std(1)
    torch.testing.assert_close(deviation, deviation.mean().expand(60), rtol=0.08, atol=0)


def test_smooth_actions_repeat_with_their_generator() -> None:
    first, second = (smooth_actions(2, 5, 7, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("smoothness", [-0.1, 1.0, float("nan")])
def test_impossible_smoothness(smoothness: float) -> None:
    with pytest.raises(UserError):
        smooth_actions(1, 2, 7, smoothness=smoothness)


def test_rollout_actions(env: FrankaEnv, random_actions) -> None:
    actions = random_actions(2, 6)
    played = env.rollout_actions(actions, seed=3)
    shapes = {
        "state": (2, 7, 20),
        "joint_q": (2, 7, 7),
        "tool": (2, 7, 3),
        "reward": (2, 6, 1),
        "done": (2, 6, 1),
        "video": (2, 7, 16, 16, 3),
    }
    assert {key: tuple(value.shape) for key, value in played.items()} == shapes
    assert torch.equal(played["joint_q"], played["state"][..., :7])
    assert torch.equal(played["tool"], played["state"][..., 14:17])
    observation = env.reset(seed=3)
    assert torch.equal(played["state"][:, 0], observation["state"])
    assert torch.equal(played["video"][:, 0], observation["pixels"])
    for t in range(6):
        observation = env.step(observation.set("action", actions[:, t]))["next"]
        assert torch.equal(played["state"][:, t + 1], observation["state"]), t
        assert torch.equal(played["video"][:, t + 1], observation["pixels"]), t
        assert torch.equal(played["reward"][:, t], observation["reward"]), t
    assert torch.equal(played["state"][:, -1], env.state_observation())
    assert torch.equal(played["joint_q"][:, -1], env.joint_positions())
    assert torch.equal(played["tool"][:, -1], env.tool_position())


def test_rollout_actions_at_the_end_of_an_episode(small_env, random_actions) -> None:
    env = small_env(2, episode_length=4)
    played = env.rollout_actions(random_actions(2, 6), seed=0)
    assert (played["done"].squeeze(-1) == (torch.arange(6) == 3)).all()


@pytest.mark.parametrize("shape", [(2, 7), (3, 4, 7), (2, 4, 6), (2, 0, 7)])
def test_rollout_of_the_wrong_shape(env: FrankaEnv, shape: tuple[int, ...]) -> None:
    with pytest.raises(UserError):
        env.rollout_actions(torch.zeros(shape))


def test_views_of_the_arm(env: FrankaEnv) -> None:
    env.reset(seed=0)
    assert env.action_dim == 7 and env.state_dim == 20 and env.goal.shape == (2, 3)
    assert env.model is env.simulation.model
    bodies = env.body_positions()
    assert bodies.shape[0] == 2 and bodies.shape[2] == 3
    # Two metres hold the arm; the first link's frame is on the base's axis.
    assert bodies.norm(dim=-1).max() < 2.0
    torch.testing.assert_close(
        bodies[:, 0], torch.tensor([[0.0, 0.0, 0.333]]).expand(2, 3), atol=1e-5, rtol=0
    )
    assert env.is_finite().all() and env.is_finite().shape == (2,)
    torch.testing.assert_close(env.goal_distance(), (env.tool_position() - env.goal).norm(dim=-1))
