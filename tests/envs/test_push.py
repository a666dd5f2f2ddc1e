"""The disc of a push: how far ahead it is drawn, and what counts as on it."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from franka_wm.envs import FrankaEnv, Randomization
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings

SPREAD = {"disc_spread": 0.09, "disc_radius": 0.04}


@pytest.fixture(scope="module")
def make(composed) -> Callable[..., FrankaEnv]:
    """Worlds of `env=push`."""
    arm = RunSettings.of(composed("env=push")).env.arm
    return lambda **changes: FrankaEnv(replace(arm, **changes), num_envs=64, device="cpu", seed=3)


def test_a_disc_is_drawn_nearer_or_farther(make) -> None:
    env = make(**SPREAD)
    start = env.reset()
    ahead = (start["goal"] - start["objects"][:, :3])[:, 0]
    assert 0.11 <= ahead.min() < 0.13 and 0.27 < ahead.max() <= 0.29
    assert torch.equal(make(**SPREAD).reset()["goal"], start["goal"])
    assert not torch.equal(env.reset()["goal"], start["goal"])
    plain = make().reset()
    assert torch.allclose((plain["goal"] - plain["objects"][:, :3])[:, 0], torch.tensor(0.2), atol=1e-4)


def test_a_cube_on_a_smaller_disc_is_a_success(make) -> None:
    """In the simulator and in torch, where rewards are computed for goals in hindsight; the expert reaches it."""
    env = make(**SPREAD)
    policy, observation = ExpertPolicy(env.simulation.task, env.kinematics, env.config), env.reset()
    for _ in range(60):
        step = env.step(policy(observation))
        observation = step["next"]
        away = (observation["objects"][:, :3] - observation["goal"])[:, :2].norm(dim=-1)
        assert torch.equal(observation["success"][:, 0], away < 0.04)
        relabelled = env.simulation.task.relabel(step.unsqueeze(1), step["goal"])
        assert torch.allclose(relabelled["next", "reward"][:, 0], observation["reward"], atol=1e-5)
    assert observation["success"].float().mean() > 0.9


def test_steps_of_another_episode_in_front_do_not_tell_how_high_a_goal_lies(make) -> None:
    """As a model with `burn_in` has them: their table may be another."""
    env = make(randomization=Randomization(table_height=0.05))
    steps = torch.stack([env.rand_step(env.reset()), env.rand_step(env.reset())], 1)  # two episodes
    steps["is_init"] = torch.ones(64, 2, 1, dtype=torch.bool)
    reached = steps["next", "objects"][:, 1, :3]
    alone = env.simulation.task.relabel(steps[:, 1:], reached)
    both = env.simulation.task.relabel(steps, reached)
    assert torch.equal(both["next", "reward"][:, 1:], alone["next", "reward"])
    assert torch.equal(both["goal"][:, 1:], alone["goal"])
    assert torch.allclose(alone["goal"][:, 0, 2], steps["goal"][:, 1, 2], atol=1e-5)
    assert not torch.allclose(steps["goal"][:, 0, 2], steps["goal"][:, 1, 2], atol=1e-3)


def test_the_disc_is_drawn_as_large_as_it_is(make) -> None:
    look = {"observations": ("segmentation",), "show_goal": True, "image_size": 96}
    seen = [(make(disc_radius=radius, **look).reset()["segmentation"] == 255).sum() for radius in (0.05, 0.1)]
    assert 3 < seen[1] / seen[0] < 5
