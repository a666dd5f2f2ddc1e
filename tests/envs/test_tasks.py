"""Rewards as in torch, a goal that moves, and the task of docs/tasks.md, exactly as it is printed there."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.tasks import Reach, Task, Track, reach_reward
from franka_wm.errors import UserError

N, LENGTH = 4, 8


def play(env: FrankaEnv, actions: torch.Tensor, seed: int = 0) -> TensorDictBase:
    root, steps = env.reset(seed=seed), []
    for t in range(actions.shape[1]):
        step, root = env.step_and_maybe_reset(root.set("action", actions[:, t]))
        steps.append(step.clone())
    return torch.stack(steps, 1)


# -- rewards ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dense", "sparse", "normalized"])
def test_rewards_equal_those_in_torch(small_env, random_actions, kind: str) -> None:
    """Over three episodes, with actions beyond 1, which count as they are applied: clipped."""
    env = small_env(
        N,
        reward=kind,
        goal_sampling="reachable",
        episode_length=LENGTH,
        success_distance=0.3,
        action_penalty=0.1,
    )
    actions = 1.5 * random_actions(N, 3 * LENGTH)
    data = play(env, actions)
    initial = data["state"][:, ::LENGTH, 17:].norm(dim=-1).repeat_interleave(LENGTH, 1).unsqueeze(-1)
    expected = reach_reward(
        data["next", "state"],
        actions,
        kind=kind,
        action_penalty=0.1,
        success_distance=0.3,
        initial_distance=initial,
    )
    torch.testing.assert_close(data["next", "reward"], expected, atol=1e-5, rtol=1e-5)
    distance = data["next", "state"][..., 17:].norm(dim=-1, keepdim=True)
    assert torch.equal(data["next", "success"], distance < 0.3)
    assert 0 < data["next", "success"].float().mean() < 1
    least, largest = env.reward_bounds
    assert least <= data["next", "reward"].min() and data["next", "reward"].max() <= largest
    assert largest - least <= 2.1
    effort = 0.1 * actions.clamp(-1, 1).square().mean(-1, keepdim=True)
    value = data["next", "reward"] + effort
    if kind == "sparse":
        torch.testing.assert_close(value, data["next", "success"].float(), atol=1e-6, rtol=0)
    if kind == "normalized":
        torch.testing.assert_close(
            value, (1 - distance / initial.clamp_min(0.3)).clamp_min(-1), atol=1e-5, rtol=0
        )


def test_a_subclass_with_another_reward_has_no_bounds_but_its_own() -> None:
    class Doubled(Reach):
        def reward_and_success(self, sim) -> None: ...

    class Bounded(Doubled):
        reward_bounds = (-2.0, 0.0)

    config = FrankaConfig()
    assert Reach(config).reward_bounds == Track(config).reward_bounds == (-1.01, 0.0)
    assert Doubled(config).reward_bounds is None and Task(config).reward_bounds is None
    assert Bounded(config).reward_bounds == (-2.0, 0.0)


# -- track -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def track(small_env) -> TensorDictBase:
    """Two whole turns, and the start of a second episode."""
    env = small_env(N, task="track", track_radius=0.08, track_period=0.8, fps=25.0, episode_length=40)
    return play(env, torch.zeros(N, 43, 7))


def test_the_goal_moves_on_its_circle(track: TensorDictBase) -> None:
    """Radius 8 cm around the configured goal, one turn in 20 steps, always at the same speed."""
    center = torch.tensor(FrankaConfig().goal)
    for goal in (track["goal"], track["next", "goal"]):
        offset = goal - center
        assert offset[..., 0].abs().max() < 1e-6
        torch.testing.assert_close(offset.norm(dim=-1), torch.full((N, 43), 0.08), atol=1e-5, rtol=0)
    goal = track["next", "goal"][:, :40]
    torch.testing.assert_close(goal[:, :20], goal[:, 20:], atol=1e-5, rtol=0)
    turn = torch.atan2(*(goal - center)[..., [2, 1]].unbind(-1)).diff(dim=1)
    turn = (turn + math.pi) % (2 * math.pi) - math.pi
    torch.testing.assert_close(turn, torch.full_like(turn, 2 * math.pi / 20), atol=1e-4, rtol=0)


def test_the_state_is_seen_from_the_goal_of_that_moment(track: TensorDictBase) -> None:
    for data in (track, track["next"]):
        torch.testing.assert_close(
            data["state"][..., 17:], data["state"][..., 14:17] - data["goal"], atol=1e-6, rtol=0
        )
    inside = [t for t in range(42) if t != 39]
    for t in inside:
        assert torch.equal(track["next", "goal"][:, t], track["goal"][:, t + 1]), t
    expected = reach_reward(track["next", "state"], track["action"])
    torch.testing.assert_close(track["next", "reward"], expected, atol=1e-5, rtol=1e-5)


def test_phases_differ(track: TensorDictBase) -> None:
    """Between worlds and between episodes."""
    first, second = track["goal"][:, 0], track["goal"][:, 40]
    assert track["is_init"][:, 40].all()
    assert (first - second).norm(dim=-1).min() > 1e-3
    assert torch.pdist(first).min() > 1e-4


def test_track_around_a_drawn_center(small_env) -> None:
    env = small_env(N, task="track", goal_sampling="reachable", track_period=0.5, fps=20.0, episode_length=20)
    goal = play(env, torch.zeros(N, 10, 7))["next", "goal"]
    center = goal.mean(1)
    assert torch.pdist(center).min() > 0.02
    low = goal[..., 2].amin(1) <= 0.05 + 1e-6  # a circle is cut off at the ground
    radius = (goal - center[:, None]).norm(dim=-1)
    torch.testing.assert_close(radius[~low], torch.full_like(radius[~low], 0.1), atol=1e-4, rtol=0)


# -- a task of one's own ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def height(printed_class):
    """The class in Warp that docs/tasks.md prints."""
    return printed_class("Height(Task)", lines=60)


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_the_documented_task(height, random_actions, auto_reset: str) -> None:
    """Goal, reward, success and ends of episodes are its own, through the captured graph and auto-reset."""
    config = FrankaConfig(
        substeps=2,
        observations=("state",),
        episode_length=LENGTH,
        terminate_on_success=True,
        gravity_compensation=True,
        auto_reset=auto_reset,
    )
    higher = type("Higher", (height,), {"option_defaults": {"height": 0.75}})
    env = FrankaEnv(config, num_envs=N, device="cpu", task=higher(config))
    assert isinstance(env.simulation.task, Task)
    data = play(env, random_actions(N, 30))
    tool = data["next", "state"][..., 16:17]
    assert torch.equal(data["next", "reward"], tool)
    assert torch.equal(data["next", "success"], tool > 0.75)
    assert torch.equal(data["next", "terminated"], data["next", "success"])
    assert data["next", "terminated"].any() and data["next", "truncated"].any()
    for part in (data, data["next"]):
        assert torch.equal(part["goal"], torch.tensor([0.0, 0.0, 0.75]).expand(N, 30, 3))
    assert torch.equal(data["is_init"][:, 1:], data["next", "done"][:, :-1])
    assert env.simulation._step_graphs
    statistics = env.statistics()
    assert statistics["episodes"] == data["next", "done"].sum()
    assert statistics["success_once"] == pytest.approx(
        (data["next", "terminated"].sum() / data["next", "done"].sum()).item()
    )


@pytest.mark.parametrize(("method", "word"), [("reset", "goal"), ("reward_and_success", "reward")])
def test_a_task_without_goal_or_reward_says_so(method: str, word: str) -> None:
    arguments = (None, None)[: 2 if method == "reset" else 1]
    with pytest.raises(NotImplementedError, match=word):
        getattr(Task(FrankaConfig()), method)(*arguments)


def test_the_old_name_of_a_method_names_the_new_one() -> None:
    with pytest.raises(UserError, match=r"Old\.judge: .*reward_and_success"):

        class Old(Task):
            def judge(self, sim) -> None: ...


def test_an_unknown_task_or_reward() -> None:
    for option in ({"task": "juggle"}, {"reward": "generous"}):
        with pytest.raises(UserError) as caught:
            FrankaConfig(**option)
        assert "\n" not in str(caught.value) and next(iter(option.values())) in str(caught.value)


def test_track_has_no_goal_picture() -> None:
    with pytest.raises(UserError, match="goal_pixels"):
        FrankaConfig(task="track", observations=("goal_pixels", "state"))


def test_relabel_speaks_only_for_the_task_that_defines_it() -> None:
    class Faster(Reach):
        """Another reward: what Reach says of other goals is not true of it."""

        def reward_and_success(self, sim) -> None:
            raise AssertionError

    class Told(Faster):
        def relabel(self, transitions, goal):
            return transitions

    assert Reach.relabels() and Told.relabels()
    assert not (Faster.relabels() or Track.relabels() or Task.relabels())
