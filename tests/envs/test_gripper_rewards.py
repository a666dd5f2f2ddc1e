"""Dense rewards of tasks with a gripper: to succeed pays more than not to, and lift's is what its docstring says."""

from __future__ import annotations

import pytest
import torch

from franka_wm.envs import FrankaEnv
from franka_wm.envs.tasks.manipulation import held_in_torch, near_in_torch
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings

WORLDS = 8


def played(composed, name: str) -> list:
    """What the expert's steps lead to, with the actions, in all worlds, until the shortest episode would end."""
    env = FrankaEnv(RunSettings.of(composed(f"env={name}")).env.arm, num_envs=WORLDS, device="cpu", seed=1)
    policy, observation, steps = (
        ExpertPolicy(env.simulation.task, env.kinematics, env.config),
        env.reset(),
        [],
    )
    for _ in range(env.config.episode_length - 1):
        step = env.step(policy(observation))
        observation = step["next"]
        effort = step["action"].clamp(-1, 1).square().mean(-1)
        value = observation["reward"].squeeze(-1) + env.config.action_penalty * effort
        steps.append(observation.clone().set("value", value))
    return steps


@pytest.mark.parametrize("name", ["push", "pick", "stack", "peg"])
def test_to_succeed_pays_more_than_anything_else(name: str, composed) -> None:
    """Else an agent may hover just below success, as well paid as above: lift's reward does not prevent that."""
    steps = played(composed, name)
    value = torch.stack([step["value"] for step in steps])
    solved = torch.stack([step["success"].squeeze(-1) for step in steps])
    assert solved.any(0).all() and not solved.all()
    assert value[~solved].max() < value[solved].min()
    assert value.min() >= 0.0 and value.max() <= 1.0 + 1e-5


def test_lift_pays_for_nearness_grip_and_height(composed) -> None:
    paid_for_height = 0
    for step in played(composed, "lift"):
        cube, state = step["objects"][:, :3], step["state"]
        risen = (1 - (step["goal"][:, 2] + 0.03 - cube[:, 2]).abs() / 0.23).clamp(min=0)
        held = held_in_torch(state, step["joint_target"], cube)
        near = near_in_torch((state[:, 14:17] - cube).norm(dim=-1))
        expected = 0.2 * near + held * (0.2 + 0.4 * risen + 0.2 * step["success"].squeeze(-1))
        torch.testing.assert_close(step["value"], expected, atol=1e-5, rtol=0)
        paid_for_height += int((held & (risen > 0.1) & (risen < 0.9)).sum())
    assert paid_for_height > WORLDS
