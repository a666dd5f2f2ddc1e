"""Closed-loop evaluation: true ends of whole episodes, on episodes that training never saw."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import (
    _Tasks,
    evaluating,
    play_episodes,
    success_distance,
    summarize,
)
from franka_wm.evaluation.protocol import evaluate_policies, held_out_seeds
from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy

LENGTH = 6


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(5, episode_length=LENGTH, goal_sampling="reachable")


def test_the_true_end_of_each_episode(env: FrankaEnv) -> None:
    """Of episodes that reset themselves: played by hand, the last state before the reset."""
    episodes = play_episodes(env, NoopPolicy(), seed=3)
    observation = env.reset(seed=3)
    total = torch.zeros(5)
    for _ in range(LENGTH):
        step, observation = env.step_and_maybe_reset(observation.set("action", torch.zeros(5, 7)))
        total += step["next", "reward"].squeeze(-1)
    assert torch.equal(episodes["final_distance"], step["next", "state"][:, 17:].norm(dim=-1))
    torch.testing.assert_close(episodes["return"], total)
    assert (episodes["length"] == LENGTH).all()
    env.reset()  # Not the distance in the episode that begins then.
    assert (episodes["final_distance"] - env.goal_distance()).abs().min() > 1e-4


def test_doing_nothing_ends_where_it_began(env: FrankaEnv) -> None:
    episodes = play_episodes(env, NoopPolicy(), seed=3)
    env.reset(seed=3)
    torch.testing.assert_close(episodes["final_distance"], env.goal_distance(), atol=0.005, rtol=0)


def test_only_the_first_episode_counts(small_env) -> None:
    """With ends at success, worlds end at different times and go on into episodes that are not counted."""
    env = small_env(6, episode_length=12, success_distance=0.25, terminate_on_success=True)
    policy = SmoothRandomPolicy(generator=torch.Generator().manual_seed(0))
    episodes = play_episodes(env, policy, seed=0)
    policy = SmoothRandomPolicy(generator=torch.Generator().manual_seed(0))
    observation = env.reset(seed=0)
    ends: dict[int, tuple[float, int]] = {}
    for t in range(12):
        step, observation = env.step_and_maybe_reset(policy(observation))
        after = step["next"]
        for k in after["done"].squeeze(-1).nonzero().flatten().tolist():
            ends.setdefault(k, (after["state"][k, 17:].norm().item(), t + 1))
    assert len({length for _, length in ends.values()}) > 1
    for k, (distance, length) in ends.items():
        assert episodes["final_distance"][k].item() == pytest.approx(distance)
        assert episodes["length"][k] == length
    assert torch.equal(episodes["success_once"], (episodes["final_distance"] < 0.25).float())


def test_repeats_are_exact_and_seeds_matter(env: FrankaEnv) -> None:
    first, second, other = (play_episodes(env, NoopPolicy(), seed=s)["final_distance"] for s in (1, 1, 2))
    assert torch.equal(first, second) and not torch.isclose(first, other).any()


def test_episodes_differ_from_those_of_training(env: FrankaEnv) -> None:
    evaluated = play_episodes(env, NoopPolicy(), seed=held_out_seeds(1)[0])["final_distance"]
    env.reset(seed=0)
    for _ in range(20):
        assert not torch.isclose(evaluated.unsqueeze(0), env.goal_distance().unsqueeze(1), atol=1e-5).any()
        env.reset()


def test_a_part_of_the_worlds_plays_the_same_episodes(env: FrankaEnv, small_env) -> None:
    """The first ones, for which alone is decided, and those from a number on."""
    seen = []

    def nothing(observation: TensorDict) -> TensorDict:
        assert not torch.is_grad_enabled()
        seen.append(len(observation))
        return observation.set("action", torch.zeros(len(observation), 7))

    every = play_episodes(env, nothing, seed=3)
    some = play_episodes(env, nothing, seed=3, episodes=2)
    assert seen == [5] * LENGTH + [2] * LENGTH
    assert (some == every[:2]).all() and len(some) == 2
    last = small_env(3, episode_length=LENGTH, goal_sampling="reachable")
    assert (play_episodes(last, nothing, seed=3, first_world=2) == every[2:]).all()


def test_where_success_is_a_distance(env: FrankaEnv, monkeypatch) -> None:
    assert success_distance(env) == env.config.success_distance
    monkeypatch.setattr(type(env.simulation.task), "success_distance", None)
    assert success_distance(env) is None


def test_of_several_tasks_each_judges_the_first_episode_of_its_worlds() -> None:
    broken = {"a": torch.zeros(2, dtype=torch.bool), "b": torch.zeros(1, dtype=torch.bool)}
    overflow = {name: torch.zeros(len(own), dtype=torch.int32) for name, own in broken.items()}
    tensors = {name: SimpleNamespace(broken=broken[name], overflow=overflow[name]) for name in broken}
    envs = {name: SimpleNamespace(simulation=SimpleNamespace(tensors=own)) for name, own in tensors.items()}
    env = SimpleNamespace(envs=envs, one_hot=torch.eye(2)[[0, 1, 0]], num_envs=3, device=torch.device("cpu"))
    overflow["a"][1] = 1  # the last world's
    judged = _Tasks(env)
    for running, success in (([1, 1, 1], [0, 1, 1]), ([1, 1, 1], [1, 0, 0]), ([1, 0, 0], [1, 1, 1])):
        after = TensorDict({"success": torch.tensor(success, dtype=torch.bool).unsqueeze(-1)}, [3])
        judged.see(torch.tensor(running, dtype=torch.bool), after)
        overflow["b"][0] = success == [1, 0, 0]  # in the third step: a later episode of its world
    found = judged.summary(torch.ones(3))
    assert found["success"].tolist() == [1.0, 0.0, 0.0] and found["success_once"].tolist() == [1.0, 1.0, 0.0]
    assert found["cut_short"].tolist() == [0.0, 0.0, 1.0]
    rows = TensorDict({**found, "return": torch.zeros(3)}, [3])
    assert rows["task_success", "a"][[0, 2]].tolist() == [1.0, 0.0] and rows["task_success", "a"][1].isnan()
    summary = summarize(rows)
    rates = {name: interval["mean"] for name, interval in summary["task_success"].items()}
    assert rates == {"a": 0.5, "b": 0.0} and summary["success_once"]["mean"] == pytest.approx(2 / 3)


def test_video_is_called_before_every_step(env: FrankaEnv) -> None:
    """One picture for each step's beginning: none shows the next episode."""
    seen: list[torch.Tensor] = []
    play_episodes(env, NoopPolicy(), seed=3, video=lambda: seen.append(env.goal))
    assert len(seen) == LENGTH
    assert all(torch.equal(goal, seen[0]) for goal in seen)


def test_summary() -> None:
    distance = torch.tensor([0.005, 0.02, 0.04, 0.2])
    episodes = TensorDict({"final_distance": distance, "return": -distance}, batch_size=[4])
    summary = summarize(episodes)
    assert set(summary) == {"final_distance", "success", "return", "episodes"}
    assert summary["episodes"] == 4
    assert summary["final_distance"]["mean"] == pytest.approx(distance.mean().item())
    assert summary["return"]["mean"] == pytest.approx(-distance.mean().item())
    rates = {name: interval["mean"] for name, interval in summary["success"].items()}
    assert rates == {"0.05": 0.75, "0.025": 0.5, "0.01": 0.25}
    for interval in (summary["final_distance"], summary["return"], *summary["success"].values()):
        assert set(interval) == {"mean", "low", "high"}
        assert interval["low"] < interval["mean"] < interval["high"]


def test_policies_play_the_same_episodes(env: FrankaEnv) -> None:
    told = []
    oracle = IKPolicy(env.kinematics, env.config)
    results = evaluate_policies(
        env,
        {"a": NoopPolicy(), "ik": oracle, "b": NoopPolicy()},
        report=lambda name, r: told.append(name),
    ).policies
    assert told == ["a", "ik", "b"]
    assert results["a"] == results["b"]
    assert results["ik"]["final_distance"]["mean"] < 0.5 * results["a"]["final_distance"]["mean"]


def test_one_episode_has_no_interval(small_env) -> None:
    with pytest.raises(UserError, match="at least 2"):
        evaluate_policies(small_env(1), {"noop": NoopPolicy()})


class Moody(torch.nn.Module):
    """Behind a policy: pushes one way in training mode, another in evaluation mode; a part of it is frozen."""

    def __init__(self) -> None:
        super().__init__()
        self.frozen = torch.nn.Linear(1, 1).eval()

    def forward(self, is_init: torch.Tensor) -> torch.Tensor:
        return torch.full((is_init.shape[0], 7), 0.5 if self.training else -0.5)


def test_what_is_evaluated_is_in_evaluation_mode_and_goes_on_training_after(env: FrankaEnv) -> None:
    model = Moody()
    policy = TensorDictModule(model, ["is_init"], ["action"])
    modes = [part.training for part in policy.modules()]
    assert any(modes) and not all(modes)
    training = play_episodes(env, policy, seed=3)
    assert [part.training for part in policy.modules()] == modes
    policy.eval()
    assert torch.equal(play_episodes(env, policy, seed=3)["final_distance"], training["final_distance"])
    policy.train()
    with pytest.raises(ZeroDivisionError), evaluating(policy):
        assert not model.training
        raise ZeroDivisionError
    assert model.training
