"""Friction of what is touched, grip force and noise on objects: drawn anew in each episode, and what they reach."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.errors import UserError

PRESET: dict[str, Any] = {
    "task": "lift",
    "observations": ("state", "joint_target", "objects"),
    "substeps": 4,
    "gravity_compensation": True,
    "episode_length": 3,
}
TOUCH = {"contact_friction": 0.5, "grip_force": 0.4}


def make(num_envs: int, *, seed: int = 0, **ranges) -> FrankaEnv:
    return FrankaEnv(FrankaConfig(**PRESET, randomization=ranges), num_envs=num_envs, device="cpu", seed=seed)


def play(env: FrankaEnv, steps: int) -> list:
    """Steps with actions that depend on the world and the step alone, over ends of episodes."""
    root, out = env.reset(seed=4), []
    for k in range(steps):
        action = torch.sin(torch.arange(8.0) + k).expand(env.num_envs, 8).contiguous()
        step, root = env.step_and_maybe_reset(root.set("action", action))
        out.append(step.clone())
    return out


def touch(env: FrankaEnv) -> dict[str, np.ndarray]:
    """What MuJoCo has, (N, …) each; copies."""
    model = env.simulation.solver.mjw_model
    return {
        "friction": np.array(model.geom_friction.numpy()),
        "stiffness": np.array(model.actuator_gainprm.numpy()[:, -2:, 0]),
        "limit": np.array(model.jnt_actfrcrange.numpy()[:, 7:9]),
    }


@pytest.fixture(scope="module")
def touching() -> FrankaEnv:
    return make(4, **TOUCH)


def test_friction_and_grip_are_drawn_in_each_episode(touching: FrankaEnv) -> None:
    nominal = touch(make(1))
    seen = []
    for seed in range(4):
        touching.reset(seed=seed)
        seen.append(touch(touching))
    for name, width in (("friction", 0.5), ("limit", 0.4)):
        factors = np.concatenate([now[name] / nominal[name] for now in seen])
        assert (np.abs(factors - 1) <= width + 1e-5).all(), name
        assert factors.min() < 1 - 0.4 * width and factors.max() > 1 + 0.4 * width, name
    first = seen[0]["limit"]
    assert (first[:, 0] == first[:, 1]).all()  # both fingers alike
    assert len(np.unique(first[:, 0, 1])) == 4  # each world its own
    stiff = nominal["stiffness"][0] == 1000.0  # of the fingers' servos
    assert stiff.any()
    factor = first[:, 0, 1] / nominal["limit"][0, 0, 1]
    np.testing.assert_allclose(
        seen[0]["stiffness"][:, stiff], 1000 * factor[:, None] * np.ones(stiff.sum()), rtol=1e-5
    )
    for name in ("friction", "limit"):
        assert not np.array_equal(seen[0][name], seen[1][name])


def test_they_last_an_episode_and_are_saved(touching: FrankaEnv) -> None:
    root = touching.reset(seed=1)
    start, saved = touch(touching), touching.get_state()
    for k in range(3):
        _, root = touching.step_and_maybe_reset(root.set("action", torch.zeros(4, 8)))
        same = all(np.array_equal(start[name], now) for name, now in touch(touching).items())
        assert same == (k < 2), k
    touching.set_state(saved)
    for name, now in touch(touching).items():
        np.testing.assert_allclose(now, start[name], rtol=1e-6, err_msg=name)


def test_a_world_is_the_same_whatever_their_number() -> None:
    ranges = TOUCH | {"object_noise": 0.01, "mass": 0.2}
    runs = [play(make(n, **ranges), 5) for n in (1, 2, 8)]
    for run in runs[1:]:
        for a, b in zip(runs[0], run, strict=True):
            for key in (("next", "objects"), ("next", "state"), ("next", "reward")):
                assert torch.equal(a[key][0], b[key][0]), key


def test_noise_on_objects_changes_what_is_seen_alone() -> None:
    plain, noisy = make(64), make(64, object_noise=0.01)
    differences = []
    for a, b in zip(play(plain, 2), play(noisy, 2), strict=True):
        assert torch.equal(a["next", "reward"], b["next", "reward"])
        assert torch.equal(a["next", "state"], b["next", "state"])
        differences.append(b["next", "objects"] - a["next", "objects"])
    first, second = differences
    assert (first[:, 3:] == 0).all() and not torch.equal(first, second)
    assert 0.008 < first[:, :3].std() < 0.012
    assert torch.equal(noisy.simulation.tensors.true_objects, plain.simulation.tensors.objects)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"randomization": {"contact_friction": 0.2}}, "contact_friction: needs a scene"),
        ({"randomization": {"grip_force": 0.2}}, "grip_force: needs the gripper"),
        ({"randomization": {"object_noise": 0.2}}, "object_noise: needs objects"),
        ({"randomization": {"grip_force": 1.0}}, "must be from 0 to 0.9"),
    ],
)
def test_what_is_not_there_is_not_drawn(changes: dict, said: str) -> None:
    with pytest.raises(UserError, match=said):
        FrankaConfig(**changes)
