"""Stacked pictures: what was seen in the last steps of the same episode, and nothing else."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from franka_wm.data.lerobot.schema import schema_for
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.errors import UserError
from franka_wm.training.spaces import Spaces

N, LENGTH, STEPS, COUNT = 3, 4, 10, 3
OPTIONS = {
    "observations": ("pixels", "goal_pixels", "state"),
    "cameras": ("front", "side"),
    "image_size": 16,
    "episode_length": LENGTH,
    "goal_sampling": "reachable",
}
PICTURES = ("pixels", "pixels_side")


def play(env: FrankaEnv, actions: torch.Tensor) -> TensorDictBase:
    root, steps = env.reset(seed=0), []
    for action in actions.unbind(1):
        step, root = env.step_and_maybe_reset(root.clone().set("action", action))
        steps.append(step.clone())
    return torch.stack(steps, 1)


@pytest.fixture(scope="module")
def actions(random_actions) -> torch.Tensor:
    return random_actions(N, STEPS)


@pytest.fixture(scope="module")
def single(small_env, actions) -> TensorDictBase:
    return play(small_env(N, **OPTIONS), actions)


@pytest.mark.parametrize("auto_reset", ["native", "standard"])
def test_stacks_hold_the_episode_s_last_pictures(small_env, single, actions, auto_reset: str) -> None:
    stacked = play(small_env(N, frame_stack=COUNT, auto_reset=auto_reset, **OPTIONS), actions)
    assert torch.equal(stacked["state"], single["state"])
    for key in PICTURES:
        for t in range(STEPS):
            begin = t - t % LENGTH
            seen = [*single[key][:, begin : t + 1].unbind(1), single["next", key][:, t]]
            padded = [seen[0]] * (COUNT - 1) + seen
            assert torch.equal(stacked[key][:, t], torch.cat(padded[-COUNT - 1 : -1], -1)), (key, t)
            assert torch.equal(stacked["next", key][:, t], torch.cat(padded[-COUNT:], -1)), (key, t)
    assert (single["pixels"][:, 1] != single["pixels"][:, 2]).any()  # or this could not fail


def test_pictures_of_goals_stand_still(small_env, single, actions) -> None:
    stacked = play(small_env(N, frame_stack=COUNT, **OPTIONS), actions)
    for key in ("goal_pixels", "goal_pixels_side"):
        assert torch.equal(stacked[key], single[key].repeat(1, 1, 1, 1, COUNT))


def test_a_masked_reset_leaves_other_stacks(small_env, actions) -> None:
    env = small_env(N, frame_stack=COUNT, auto_reset="standard", **OPTIONS)
    root = env.reset(seed=0)
    for action in actions[:, :2].unbind(1):
        root = env.step(root.set("action", action))["next"]
    mask = torch.tensor([True, False, False])
    after = env.reset(root.clone().set("_reset", mask.unsqueeze(-1)))
    for key in PICTURES:
        assert torch.equal(after[key][1:], root[key][1:])
        newest = after[key][0, ..., -3:]
        assert torch.equal(after[key][0], newest.repeat(1, 1, COUNT))


def test_states_carry_their_pictures(small_env, actions) -> None:
    env = small_env(N, frame_stack=COUNT, **OPTIONS)
    root = env.reset(seed=0)
    for action in actions[:, :2].unbind(1):
        root = env.step(root.set("action", action))["next"]
    kept = env.get_state()
    ahead = env.step(root.clone().set("action", actions[:, 2]))["next"]
    env.reset()
    again = env.set_state(kept)
    assert all(torch.equal(again[key], root[key]) for key in PICTURES)
    repeated = env.step(again.set("action", actions[:, 2]))["next"]
    assert all(torch.equal(repeated[key], ahead[key]) for key in PICTURES)
    with pytest.raises(UserError, match="frames_pixels must be"):
        env.set_state(kept.exclude("frames_pixels"))


def test_what_is_given_out_is_the_caller_s(small_env, actions) -> None:
    """Writing into an observation does not change the next one."""
    outcomes = []
    for spoil in (False, True):
        env = small_env(N, frame_stack=COUNT, **OPTIONS)
        root = env.reset(seed=0)
        if spoil:
            root["pixels"].zero_()
        outcomes.append(env.step(root.set("action", actions[:, 0]))["next", "pixels"])
    assert torch.equal(*outcomes)


def test_specs_and_spaces(small_env) -> None:
    env = small_env(N, frame_stack=COUNT, **OPTIONS)
    check_env_specs(env)
    assert Spaces.of_env(env) == Spaces.of_config(env.config)
    assert Spaces.of_env(env).image_sizes["pixels_side"] == (16, 16, 9)


def test_bad_input() -> None:
    for count in (0, 65, 1.5, True):
        with pytest.raises(UserError, match="frame_stack"):
            FrankaConfig(frame_stack=count)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"record with env\.frame_stack=1"):
        schema_for(FrankaConfig(frame_stack=2))
    assert "pixels" not in schema_for(FrankaConfig(frame_stack=2, observations=("state",))).sources.values()


def test_before_the_first_reset(small_env, actions) -> None:
    """As without stacks: what is set by hand is seen, and a step can be made."""
    env = small_env(N, frame_stack=COUNT, **OPTIONS)
    assert env.set_goal(torch.tensor([0.4, 0.1, 0.5]))["pixels"].shape == (N, 16, 16, 3 * COUNT)
    env = small_env(N, frame_stack=COUNT, **OPTIONS)
    stepped = env.step(TensorDict({"action": actions[:, 0]}, batch_size=[N]))
    assert stepped["next", "pixels"].dtype == torch.uint8


def test_states_of_another_type_are_refused(small_env) -> None:
    env = small_env(N, frame_stack=COUNT, **OPTIONS)
    env.reset()
    state = env.get_state()
    with pytest.raises(UserError, match="uint8"):
        env.set_state(state.set("frames_pixels", state["frames_pixels"].float()))
