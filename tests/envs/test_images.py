"""Depth, segmentation, the cameras, goal pictures and goal marker agree with the geometry of the scene."""

from __future__ import annotations

import math

import newton
import numpy as np
import pytest
import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.camera import BACKGROUND, GOAL_MARKER, project
from franka_wm.envs.tasks import Reach

N, SIZE, LENGTH = 3, 48, 4
GROUND, BASE, HAND, MARKER = 1, 2, 9, 255


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(
        N,
        observations=("pixels", "depth", "segmentation", "goal_pixels", "state"),
        cameras=("front", "wrist"),
        image_size=SIZE,
        episode_length=LENGTH,
        goal_sampling="reachable",
        show_goal=True,
    )


@pytest.fixture(scope="module")
def first(env: FrankaEnv) -> TensorDictBase:
    return env.reset(seed=0).clone()


def pose(env: FrankaEnv, q: torch.Tensor) -> torch.Tensor:
    """The front camera's picture with the joints at ``q`` (N, 7); the simulation's own state is put back."""
    state = env.state
    arrays = (state.joint_q, state.body_q)
    kept = [wp.clone(a) for a in arrays]
    wp.to_torch(state.joint_q).view(N, 7).copy_(q)
    newton.eval_fk(env.model, state.joint_q, state.joint_qd, state)
    picture = env.render()
    for array, copy in zip(arrays, kept, strict=True):
        wp.copy(array, copy)
    return picture


def step(env: FrankaEnv, root: TensorDictBase, action: torch.Tensor) -> tuple[TensorDictBase, TensorDictBase]:
    step, root = env.step_and_maybe_reset(root.clone().set("action", action))
    return step.clone(), root


def centre(mask: torch.Tensor) -> torch.Tensor:
    """Column and row of the middle of a mask (H, W) [px]."""
    row, column = mask.nonzero().float().add(0.5).mean(0)
    return torch.stack([column, row])


# -- depth -----------------------------------------------------------------------------------------------


def test_depth_of_the_ground_is_the_length_of_the_ray(env: FrankaEnv, first: TensorDictBase) -> None:
    """By hand, from the framing and the field of view alone."""
    eye, target = (np.array(p) for p in env.camera_framing)
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
    up = np.cross(back, right)
    focal = 0.5 * SIZE / math.tan(math.radians(env.config.camera_fov_degrees) / 2)
    middle = np.arange(SIZE) + 0.5 - SIZE / 2
    rays = (middle / focal)[None, :, None] * right - (middle / focal)[:, None, None] * up - back
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    length = torch.from_numpy(-eye[2] / rays[..., 2]).float()
    for world in range(N):
        ground = first["segmentation"][world, ..., 0] == GROUND
        assert ground.sum() > 200
        depth = first["depth"][world, ..., 0][ground]
        torch.testing.assert_close(depth, length[ground], rtol=0.01, atol=0)


def test_depth_is_0_exactly_where_nothing_is(first: TensorDictBase) -> None:
    for suffix in ("", "_wrist"):
        nothing = first["segmentation" + suffix] == 0
        assert torch.equal(first["depth" + suffix] == 0, nothing)
    assert (first["segmentation"] == 0).any()
    robot = (first["segmentation"] >= BASE) & (first["segmentation"] <= HAND)
    assert (first["depth"][robot] > 0.3).all() and (first["depth"][robot] < 2.0).all()


# -- segmentation ----------------------------------------------------------------------------------------


def test_labels(first: TensorDictBase) -> None:
    seen = set(first["segmentation"].unique().tolist())
    assert seen <= {0, *range(1, HAND + 1), MARKER}
    assert {0, GROUND, BASE, HAND, MARKER} <= seen
    assert len(seen & set(range(3, HAND + 1))) >= 5  # short links hide behind others


def test_labels_agree_with_the_colours(first: TensorDictBase) -> None:
    labels, pixels = first["segmentation"][..., 0], first["pixels"].float()
    sky = torch.tensor([round(255 * c) for c in BACKGROUND]).float()
    assert torch.equal((pixels == sky).all(-1), labels == 0)
    ball = pixels[labels == MARKER]
    assert (ball[:, 0] > 1.8 * ball[:, 1]).all() and (ball[:, 0] > 1.8 * ball[:, 2]).all()
    rest = pixels[labels != MARKER]
    assert not ((rest[:, 0] > 1.8 * rest[:, 1]) & (rest[:, 0] > 1.8 * rest[:, 2])).any()


def test_the_hand_s_label_is_where_the_tool_is_seen(env: FrankaEnv, first: TensorDictBase) -> None:
    """Across the picture, the hand's middle is within 4 of 48 pixels of the projected tool."""
    seen = project(first["state"][:, 14:17], env.config, SIZE)
    for world in range(N):
        hand = centre(first["segmentation"][world, ..., 0] == HAND)
        assert (hand - seen[world]).abs()[0] < 4 and (hand - seen[world]).norm() < 12, world
    assert (seen[0] - seen[1]).norm() > 2


# -- goal marker and goal picture ------------------------------------------------------------------------


def test_the_marker_is_where_the_goal_is_seen(env: FrankaEnv) -> None:
    """In many episodes: the ball's middle is within 1.5 pixels of the goal wherever none of it is hidden."""
    compared = 0
    for seed in range(6):
        observed = env.reset(seed=seed)
        goal = observed["goal"]
        seen = project(goal, env.config, SIZE)
        eye = torch.tensor(env.camera_framing[0])
        focal = 0.5 * SIZE / math.tan(math.radians(env.config.camera_fov_degrees) / 2)
        area = math.pi * (focal * 0.025 / (goal - eye).norm(dim=-1)) ** 2
        for world in range(N):
            ball = observed["segmentation"][world, ..., 0] == MARKER
            if ball.sum() > 0.8 * area[world]:
                assert (centre(ball) - seen[world]).norm() < 1.5, (seed, world)
                compared += 1
    assert compared >= 6


def test_goal_pixels_show_the_arm_at_the_goal(env: FrankaEnv, first: TensorDictBase) -> None:
    env.reset(seed=0)
    goal_q = env.simulation.tensors.goal_q.clone()
    assert torch.equal(pose(env, goal_q), first["goal_pixels"])
    assert ((env.kinematics.forward(goal_q) - first["goal"]).norm(dim=-1) < 0.01).all()
    assert not torch.equal(first["goal_pixels"], first["pixels"])
    assert torch.equal(pose(env, first["state"][:, :7]), first["pixels"])  # pose() itself is right


def test_goal_pixels_of_a_fixed_goal(small_env) -> None:
    env = small_env(2, observations=("goal_pixels", "state"), image_size=16)
    observed = env.reset(seed=0)
    reached = env.kinematics.forward(env.simulation.tensors.goal_q)
    assert ((reached - torch.tensor(env.config.goal)).norm(dim=-1) < 0.01).all()
    assert torch.equal(observed["goal_pixels"][0], observed["goal_pixels"][1])


def test_goal_pixels_at_the_end_of_an_episode(env: FrankaEnv, random_actions) -> None:
    """``next`` still shows the old goal, the root that follows the new one."""
    root = env.reset(seed=0)
    old = root["goal_pixels"].clone()
    actions = random_actions(N, LENGTH)
    for t in range(LENGTH):
        assert torch.equal(root["goal_pixels"], old)
        played, root = step(env, root, actions[:, t])
        assert torch.equal(played["next", "goal_pixels"], old)
    assert played["next", "done"].all()
    assert torch.equal(root["goal_pixels"], pose(env, env.simulation.tensors.goal_q.clone()))
    assert not torch.equal(root["goal"], played["next", "goal"])
    assert all(not torch.equal(root["goal_pixels"][k], old[k]) for k in range(N))


# -- wrist camera ----------------------------------------------------------------------------------------


def change(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.float() - b.float()).abs().mean())


def test_the_wrist_camera_turns_with_the_wrist(env: FrankaEnv, first: TensorDictBase) -> None:
    assert change(first["pixels"], first["pixels_wrist"]) > 10
    root = env.reset(seed=0)
    action = torch.zeros(N, 7)
    action[:, 6] = 1.0
    for _ in range(LENGTH - 1):
        played, root = step(env, root, action)
    after = played["next"]
    assert (after["state"][:, 6] - first["state"][:, 6]).abs().min() > 0.05
    assert change(after["pixels_wrist"], first["pixels_wrist"]) > 0.2
    moved = [((after[k] - first[k]).abs() > 1e-3).float().mean() for k in ("depth", "depth_wrist")]
    assert moved[0] < 0.3 < 0.4 < moved[1]  # in front only the arm moves; from the wrist, all the world


def test_images_of_a_step_agree_with_each_other(env: FrankaEnv, random_actions) -> None:
    """After the step's own pictures and after the pictures of resets, in both cameras."""
    root = env.reset(seed=1)
    sky = torch.tensor([round(255 * c) for c in BACKGROUND])
    for t in range(LENGTH + 1):
        played, root = step(env, root, random_actions(N, LENGTH + 1)[:, t])
        for data in (played["next"], root):
            for suffix in ("", "_wrist"):
                nothing = data["segmentation" + suffix] == 0
                assert torch.equal(data["depth" + suffix] == 0, nothing), (t, suffix)
                assert torch.equal((data["pixels" + suffix] == sky).all(-1, keepdim=True), nothing), (
                    t,
                    suffix,
                )


def test_a_task_given_as_an_object_has_its_own_marker() -> None:
    class Flat(Reach):
        marker = 0.08

    config = FrankaConfig(show_goal=True, goal_sampling="reachable", observations=("state",), substeps=2)
    env = FrankaEnv(config, num_envs=2, device="cpu", task=Flat(config))
    env.reset()
    env.render(16)
    model = env.model
    marks = [k for k, label in enumerate(model.shape_label) if label.endswith(GOAL_MARKER)]
    assert (model.shape_type.numpy()[marks] == newton.GeoType.CYLINDER).all()
    assert (model.shape_transform.numpy()[marks, 2] == 0.0).all() and (env.goal[:, 2] > 0.1).all()


# -- side camera -----------------------------------------------------------------------------------------


def turned(points: torch.Tensor) -> torch.Tensor:
    """World points (..., 3) a quarter turn around the vertical: the side camera sees them as the front does these."""
    x, y, z = points.unbind(-1)
    return torch.stack([-y, x, z], -1)


@pytest.mark.parametrize("moved", [0.0, 0.3])
def test_the_side_camera_sees_the_goal_where_geometry_puts_it(small_env, moved: float) -> None:
    """Also where the camera is moved at random: then it is not where the config says."""
    env = small_env(
        N,
        observations=("segmentation", "depth"),
        cameras=("side",),
        image_size=64,
        goal_sampling="reachable",
        show_goal=True,
        randomization={"camera_position": moved},
    )
    seen = env.reset(seed=3)
    expected = project(turned(seen["goal"]), env.config, 64)
    errors = []
    for world in range(N):
        marker = seen["segmentation"][world, ..., 0] == MARKER
        if marker.sum() >= 3:  # not hidden by the arm
            errors.append(float((centre(marker) - expected[world]).norm()))
    assert len(errors) >= 2
    assert max(errors) < 1.5 if not moved else max(errors) > 1.5


def test_goal_pictures_of_every_camera(small_env) -> None:
    """The side camera's picture of a goal is what it sees when the arm is there."""
    options = dict(
        observations=("pixels", "goal_pixels"), cameras=("front", "side", "wrist"), image_size=SIZE
    )
    env = small_env(N, goal_sampling="reachable", **options)
    first = env.reset(seed=0)
    state = env.get_state()
    q = env.simulation.tensors.goal_q.clone()
    state["joint_q"] = q
    newton.eval_fk(env.model, wp.from_torch(q.flatten()), env.state.joint_qd, env.state)
    state["body_q"] = env.simulation.tensors.body_q.clone()
    there = env.set_state(state)
    for camera in ("", "_side", "_wrist"):
        assert torch.equal(there[f"pixels{camera}"], first[f"goal_pixels{camera}"]), camera
        assert not torch.equal(there[f"pixels{camera}"], first[f"pixels{camera}"]), camera
