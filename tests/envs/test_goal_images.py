# pyright: reportArgumentType=false, reportCallIssue=false
# (Annotations of Newton and TensorDict do not say what is there.)
"""Images of the goal of tasks with a gripper show what the cameras see when everything really is there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import newton
import pytest
import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.tasks import Lift, TorchTask
from franka_wm.errors import UserError
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings

TASKS = ("drawer", "lift", "peg", "pick", "push", "stack")
N, LENGTH = 3, 3
CAMERAS = ("", "_wrist")


@pytest.fixture(scope="session")
def arm(composed) -> Callable[..., FrankaConfig]:
    """The config of ``env=NAME_goal_image``, its objects observed as well."""

    def make(name: str, **changes) -> FrankaConfig:
        config = RunSettings.of(composed(f"env={name}_goal_image")).env.arm
        return replace(config, observations=(*config.observations, "objects"), **changes)

    return make


def make(config: FrankaConfig, num_envs: int = N, *, seed: int = 0) -> FrankaEnv:
    return FrankaEnv(config, num_envs=num_envs, device="cpu", seed=seed)


@pytest.fixture(scope="module")
def env(arm) -> FrankaEnv:
    return make(arm("lift", image_size=32, episode_length=LENGTH))


def there(env: FrankaEnv) -> TensorDictBase:
    """What is observed with everything where the goal's arrays say; the environment is put back."""
    before, state = env.get_state(), env.get_state()
    tensors = env.simulation.tensors
    state["joint_q"], state["rest_q"] = tensors.goal_q.clone(), tensors.goal_rest.clone()
    q = torch.cat([state["joint_q"], state["rest_q"]], -1)
    newton.eval_fk(env.model, wp.from_torch(q.flatten()), wp.zeros_like(env.state.joint_qd), env.state)
    state["body_q"] = tensors.body_q.clone()
    seen = env.set_state(state)
    env.set_state(before)
    return seen


def red(image: torch.Tensor) -> torch.Tensor:
    """Middle of the cube in (H, W, 3): column and row [px]."""
    r, g, b = image.float().unbind(-1)
    where = ((r > 2 * g) & (r > 2 * b)).nonzero().float()
    assert len(where) >= 3
    return where.mean(0)


def far(one: torch.Tensor, other: torch.Tensor) -> float:
    """Share of pixels that differ visibly."""
    largest = (one.float() - other.float()).abs().amax(-1)
    return float((largest > 30).float().mean())


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_the_expert_brings_about_what_the_goal_shows(name: str, arm) -> None:
    """By its own way, through contacts: the cube to a few pixels, and arm and hand near enough to tell."""
    env = make(arm(name, image_size=64), seed=4)
    first = env.reset().clone()
    seen, policy = first, ExpertPolicy(env.simulation.task, env.kinematics, env.config)
    for _ in range(env.config.episode_length - 1):
        seen = env.step(policy(seen))["next"]
    assert seen["success"].all()
    for world in range(N):
        goal, start, end = (x[world] for x in (first["goal_pixels"], first["pixels"], seen["pixels"]))
        assert far(end, goal) < 0.5 * far(start, goal)
        if name != "drawer":
            away = (red(end) - red(goal)).norm()
            assert away < (9 if name == "push" else 4)  # anywhere on the disc is enough
            assert name == "push" or away < 0.5 * (red(start) - red(goal)).norm()


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_goal_images_are_the_cameras_images_of_the_goal(name: str, arm) -> None:
    env = make(arm(name, image_size=32))
    first = env.reset().clone()
    seen = there(env)
    cameras = ["", *(f"_{camera}" for camera in env.config.cameras[1:])]
    assert len(cameras) == 2
    for camera in cameras:
        assert torch.equal(first[f"goal_pixels{camera}"], seen[f"pixels{camera}"])
        assert not torch.equal(first[f"goal_pixels{camera}"], first[f"pixels{camera}"])
    place = seen["objects"][:, :3]  # of the first object, or of the handle
    assert (place - first["goal"]).norm(dim=-1).max() < 1e-4
    hand, yaw = env.kinematics.upright(env.simulation.tensors.goal_q)
    assert (hand - env.simulation.tensors.goal_hand[:, :3]).norm(dim=-1).max() < 1e-4
    assert (yaw - env.simulation.tensors.goal_hand[:, 3]).abs().max() < 1e-4


def test_a_cube_that_is_lifted_in_the_goal(env: FrankaEnv) -> None:
    first = env.reset(seed=0).clone()
    seen = there(env)
    for camera in CAMERAS:
        assert torch.equal(first[f"goal_pixels{camera}"], seen[f"pixels{camera}"])
    start, cube = first["objects"][:, :3], seen["objects"][:, :3]
    torch.testing.assert_close(cube, start + torch.tensor([0.0, 0.0, 0.2]))
    assert (seen["state"][:, 14:17] - cube).norm(dim=-1).max() < 1e-4  # in the hand,
    assert (seen["state"][:, 20:22] - 0.02).abs().max() < 1e-6  # whose fingers are at its sides
    assert all(
        (red(i)[0] - red(j)[0]) > 2 for i, j in zip(first["pixels"], first["goal_pixels"], strict=True)
    )


def test_a_world_s_goal_image_does_not_depend_on_their_number(env: FrankaEnv) -> None:
    many = env.reset(seed=5)
    one = make(env.config, 1).reset(seed=5)
    for camera in CAMERAS:
        assert torch.equal(one[f"goal_pixels{camera}"][0], many[f"goal_pixels{camera}"][0])


def test_a_masked_reset_draws_only_its_worlds_goals_anew(env: FrankaEnv) -> None:
    first = env.reset(seed=1).clone()
    mask = torch.tensor([[False], [True], [False]])
    second = env.reset(first.clone().set("_reset", mask))
    for camera in CAMERAS:
        key = f"goal_pixels{camera}"
        same = [torch.equal(first[key][k], second[key][k]) for k in range(N)]
        assert same[0] and same[2]
        assert camera or not same[1]
    assert torch.equal(second["goal_pixels"], there(env)["pixels"])


def test_a_step_restarts_with_the_next_goal(env: FrankaEnv) -> None:
    root = env.reset(seed=2)
    old = root["goal_pixels"].clone()
    step = root
    for _ in range(LENGTH):
        assert torch.equal(root["goal_pixels"], old)
        step, root = env.step_and_maybe_reset(env.rand_action(root.clone()))
        assert torch.equal(step["next", "goal_pixels"], old)
    assert step["next", "done"].all()
    assert all(not torch.equal(root["goal_pixels"][k], old[k]) for k in range(N))
    assert torch.equal(root["goal_pixels"], there(env)["pixels"])


def test_a_goal_that_is_moved_takes_cube_and_hand_along(env: FrankaEnv) -> None:
    first = env.reset(seed=3).clone()
    goal = first["goal"] + torch.tensor([0.0, 0.1, 0.05])
    moved = env.set_goal(goal)
    assert not torch.equal(moved["goal_pixels"], first["goal_pixels"])
    assert torch.equal(moved["pixels"], first["pixels"])
    seen = there(env)
    assert torch.equal(moved["goal_pixels"], seen["pixels"])
    torch.testing.assert_close(seen["objects"][:, :3], goal)


def test_a_state_has_the_goal_image(env: FrankaEnv) -> None:
    first = env.reset(seed=4).clone()
    state = env.get_state()
    env.reset()
    assert torch.equal(env.set_state(state)["goal_pixels"], first["goal_pixels"])


class Still(TorchTask):
    """Nothing to do."""

    gripper, scene, home = True, Lift.scene, Lift.home

    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return draws[:, :3]

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return state[..., 0]

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 0] < 0


def test_a_task_without_an_image_of_its_goal_is_refused() -> None:
    config = FrankaConfig(observations=("goal_pixels", "state"))
    with pytest.raises(UserError, match=r"goal_pixels: Still has no image .* Still\.pose_at_goal"):
        FrankaEnv(config, num_envs=1, device="cpu", task=Still(config))
