"""What episodes draw anew: each field changes what it says and nothing else, reproducibly, and reaches MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from newton import ModelFlags
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.config import Randomization
from franka_wm.errors import UserError

LENGTH = 4
OPTIONS: dict[str, Any] = {
    "observations": ("pixels", "state", "joint_target"),
    "image_size": 16,
    "episode_length": LENGTH,
    "goal_sampling": "reachable",
}
DYNAMICS = {"gains": 0.3, "armature": 0.4, "friction": 0.5, "mass": 0.2}
LOOKS = {"color": 0.3, "brightness": 0.4, "camera_position": 0.1, "camera_target": 0.1}
NOISE = {"action_noise": 0.2, "action_latency": 2, "observation_noise": 0.02}


def play(env: FrankaEnv, actions: torch.Tensor, seed: int = 0) -> TensorDictBase:
    root, steps = env.reset(seed=seed), []
    for t in range(actions.shape[1]):
        step, root = env.step_and_maybe_reset(root.set("action", actions[:, t]))
        steps.append(step.clone())
    return torch.stack(steps, 1)


@pytest.fixture(scope="module")
def plain(small_env, random_actions) -> TensorDictBase:
    return play(small_env(2, **OPTIONS), random_actions(2, LENGTH))


@pytest.fixture(scope="module")
def physical(small_env) -> FrankaEnv:
    return small_env(4, episode_length=LENGTH, randomization=DYNAMICS)


@pytest.fixture(scope="module")
def everything(small_env) -> FrankaEnv:
    return small_env(2, **OPTIONS, randomization=DYNAMICS | LOOKS | NOISE)


def test_off_by_default(small_env, plain, random_actions) -> None:
    assert FrankaConfig().randomization == Randomization() and not Randomization().any()
    zeros = {name: 0 for name in DYNAMICS | LOOKS | NOISE}
    data = play(small_env(2, **OPTIONS, randomization=zeros), random_actions(2, LENGTH))
    for key in plain.keys(True, True):
        assert torch.equal(data[key], plain[key]), key


CHANGES = (
    {name: {"pixels"} for name in LOOKS}
    | {name: {"pixels", "state", "reward", "true"} for name in DYNAMICS}
    | {
        name: {"pixels", "state", "joint_target", "reward", "true"}
        for name in ("action_noise", "action_latency")
    }
    | {"observation_noise": {"state"}}
)


@pytest.mark.parametrize("name", list(CHANGES))
def test_each_changes_what_it_says(small_env, plain, random_actions, name: str) -> None:
    """In the first episode, whose poses and goals are those of the plain environment; ``true``: tool entries."""
    value = {**DYNAMICS, **LOOKS, **NOISE}[name]
    env = small_env(2, **OPTIONS, randomization={name: value})
    data = play(env, random_actions(2, LENGTH))
    first = {"pixels"} if name in LOOKS else {"state"} if name == "observation_noise" else set()
    for key in ("pixels", "state", "joint_target", "goal"):
        assert torch.equal(data[key][:, 0], plain[key][:, 0]) == (key not in first), f"first {key}"
    got, expected = data["next"], plain["next"]
    for key in ("pixels", "state", "joint_target", "goal", "reward", "done"):
        assert torch.equal(got[key], expected[key]) == (key not in CHANGES[name]), key
    same = torch.equal(got["state"][..., 14:], expected["state"][..., 14:])
    assert same == ("true" not in CHANGES[name])


def test_observation_noise_has_its_size(small_env, random_actions) -> None:
    options = {"episode_length": 1000, "pose_noise": 0.0}
    actions = random_actions(4, 40)
    noisy = play(small_env(4, randomization={"observation_noise": 0.02}, **options), actions)["next"]
    true = play(small_env(4, **options), actions)["next"]
    error = noisy["state"] - true["state"]
    assert error[..., :7].std().item() == pytest.approx(0.02, rel=0.1)
    assert error[..., 7:14].std().item() == pytest.approx(0.2, rel=0.1)
    assert error[..., :14].mean().abs() < 0.02
    assert not torch.equal(error[0], error[1]) and not torch.equal(error[:, 0], error[:, 1])


@pytest.mark.parametrize("harm", ["action", "joint"])
def test_a_broken_world_under_observation_noise(small_env, harm: str) -> None:
    """It is caught in the same step, and no NaN is emitted."""
    env = small_env(3, randomization={"observation_noise": 0.01}, episode_length=1000)
    actions = torch.zeros(3, 7)
    root = env.reset(seed=0)
    _, root = env.step_and_maybe_reset(root.set("action", actions))
    if harm == "joint":
        wp.to_torch(env.state.joint_q).view(3, 7)[1, 3] = float("nan")
    else:
        actions[1, 2] = float("nan")
    step, root = env.step_and_maybe_reset(root.set("action", actions))
    for key in ("state", "reward", "joint_target"):
        assert torch.isfinite(step["next", key]).all(), key
    assert step["next", "truncated"].flatten().tolist() == [False, True, False]
    assert torch.isfinite(root["state"]).all()


# -- what the physics sees -------------------------------------------------------------------------------


def drawn(env: FrankaEnv) -> dict[str, np.ndarray]:
    """What MuJoCo has, (N, …) each; copies, since Warp's ``numpy()`` on the CPU is a view."""
    model = env.simulation.solver.mjw_model
    values = {
        "ke": model.actuator_gainprm.numpy()[..., 0],
        "kd": -model.actuator_biasprm.numpy()[..., 2],
        "armature": model.dof_armature.numpy(),
        "friction": model.dof_frictionloss.numpy(),
        "mass": model.body_mass.numpy()[:, 1:],
    }
    return {name: np.array(value) for name, value in values.items()}


def newton_s(env: FrankaEnv) -> dict[str, np.ndarray]:
    """The same in Newton's model."""
    m, n = env.model, env.num_envs
    arrays = (m.joint_target_ke, m.joint_target_kd, m.joint_armature, m.joint_friction, m.body_mass)
    return {
        k: a.numpy().reshape(n, -1)
        for k, a in zip(("ke", "kd", "armature", "friction", "mass"), arrays, strict=True)
    }


def test_mujoco_has_what_was_drawn(physical: FrankaEnv, random_actions) -> None:
    """After every step of three episodes: nothing of the graph's capture, or of the last episode, is left."""
    root = physical.reset(seed=0)
    before = None
    for t, action in enumerate(random_actions(4, 2 * LENGTH + 1).unbind(1)):
        _, root = physical.step_and_maybe_reset(root.set("action", action))
        now, expected = drawn(physical), newton_s(physical)
        for name in now:
            np.testing.assert_allclose(now[name], expected[name], rtol=1e-6, err_msg=f"{name}, step {t}")
            if before is not None:
                new_episode = (t + 1) % LENGTH == 0
                assert (now[name] != before[name]).any(axis=1).all() == new_episode, (name, t)
        before = now


@pytest.mark.parametrize("name", DYNAMICS)
def test_each_range_alone_reaches_mujoco_and_constants_change_where_they_depend_on_it(
    name: str, small_env, monkeypatch
) -> None:
    """MuJoCo computes its constants anew of armatures and masses, which takes longest."""
    env = small_env(2, randomization={name: DYNAMICS[name]})
    env.reset(seed=1)
    now, expected, nominal = drawn(env), newton_s(env), newton_s(small_env(2))
    for one in now:
        np.testing.assert_allclose(now[one], expected[one], rtol=1e-6, err_msg=one)
    assert any((now[one] != nominal[one]).any() for one in now)
    told = []
    monkeypatch.setattr(env.simulation.solver, "notify_model_changed", told.append)
    env.simulation.randomizer.apply()
    slow = ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES | ModelFlags.BODY_INERTIAL_PROPERTIES
    slow |= ModelFlags.JOINT_DOF_PROPERTIES
    assert bool(told[0] & slow) is (name in ("armature", "mass"))


def test_draws_are_within_their_ranges(physical: FrankaEnv, small_env) -> None:
    nominal = newton_s(small_env(1))
    values = []
    for seed in range(6):
        physical.reset(seed=seed)
        values.append(drawn(physical))
    for name, width in (("ke", 0.3), ("kd", 0.3), ("armature", 0.4), ("mass", 0.2)):
        factor = np.concatenate([v[name] / nominal[name] for v in values])
        assert (np.abs(factor - 1) <= width + 1e-5).all(), name
        assert factor.max() > 1 + 0.6 * width and factor.min() < 1 - 0.6 * width, name
    friction = np.concatenate([v["friction"] for v in values])
    assert friction.min() >= 0 and friction.max() <= 0.5 and friction.max() > 0.3


def test_draws_are_independent(physical: FrankaEnv, small_env) -> None:
    """Stiffness says nothing of damping, armature or friction, nor one link's mass of another's."""
    nominal = newton_s(small_env(1))
    factors: dict[str, list] = {}
    for seed in range(8):
        physical.reset(seed=seed)
        for name, value in drawn(physical).items():
            factors.setdefault(name, []).append(value / (1 if name == "friction" else nominal[name]))
    all_of = {name: np.concatenate(v) for name, v in factors.items()}
    for name in ("kd", "armature", "friction"):
        assert abs(np.corrcoef(all_of["ke"].flatten(), all_of[name].flatten())[0, 1]) < 0.4, name
    assert np.ptp(all_of["mass"], axis=1).min() > 0.01


def test_brightness_and_camera_are_independent(small_env) -> None:
    env = small_env(32, randomization={"brightness": 0.4, "camera_position": 0.1})
    env.reset(seed=0)
    state = env.get_state()
    brightness, eye = state["brightness"], state["poses"][:, :3]
    for axis in range(3):
        assert abs(torch.corrcoef(torch.stack([brightness, eye[:, axis]]))[0, 1]) < 0.6, axis


# -- reproducible ----------------------------------------------------------------------------------------


def test_reproducible_whatever_the_number_of_worlds(everything: FrankaEnv, small_env, random_actions) -> None:
    """From seed × world × episode, over two ends of episodes."""
    steps = 2 * LENGTH + 2
    few = play(everything, random_actions(2, steps))
    again = play(everything, random_actions(2, steps))
    many = play(
        small_env(5, **OPTIONS, randomization=DYNAMICS | LOOKS | NOISE, seed=7), random_actions(5, steps)
    )
    for key in few.keys(True, True):
        assert torch.equal(few[key], again[key]), key
        assert torch.equal(few[key], many[key][:2]), key
    other = play(everything, random_actions(2, steps), seed=1)
    assert not torch.equal(few["state"][:, 0], other["state"][:, 0])


def test_new_in_the_next_episode_and_in_every_world(everything: FrankaEnv) -> None:
    everything.reset(seed=0)
    first = everything.get_state()
    everything.reset()
    second = everything.get_state()
    names = ["brightness", "poses", *(name for name in first.keys() if name.startswith("random_"))]  # noqa: SIM118
    assert len(names) == 2 + 7
    for name in names:
        assert not torch.equal(first[name][0], second[name][0]), name
        assert not torch.equal(first[name][0], first[name][1]), name


def test_a_masked_reset_leaves_the_others_draws(everything: FrankaEnv) -> None:
    root = everything.reset(seed=0)
    before = everything.get_state()
    everything.reset(root.clone().set("_reset", torch.tensor([[True], [False]])))
    after = everything.get_state()
    for name in before.keys():  # noqa: SIM118
        assert torch.equal(before[name][1], after[name][1]), name
    assert not torch.equal(before["poses"][0], after["poses"][0])


# -- mistakes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {"colour": 0.1}, {"color": -0.1}, {"color": 1.5}, {"brightness": 1.0}, {"gains": 0.95}, {"mass": 2},
        {"armature": float("nan")}, {"friction": "much"}, {"friction": True}, {"action_latency": 1.5},
        {"action_latency": -1}, {"observation_noise": float("inf")},
    ],
)  # fmt: skip
def test_refused(values: dict) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(randomization=values)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value) and next(iter(values)) in str(caught.value)


def test_only_with_mujoco() -> None:
    with pytest.raises(UserError, match="mujoco"):
        FrankaConfig(solver="featherstone", randomization={"mass": 0.1})  # type: ignore[arg-type]
