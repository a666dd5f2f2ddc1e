"""A world that breaks is truncated, counted, never emitted, and does not disturb the others."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs import FrankaEnv

N, BROKEN, AT = 3, 1, 4
OTHERS = [k for k in range(N) if k != BROKEN]
NAN = float("nan")

Harm = Callable[[FrankaEnv, torch.Tensor], None]


def angle(env: FrankaEnv, action: torch.Tensor) -> None:
    wp.to_torch(env.simulation.newton_state.joint_q).view(N, 7)[BROKEN, 3] = NAN


def velocity(env: FrankaEnv, action: torch.Tensor) -> None:
    wp.to_torch(env.simulation.newton_state.joint_qd).view(N, 7)[BROKEN, 0] = float("inf")


def nan_action(env: FrankaEnv, action: torch.Tensor) -> None:
    action[BROKEN, 2] = NAN


def infinite_action(env: FrankaEnv, action: torch.Tensor) -> None:
    action[BROKEN, 6] = -float("inf")


def play(env: FrankaEnv, actions: torch.Tensor, harm: Harm | None = None) -> tuple[TensorDictBase, dict]:
    env.statistics()
    tensordict = env.reset(seed=0)
    steps = []
    for t in range(actions.shape[1]):
        action = actions[:, t].clone()
        if t == AT and harm is not None:
            harm(env, action)
        step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(step.clone())
    return torch.stack(steps, 1), env.statistics()


@pytest.fixture(scope="module", params=["native", "standard"])
def env(request, small_env) -> FrankaEnv:
    return small_env(
        N,
        auto_reset=request.param,
        episode_length=8,
        goal_sampling="reachable",
        observations=("pixels", "state", "joint_target"),
        image_size=24,
    )


@pytest.mark.parametrize("harm", [angle, velocity, nan_action, infinite_action])
def test_a_broken_world(env: FrankaEnv, harm: Harm, random_actions) -> None:
    actions = random_actions(N, 12)
    calm, _ = play(env, actions)
    data, statistics = play(env, actions, harm)

    for key in data.keys(True, True):
        assert torch.equal(data[key][OTHERS], calm[key][OTHERS]), key
        if key != "action":
            assert torch.isfinite(data[key].float()).all(), key
    assert statistics["nonfinite"] == 1 and statistics["episodes"] == N

    flags = {key: data["next", key][BROKEN, AT].item() for key in ("truncated", "terminated", "done")}
    assert flags == {"truncated": True, "terminated": False, "done": True}
    # It is shown as it was last seen …
    for key in ("state", "joint_target"):
        assert torch.equal(data["next", key][BROKEN, AT], data[key][BROKEN, AT]), key
    difference = data["next", "pixels"][BROKEN, AT].int() - data["pixels"][BROKEN, AT].int()
    assert (difference.abs() > 8).float().mean() < 0.02
    # … and goes on with its next episode, as it would have after a time limit.
    assert data["is_init"][BROKEN, AT + 1]
    env.reset(seed=0)
    following = env.reset()
    for key in ("state", "goal", "pixels"):
        assert torch.equal(data[key][BROKEN, AT + 1], following[key][BROKEN]), key
    assert (data["next", "state"][BROKEN, AT + 1 :, :7] != data["state"][BROKEN, AT + 1 :, :7]).any()


def test_every_world_broken_at_once(env: FrankaEnv, random_actions) -> None:
    def everything(env: FrankaEnv, action: torch.Tensor) -> None:
        wp.to_torch(env.simulation.newton_state.joint_q).fill_(NAN)

    data, statistics = play(env, random_actions(N, 8), everything)
    assert statistics["nonfinite"] == N
    assert data["next", "truncated"][:, AT].all() and env.is_finite().all()
    assert all(torch.isfinite(value.float()).all() for value in data.values(True, True))


def test_a_broken_world_is_no_success(small_env) -> None:
    env = small_env(N, success_distance=10.0, terminate_on_success=True)
    action = torch.zeros(N, 7)
    tensordict = env.reset(seed=0)
    angle(env, action)
    step = env.step(tensordict.set("action", action))["next"]
    expected = torch.ones(N, 1, dtype=torch.bool)
    expected[BROKEN] = False
    assert torch.equal(step["terminated"], expected)
    assert env.statistics()["success"] == pytest.approx((N - 1) / N)


@pytest.mark.parametrize("harm", [angle, nan_action])
def test_a_broken_world_stays_ended_until_it_is_reset(small_env, harm: Harm) -> None:
    """As any other finished world: stepped on by hand it is truncated in every step, and counted once."""
    env = small_env(N, success_distance=0.01, terminate_on_success=True)
    env.statistics()
    step = env.reset(seed=0)
    for t in range(4):
        action = torch.zeros(N, 7)
        if t in (0, 1, 2):
            harm(env, action)
        if t == 3:  # what it reaches now is no success of the episode that is over
            env.set_goal(env.tool_position())
        step = env.step(step.set("action", action))["next"]
        expected = torch.zeros(N, 1, dtype=torch.bool)
        expected[BROKEN] = True
        assert torch.equal(step["truncated"], expected), t
        assert all(torch.isfinite(value.float()).all() for value in step.values(True, True)), t
        assert env.is_finite().all() and env.tool_position().isfinite().all(), t
        assert step["terminated"][BROKEN].item() is False and step["done"][BROKEN].item(), t
    statistics = env.statistics()
    assert statistics["nonfinite"] == 1 and statistics["episodes"] == N
    assert statistics["success_once"] == pytest.approx((N - 1) / N)
    # A saved state remembers that it is over; a reset begins the next episode.
    env.set_state(env.get_state())
    assert env.step(step.set("action", torch.zeros(N, 7)))["next", "done"][BROKEN]
    again = env.step(env.reset(seed=0).set("action", torch.zeros(N, 7)))["next"]
    assert not again["done"].any()


@pytest.mark.parametrize("harm", [angle, velocity, None])
def test_nothing_of_an_episode_reaches_the_next(small_env, harm: Harm | None, random_actions) -> None:
    """Not through the solver's warm start either, which counts where joints are at their limits."""
    env = small_env(N, pose_noise=3.0, episode_length=8)
    actions = 3 * random_actions(N, 16)
    data, _ = play(env, actions, harm)
    begins = AT + 1 if harm is not None else 8
    env.reset(seed=0)
    tensordict = env.reset()
    for t in range(begins, begins + 6):
        tensordict = env.step(tensordict.set("action", actions[:, t]))["next"]
        assert torch.equal(data["next", "state"][BROKEN, t], tensordict["state"][BROKEN]), t


def test_a_broken_world_has_not_succeeded(small_env) -> None:
    """It is put back to where it was, which may be at the goal: neither its entry nor the statistics count that."""
    env = small_env(N, success_distance=5.0, terminate_on_success=True)
    root = env.reset(seed=0)
    action = torch.zeros(N, 7)
    action[BROKEN, 0] = NAN
    step = env.step(root.set("action", action))["next"]
    expected = torch.ones(N, 1, dtype=torch.bool)
    expected[BROKEN] = False
    for key in ("success", "terminated"):
        assert step[key].equal(expected), key
    assert step["truncated"].equal(~expected)
    found = env.statistics()
    assert found["episodes"] == N and found["success"] == found["success_once"] == pytest.approx(2 / 3)
