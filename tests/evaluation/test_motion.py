"""How the arm moved on the way, against the same quantities computed from recorded states."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from franka_wm.envs import TransformedFrankaEnv
from franka_wm.envs.discretize import DiscreteActions
from franka_wm.envs.external import ExternalEnv
from franka_wm.envs.external_config import ExternalConfig
from franka_wm.evaluation.closed_loop import (
    arm_of,
    decision_times,
    play_episodes,
    success_distance,
    summarize,
)
from franka_wm.evaluation.protocol import evaluate_policies
from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy

LENGTH = 8


@pytest.fixture(scope="module")
def env(small_env):
    return small_env(4, episode_length=LENGTH, goal_sampling="reachable")


@pytest.mark.parametrize("length", [LENGTH, 3, 2])
def test_motion_by_hand(length: int, env, small_env) -> None:
    if length != LENGTH:
        env = small_env(4, episode_length=length, goal_sampling="reachable")
    policy = SmoothRandomPolicy(generator=torch.Generator().manual_seed(0))
    episodes = play_episodes(env, policy, seed=5)
    policy = SmoothRandomPolicy(generator=torch.Generator().manual_seed(0))
    observation = env.reset(seed=5)
    tools, actions, distances = [observation["state"][:, 14:17]], [], []
    for _ in range(length):
        step = env.step(policy(observation))
        actions.append(step["action"])
        observation = step["next"].exclude("reward", "done", "terminated", "truncated")
        observation["is_init"] = torch.zeros(4, 1, dtype=torch.bool)
        tools.append(observation["state"][:, 14:17])
        distances.append(observation["state"][:, 17:].norm(dim=-1))
    path, action = torch.stack(tools, 1), torch.stack(actions, 1)
    torch.testing.assert_close(episodes["path_length"], path.diff(dim=1).norm(dim=-1).sum(1))
    torch.testing.assert_close(episodes["action_change"], action.diff(dim=1).square().mean((1, 2)))
    jerk = (path.diff(n=3, dim=1) * env.config.fps**3).square().sum(-1).mean(1).sqrt()
    torch.testing.assert_close(
        episodes["jerk"], jerk.nan_to_num(0.0), rtol=1e-3, atol=1e-2
    )  # none in two steps
    torch.testing.assert_close(episodes["closest_distance"], torch.stack(distances).amin(0))
    if length == LENGTH:
        assert (episodes["closest_distance"] < episodes["final_distance"]).any()


def test_worlds_that_ended_move_no_further(small_env) -> None:
    """Of episodes that end at success, what comes after in the same world counts for nothing."""
    env = small_env(6, episode_length=12, success_distance=0.25, terminate_on_success=True)
    episodes = play_episodes(env, IKPolicy(env.kinematics, env.config), seed=0)
    assert episodes["length"].min() < 12
    at_rest = episodes["length"] == 1
    assert at_rest.any() and (episodes["path_length"][at_rest] < 0.1).all()
    assert (episodes["action_change"][at_rest] == 0).all() and (episodes["jerk"][at_rest] == 0).all()


def test_the_thorough_summary() -> None:
    episodes = TensorDict(
        {
            "final_distance": torch.tensor([0.04, 0.2]),
            "closest_distance": torch.tensor([0.02, 0.005]),
            "return": torch.tensor([-1.0, -2.0]),
            "path_length": torch.tensor([0.5, 0.7]),
        },
        batch_size=[2],
    )
    summary = summarize(episodes)
    assert {k: v["mean"] for k, v in summary["success"].items()} == {"0.05": 0.5, "0.025": 0.0, "0.01": 0.0}
    assert {k: v["mean"] for k, v in summary["success_once"].items()} == {"0.05": 1, "0.025": 1, "0.01": 0.5}
    assert summary["path_length"]["mean"] == pytest.approx(0.6)
    assert "jerk" not in summary
    at = summarize(
        TensorDict({"final_distance": torch.tensor([0.25, 0.5])}, [2]), thresholds=[0.25, 0.5, 1.0]
    )
    rates = {k: v["mean"] for k, v in at["success"].items()}
    assert rates == {"0.25": 0.0, "0.5": 0.5, "1": 1.0}  # nearer than that, as the task judges


def test_numbered_moves_are_measured_as_the_servo_gets_them(small_env) -> None:
    arm = small_env(2, episode_length=4)
    env = TransformedFrankaEnv(arm, DiscreteActions())
    assert arm_of(env) is arm
    count = iter(range(100))

    def alternate(is_init: torch.Tensor) -> torch.Tensor:  # +1 and −1 on the first axis, in turns
        return torch.full(is_init.shape[:1], next(count) % 2)

    episodes = play_episodes(env, TensorDictModule(alternate, ["is_init"], ["action"]), seed=0)
    assert torch.allclose(episodes["action_change"], torch.tensor(4 / 7))


def test_time_of_a_decision(env) -> None:
    slow = TensorDictModule(
        lambda is_init: torch.linalg.svd(torch.randn(300, 300)).U[:4, :7].contiguous(),
        ["is_init"],
        ["action"],
    )
    fast, slower = decision_times(env, NoopPolicy(), decisions=5), decision_times(env, slow, decisions=5)
    assert fast.shape == (5,) and (fast > 0).all()
    assert slower.median() > 5 * fast.median()


def test_what_is_timed(env) -> None:
    """20 decisions, after three that warm up, along an episode of seed 0, without gradients."""
    seen: list[torch.Tensor] = []

    class Watching(SmoothRandomPolicy):
        def forward(self, tensordict):
            assert not torch.is_grad_enabled()
            seen.append(tensordict["state"].clone())
            return super().forward(tensordict)

    times = decision_times(env, Watching(generator=torch.Generator().manual_seed(0)))
    assert len(times) == 20 and len(seen) == 23
    assert torch.equal(seen[0], env.reset(seed=0)["state"])
    assert (seen[1] != seen[0]).any()


def test_another_library_s_environment() -> None:
    """CartPole: return and length, no distances; the same twice."""
    env = ExternalEnv(ExternalConfig(kind="gym", name="CartPole-v1", episode_length=60), num_envs=3)
    assert arm_of(env) is None and success_distance(env) is None
    decisions: list[int] = []

    def right(is_init: torch.Tensor) -> torch.Tensor:
        decisions.append(len(is_init))
        return torch.ones(is_init.shape[:1], dtype=torch.int64)

    push = TensorDictModule(right, ["is_init"], ["action"])
    episodes = play_episodes(env, push, seed=1)
    assert set(episodes.keys()) == {"return", "length"}
    assert (episodes["return"] == episodes["length"]).all()  # CartPole pays 1 for every step
    assert (episodes["length"] < 15).all()  # pushed over
    assert len(decisions) == episodes["length"].max()  # nothing is decided when all have ended
    assert torch.equal(play_episodes(env, push, seed=1)["return"], episodes["return"])
    last = play_episodes(env, push, seed=1, first_world=2)  # the first copy plays the third one's episode
    assert last["length"][0] == episodes["length"][2] != episodes["length"][0]
    env.set_first_world(0)
    decisions.clear()
    (first,) = play_episodes(env, push, seed=2, episodes=1)["length"]
    still = TensorDictModule(
        lambda is_init: torch.zeros(is_init.shape[:1], dtype=torch.int64), ["is_init"], ["action"]
    )
    assert first < play_episodes(env, still, seed=2)["length"][1:].min()
    assert decisions == [1] * int(first)  # the others have not ended, and nobody waits for them
    assert set(evaluate_policies(env, {"push": push}).policies["push"]) == {"return", "length", "episodes"}
    env.close()
