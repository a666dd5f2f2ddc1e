"""The data set of videos under smooth random actions: what it holds, and what it refuses to hold."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.sequences import franka_sequences
from franka_wm.errors import UserError

CONFIG = FrankaConfig(
    observations=("pixels", "state"), image_size=32, substeps=4, gravity_compensation=True, episode_length=6
)


@pytest.fixture(scope="module")
def env() -> FrankaEnv:
    return FrankaEnv(CONFIG, num_envs=3, device="cpu")


def test_sequences_have_the_shapes_promised_and_replay(env: FrankaEnv) -> None:
    data = franka_sequences(env, 5, 7, seed=1)  # two batches of three worlds, one sequence too many
    assert data.batch_size == (5,)
    assert data["video"].shape == (5, 7, 3, 32, 32)
    assert data["video"].dtype == torch.uint8
    assert data["action"].shape == (5, 6, 7)
    assert data["joint_q"].shape == (5, 7, 7)
    assert data["tool"].shape == (5, 7, 3)
    assert data["video"].movedim(2, -1).is_contiguous()
    # Frames show what the joints did: the tool is where the joints put it, and the picture moves with it.
    assert torch.allclose(env.kinematics.forward(data["joint_q"]), data["tool"], atol=1e-4)
    assert (data["video"][:, 1:] != data["video"][:, :-1]).flatten(2).any(-1).all()
    # The actions between the frames are what moved the arm.
    moved = (data["joint_q"][:, -1] - data["joint_q"][:, 0]).flatten()
    asked = (CONFIG.action_scale * data["action"].sum(1)).flatten()
    assert torch.corrcoef(torch.stack([moved, asked]))[0, 1] > 0.8
    again = franka_sequences(env, 5, 7, seed=1)
    assert all(torch.equal(data[key], again[key]) for key in data.keys())  # noqa: SIM118
    other = franka_sequences(env, 5, 7, seed=2)
    assert not torch.equal(data["action"], other["action"])
    first = data["joint_q"][:, 0]
    assert len({tuple(row) for row in first.tolist()}) == 5, "two sequences start alike"


def test_without_pixels_there_is_no_video_and_statistics_stay() -> None:
    env = FrankaEnv(replace(CONFIG, observations=("state",)), num_envs=2, device="cpu")
    before = env.simulation.tensors.statistics.clone()
    data = franka_sequences(env, 3, 7)
    assert "video" not in data.keys()  # noqa: SIM118
    assert torch.equal(env.simulation.tensors.statistics, before)


def test_actions_are_those_of_the_mode() -> None:
    env = FrankaEnv(
        replace(CONFIG, observations=("state",), action_mode="ee_delta"), num_envs=2, device="cpu"
    )
    assert franka_sequences(env, 2, 4)["action"].shape == (2, 3, 3)


class Sabotage:
    """Puts a NaN into one world's action, in the first ``batches`` batches."""

    def __init__(self, env: FrankaEnv, step: int, batches: int, world: int | slice = 1):
        self.play, self.step, self.left, self.world = env.rollout_actions, step, batches, world
        self.actions: list[torch.Tensor] = []

    def __call__(self, actions: torch.Tensor, *, seed: int | None = None) -> TensorDict:
        self.actions.append(actions)
        if self.left > 0:
            self.left -= 1
            actions = actions.clone()
            actions[self.world, self.step] = float("nan")
        return self.play(actions, seed=seed)


@pytest.mark.parametrize("step", [1, 5])
def test_a_broken_world_is_drawn_again(env: FrankaEnv, monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    sabotage = Sabotage(env, step, batches=1)
    monkeypatch.setattr(env, "rollout_actions", sabotage)
    data = franka_sequences(env, 3, 7)
    assert len(sabotage.actions) == 2
    assert torch.isfinite(data["joint_q"]).all()
    first, second = sabotage.actions
    assert torch.equal(data["action"], torch.stack([first[0], first[2], second[0]]))


def test_too_many_broken_worlds_say_what_to_change(env: FrankaEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    sabotage = Sabotage(env, 2, batches=100, world=slice(None))
    monkeypatch.setattr(env, "rollout_actions", sabotage)
    with pytest.raises(UserError, match=r"6 of 6 sequences were discarded.*lower target_ke") as error:
        franka_sequences(env, 3, 7, max_attempts=2)
    assert "\n" not in str(error.value)
    assert len(sabotage.actions) == 2


def test_episodes_that_end_inside_are_discarded() -> None:
    config = replace(
        CONFIG, observations=("state",), terminate_on_success=True, success_distance=10.0, episode_length=50
    )
    env = FrankaEnv(config, num_envs=2, device="cpu")
    with pytest.raises(UserError, match="terminate_on_success=false"):
        franka_sequences(env, 2, 5, max_attempts=1)
    assert franka_sequences(env, 2, 2).batch_size == (2,), "an episode may end at the last frame"


def test_ends_of_another_cause_are_not_blamed_on_success(
    env: FrankaEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    play = env.rollout_actions

    def ended(*args: Any, **kwargs: Any) -> Any:
        played = play(*args, **kwargs)
        played["done"][:, 1] = True  # something fell off the table
        return played

    monkeypatch.setattr(env, "rollout_actions", ended)
    with pytest.raises(UserError, match="3 ended early: ask for a shorter length"):
        franka_sequences(env, 3, 7, max_attempts=1)


@pytest.mark.parametrize("length", [0, 1, 8, 2.0])
def test_length_must_fit_an_episode(env: FrankaEnv, length: int) -> None:
    with pytest.raises(UserError, match="length"):
        franka_sequences(env, 1, length)
