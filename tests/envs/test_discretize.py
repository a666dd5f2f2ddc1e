"""Discrete moves: the table, and the transform under TorchRL's machinery."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torchrl.data import Categorical
from torchrl.envs import check_env_specs

from franka_wm.envs import FrankaConfig, FrankaEnv, TransformedFrankaEnv
from franka_wm.envs.discretize import DiscreteActions, discrete_action_table
from franka_wm.errors import UserError
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training import build
from franka_wm.training.spaces import Spaces

CONFIG = FrankaConfig(observations=("state",), substeps=4, gravity_compensation=True, pose_noise=0.1)


def make(num_envs: int = 3, config: FrankaConfig = CONFIG, **options: object) -> TransformedFrankaEnv:
    return TransformedFrankaEnv(
        FrankaEnv(config, num_envs=num_envs, device="cpu"),
        DiscreteActions(**options),  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("noop", [True, False])
def test_table_moves_every_axis_both_ways_once(noop: bool) -> None:
    table = discrete_action_table(3, magnitude=0.5, include_noop=noop)
    assert table.shape == (6 + noop, 3)
    assert table.dtype == torch.float32
    moves = table[:6]
    assert ((moves != 0).sum(1) == 1).all()
    assert {tuple(row) for row in moves.tolist()} == {
        tuple(sign * 0.5 * (i == axis) for i in range(3)) for axis in range(3) for sign in (1, -1)
    }
    assert torch.equal(moves[0::2], -moves[1::2])
    if noop:
        assert not table[-1].any()


@pytest.mark.parametrize(("dim", "magnitude"), [(0, 1.0), (True, 1.0), (2, 0.0), (2, 1.5), (2, float("nan"))])
def test_bad_tables_are_refused(dim: int, magnitude: float) -> None:
    with pytest.raises(UserError):
        discrete_action_table(dim, magnitude)


@pytest.mark.parametrize("noop", [True, False])
@pytest.mark.parametrize("dim", [4, 8])
def test_with_a_gripper_each_move_is_there_with_open_and_with_closed_fingers(dim: int, noop: bool) -> None:
    table = discrete_action_table(dim, 0.5, noop, gripper=True)
    moves = discrete_action_table(dim - 1, 0.5, noop)
    for half, grip in zip(table.chunk(2), (1.0, -1.0), strict=True):
        assert torch.equal(half[:, :-1], moves)
        assert (half[:, -1] == grip).all()
    with pytest.raises(UserError, match="action_dim=1"):
        discrete_action_table(1, gripper=True)


@pytest.mark.parametrize("number", [-1, 15, 99])
def test_a_number_that_is_not_in_the_table_is_refused(number: int) -> None:
    env = make(2)
    step = env.reset().set("action", torch.tensor([14, number]))
    with pytest.raises(UserError, match=f"^action {number}: must be from 0 to 14$"):
        env.step(step)


def test_what_is_held_stays_held_as_the_arm_moves(settled: Callable) -> None:
    """Each world makes one move over and over: open fingers let go of the cube, closed ones hold it."""
    run = settled("env=lift", "model=muzero", "planner=gumbel", "device=cpu")
    tool = Spaces.of_config(run.env.changed(action_mode="ee_delta").arm, discrete=True)
    assert Spaces.of_config(run.env.arm, discrete=True).num_actions == 30 and tool.num_actions == 14
    env = build.make_env(run, num_envs=10, seed=1, episode_length=200)
    assert env.action_spec.n == 30 and torch.equal(env.transform.table[[14, 29], :7], torch.zeros(2, 7))
    arm = env.base_env
    expert, observation = ExpertPolicy(arm.simulation.task, arm.kinematics, arm.config), arm.reset()
    for _ in range(45):
        observation = arm.step(expert(observation))["next"]
    assert (observation["objects"][:, 2] > 0.1).all()
    moves = torch.tensor([2, 5, 8, 11, 14])
    for _ in range(15):
        observation = env.step(observation.set("action", torch.cat([moves, 15 + moves])))["next"]
    away = (observation["objects"][:, :3] - observation["state"][:, 14:17]).norm(dim=-1)
    assert away[:5].min() > 0.04 and away[5:].max() < 0.02, away


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_specs_hold(auto_reset: str) -> None:
    from dataclasses import replace

    env = make(config=replace(CONFIG, auto_reset=auto_reset))
    assert isinstance(env.action_spec, Categorical)
    assert env.action_spec.n == 15
    assert env.action_spec.shape == (3,)
    assert env.action_spec.dtype == torch.int64
    check_env_specs(env)


def test_a_choice_does_what_its_row_does() -> None:
    env, plain = make(), FrankaEnv(CONFIG, num_envs=3, device="cpu")
    choice = torch.tensor([0, 7, 14])
    one, other = env.reset(seed=3), plain.reset(seed=3)
    one = env.step(one.set("action", choice))
    other = plain.step(other.set("action", discrete_action_table(7)[choice]))
    assert torch.equal(one["next", "state"], other["next", "state"])
    assert torch.equal(one["next", "reward"], other["next", "reward"])
    assert torch.equal(one["action"], choice), "what is recorded is the choice"


def test_moves_turn_their_joint_and_the_noop_stays() -> None:
    env = make()
    tensordict = env.reset(seed=0)
    start = env.base_env.joint_targets()  # type: ignore[attr-defined]
    env.step(tensordict.set("action", torch.tensor([4, 5, 14])))
    moved = env.base_env.joint_targets() - start  # type: ignore[attr-defined]
    expected = torch.zeros(3, 7)
    expected[0, 2], expected[1, 2] = CONFIG.action_scale, -CONFIG.action_scale
    assert torch.allclose(moved, expected, atol=1e-6)


def test_greedy_q_values_drive_it_across_episodes() -> None:
    """TorchRL's own Q-value module emits what the environment takes, through an automatic reset."""
    from torch import nn
    from torchrl.modules import QValueActor

    env = make(config=replace(CONFIG, episode_length=3))
    actor = QValueActor(nn.Linear(20, 15), in_keys=["state"], spec=env.action_spec_unbatched)
    rollout = env.rollout(7, actor, break_when_any_done=False)
    assert rollout["action"].shape == (3, 7)
    assert rollout["next", "done"].squeeze(-1).sum(1).tolist() == [2, 2, 2]
    assert torch.isfinite(rollout["next", "state"]).all()


def test_a_wrong_action_size_is_an_error_that_says_so() -> None:
    with pytest.raises((UserError, RuntimeError), match="action_dim=7"):
        make(action_dim=3).action_spec  # noqa: B018


@pytest.mark.parametrize("has", [True, False])
def test_fingers_that_are_there_or_not_are_an_error_that_says_so(has: bool) -> None:
    """Left out they would let go of what is held; without any the last joint would stand in for them."""
    with pytest.raises((UserError, RuntimeError), match=f"use gripper={has}"):
        make(config=replace(CONFIG, gripper=has), action_dim=7 + has, gripper=not has).action_spec  # noqa: B018
