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
    """Else an agent may hover just below success, as well paid as above. (Lift pays for it while the cube is held.)"""
    steps = played(composed, name)
    value = torch.stack([step["value"] for step in steps])
    solved = torch.stack([step["success"].squeeze(-1) for step in steps])
    assert solved.any(0).all() and not solved.all()
    assert value[~solved].max() < value[solved].min()
    assert value.min() >= 0.0 and value.max() <= 1.0 + 1e-5


def test_lift_pays_for_nearness_grip_height_and_success(composed) -> None:
    steps = torch.stack(played(composed, "lift"))
    cube, state, solved = steps["objects"][..., :3], steps["state"], steps["success"].squeeze(-1)
    over = cube[..., 2] - steps["goal"][..., 2]
    near = near_in_torch((state[..., 14:17] - cube).norm(dim=-1))
    held = held_in_torch(state, steps["joint_target"], cube)
    risen = (1 - (over - 0.03).abs() / 0.23).clamp(min=0)
    expected = 0.2 * near + held * (0.2 + 0.4 * risen + 0.2 * solved)
    torch.testing.assert_close(steps["value"], expected, atol=1e-5, rtol=0)
    assert (held & (risen > 0.1) & (risen < 0.8)).sum() > WORLDS  # on the way up
    assert (held & (over > 0.03)).any() and solved.any()


def test_lift_pays_nothing_for_a_cube_that_is_thrown(composed) -> None:
    env = FrankaEnv(RunSettings.of(composed("env=lift")).env.arm, num_envs=WORLDS, device="cpu", seed=1)
    env.reset()
    state = env.get_state()
    state["rest_q"][:, 4] += 0.5  # the height of the cube: behind two fingers, x and y
    step = env.step(env.set_state(state).set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert step["success"].all() and (step["objects"][:, 2] > 0.4).all()
    near = near_in_torch((step["state"][:, 14:17] - step["objects"][:, :3]).norm(dim=-1))
    torch.testing.assert_close(step["reward"].squeeze(-1), 0.2 * near, atol=1e-5, rtol=0)
