"""``get_state`` and ``set_state``: a checkpoint from which the same actions lead to the same bits."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError

N = 3
EVERYTHING = {
    "color": 0.2, "brightness": 0.2, "camera_position": 0.05, "camera_target": 0.05, "gains": 0.2, "armature": 0.2,
    "friction": 0.5, "mass": 0.2, "action_noise": 0.1, "action_latency": 2, "observation_noise": 0.01,
}  # fmt: skip
PIXELS = ("pixels", "goal_pixels", "state", "joint_target")
KINDS: dict[str, dict[str, Any]] = {
    "plain": {"goal_sampling": "reachable", "reward": "normalized"},
    "pixels": {"observations": PIXELS, "goal_sampling": "reachable", "show_goal": True},
    "randomized": {"observations": PIXELS, "goal_sampling": "reachable", "randomization": EVERYTHING},
    "track": {"task": "track", "track_period": 0.5, "observations": ("pixels", "state"), "show_goal": True},
}


@pytest.fixture(scope="module", params=list(KINDS))
def kind(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def env(small_env, kind: str) -> FrankaEnv:
    return small_env(N, image_size=16, episode_length=7, **KINDS[kind])


def play(
    env: FrankaEnv, start: TensorDictBase, actions: torch.Tensor
) -> tuple[TensorDictBase, TensorDictBase]:
    """All steps (N, T), and what follows them."""
    steps, root = [], start
    for t in range(actions.shape[1]):
        step, root = env.step_and_maybe_reset(root.clone().set("action", actions[:, t]))
        steps.append(step.clone())
    return torch.stack(steps, 1), root


def differing(a: TensorDictBase, b: TensorDictBase) -> list:
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    return [key for key in a.keys(True, True) if not torch.equal(a[key], b[key])]


def halfway(env: FrankaEnv, random_actions) -> TensorDictBase:
    """Four steps into the second episode, so that nothing is at its initial value."""
    return play(env, env.reset(seed=3), random_actions(N, 11, seed=1))[1]


def test_the_same_actions_lead_to_the_same_bits(env: FrankaEnv, random_actions) -> None:
    """Over the end of the episode, too; in between the environment has gone elsewhere, with another seed."""
    root = halfway(env, random_actions)
    state = env.get_state()
    actions = random_actions(N, 6, seed=2)
    expected, _ = play(env, root, actions)
    assert expected["next", "done"].any()
    other, _ = play(env, env.reset(seed=8), actions)
    assert "state" in differing(expected, other)
    got, _ = play(env, env.set_state(state), actions)
    # The first root's flags are those of a reset; everything that a step gives is the same.
    assert [key for key in differing(expected[:, 1:], got[:, 1:]) if key != "success"] == []
    assert differing(expected["next"], got["next"]) == []


def test_what_is_observed_after_set_state(env: FrankaEnv, random_actions) -> None:
    """Pictures included, though other worlds' pictures were rendered into the same memory."""
    root = halfway(env, random_actions)
    state = env.get_state()
    play(env, env.reset(seed=8), random_actions(N, 2))
    back = env.set_state(state)
    for key in env._observed:
        assert torch.equal(back[key], root[key]), key
    assert not back["done"].any() and not back["is_init"].any()


def test_what_follows_from_a_state_waits_for_it(env: FrankaEnv, random_actions, monkeypatch) -> None:
    """On a GPU the drawn values are handed to MuJoCo on the stream that wrote them."""
    sim, inside = env.simulation, []

    @contextmanager
    def on_stream():
        inside.append(True)
        yield
        inside.pop()

    halfway(env, random_actions)
    found = []
    monkeypatch.setattr(sim.recorder, "on_stream_of_torch", on_stream)
    monkeypatch.setattr(sim.randomizer, "apply", lambda: found.append(bool(inside)))
    env.set_state(env.get_state())
    assert found == [True]


def test_get_state_is_a_copy(env: FrankaEnv, random_actions) -> None:
    root = halfway(env, random_actions)
    state = env.get_state()
    kept = state.clone()
    play(env, root, random_actions(N, 2))
    assert differing(state, kept) == []
    assert "joint_q" in differing(env.get_state(), kept)


def test_a_state_survives_a_file_and_another_environment(
    env: FrankaEnv, kind, small_env, tmp_path, random_actions
):
    if kind == "plain":
        root = halfway(env, random_actions)
        torch.save(env.get_state().to_dict(), tmp_path / "state.pt")
        actions = random_actions(N, 6, seed=2)
        expected, _ = play(env, root, actions)
        other = small_env(N, image_size=16, episode_length=7, seed=99, **KINDS[kind])
        state = TensorDict(torch.load(tmp_path / "state.pt"), batch_size=[N])
        got, _ = play(other, other.set_state(state), actions)
        assert differing(expected["next"], got["next"]) == []


def test_branches_have_one_future(env: FrankaEnv, kind: str, random_actions) -> None:
    """Until the next reset. (With noise in every step, branches differ: each world has its own.)"""
    if kind == "randomized":
        pytest.skip("noise is each world's own")
    root = halfway(env, random_actions)
    state = env.get_state()
    one = random_actions(N, 2, seed=2)[1:2].expand(N, 2, 7)
    original, _ = play(env, root, one)
    branches, _ = play(env, env.set_state(state[1].expand(N)), one)
    assert not branches["next", "done"].any()
    for key in branches["next"].keys(True, True):
        for world in range(N):
            assert torch.equal(branches["next", key][world], original["next", key][1]), (key, world)


def test_branches_differ_under_different_actions(env: FrankaEnv, random_actions) -> None:
    halfway(env, random_actions)
    root = env.set_state(env.get_state()[1].expand(N))
    branches, _ = play(env, root, random_actions(N, 3, seed=2))
    assert not torch.equal(branches["next", "state"][0, -1, :7], branches["next", "state"][2, -1, :7])


def refused(env: FrankaEnv, state: TensorDictBase) -> None:
    before, observed = env.get_state(), {key: value for key, value in env._present().items()}
    with pytest.raises(UserError) as caught:
        env.set_state(state)
    assert "\n" not in str(caught.value) and "set_state" in str(caught.value)
    assert differing(env.get_state(), before) == []
    for key, value in env._present().items():
        assert torch.equal(value, observed[key]), key


def test_another_number_of_worlds_is_refused(env: FrankaEnv, random_actions) -> None:
    state = env.get_state()
    halfway(env, random_actions)
    for wrong in (state[:2], state[0], torch.cat([state, state])):
        refused(env, wrong)


@pytest.mark.parametrize("wrong", [{}, None, torch.zeros(N)], ids=["dictionary", "nothing", "tensor"])
def test_what_is_no_state_is_refused(env: FrankaEnv, wrong: Any) -> None:
    refused(env, wrong)
    with pytest.raises(UserError, match="must be the TensorDict that get_state"):
        env.set_state(wrong)


def test_a_missing_entry_is_refused(env: FrankaEnv, random_actions) -> None:
    env.reset(seed=8)
    state = env.get_state()
    halfway(env, random_actions)
    for name in state.keys():  # noqa: SIM118  (a TensorDict iterates over its worlds)
        if name != "ended":  # which earlier versions did not save
            refused(env, state.exclude(name))


def test_a_wrong_shape_is_refused(env: FrankaEnv, random_actions) -> None:
    env.reset(seed=8)
    state = env.get_state()
    halfway(env, random_actions)
    for name in ("joint_q", "target", "task_goal", "body_q"):
        refused(env, state.clone().set(name, state[name][:, :-1]))
