"""Pictures: of the arm, of the right world, where the geometry says."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.camera import look_at, project, whole_arm
from franka_wm.errors import UserError

PIXELS = {"observations": ("pixels", "state", "joint_target"), "image_size": 48}


@pytest.fixture(scope="module")
def env(small_env) -> FrankaEnv:
    return small_env(3, **PIXELS)


def difference(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Largest difference of the colours, 0 … 255."""
    return (a.int() - b.int()).abs().amax(-1)


def test_the_arm_is_seen(env: FrankaEnv) -> None:
    """Sky above, ground below, light shells and dark joints in between."""
    picture = env.reset(seed=0)["pixels"]
    assert picture.dtype == torch.uint8 and picture.shape == (3, 48, 48, 3)
    colours = picture.float().mean(-1)
    assert colours.flatten(1).std(1).min() > 20
    centre = colours[:, 10:40, 14:34].flatten(1)
    assert (centre.amax(1) > 200).all() and (centre.amin(1) < 80).all()
    sky, ground = picture[:, 0, 0].float(), picture[:, -1, 0].float()
    assert (sky[:, 2] > sky[:, 0] + 20).all() and (ground.mean(-1) < sky.mean(-1) - 40).all()


def test_views_differ_between_worlds_and_follow_the_arm(env: FrankaEnv) -> None:
    first = env.reset(seed=0)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        assert (difference(first["pixels"][a], first["pixels"][b]) > 20).float().mean() > 0.02
    action = torch.zeros(3, 7)
    action[1] = 1.0
    after = env.step(first.clone().set("action", action))["next"]
    changed = (difference(after["pixels"], first["pixels"]) > 20).float().mean((1, 2))
    assert changed[1] > 0.03 > changed[[0, 2]].max()


def test_worlds_are_pictured_as_if_alone(env: FrankaEnv, small_env) -> None:
    alone = small_env(1, **PIXELS)
    assert torch.equal(alone.reset(seed=4)["pixels"][0], env.reset(seed=4)["pixels"][0])
    action = 0.7 * torch.ones(3, 7)
    ours = env.step(TensorDict({"action": action}, batch_size=[3]))["next", "pixels"]
    theirs = alone.step(TensorDict({"action": action[:1]}, batch_size=[1]))["next", "pixels"]
    assert torch.equal(ours[0], theirs[0])


def test_masked_reset_pictures_only_what_was_reset(env: FrankaEnv) -> None:
    step = env.rand_step(env.reset(seed=2))["next"]
    mask = torch.tensor([[True], [False], [False]])
    fresh = env.reset(step.clone().set("_reset", mask))
    assert torch.equal(fresh["pixels"][1:], step["pixels"][1:])
    assert (difference(fresh["pixels"][0], step["pixels"][0]) > 20).any()


def test_render(env: FrankaEnv) -> None:
    observed = env.reset(seed=0)["pixels"]
    assert torch.equal(env.render(), observed)
    picture = env.observe()
    assert picture.shape == (3, 3, 48, 48) and picture.dtype == torch.float32
    torch.testing.assert_close(picture, observed.permute(0, 3, 1, 2) / 255.0)
    plain = env.render(96)
    smooth = env.render(96, samples=3)
    assert plain.shape == smooth.shape == (3, 96, 96, 3) and plain.dtype == torch.uint8
    assert torch.equal(env.render(96, num_views=2), plain[:2])
    moved = difference(plain, smooth).float()
    assert 0.01 < (moved > 8).float().mean() < 0.15  # edges only
    assert moved.mean() < 6


def test_render_without_pixels_among_the_observations(small_env) -> None:
    env = small_env(2)
    state = env.reset(seed=0)["state"]
    pictures = env.render(40)
    assert pictures.shape == (2, 40, 40, 3) and pictures.float().std() > 20
    assert torch.equal(env.state_observation(), state)
    assert (difference(pictures[0], pictures[1]) > 20).any()


@pytest.mark.parametrize(
    "options", [{"size": 0}, {"samples": 0}, {"num_views": 0}, {"size": -3}, {"size": 2.5}]
)
def test_impossible_render(env: FrankaEnv, options: dict[str, int]) -> None:
    with pytest.raises(UserError):
        env.render(**options)


@pytest.mark.parametrize("size", [1, 7, 33])
def test_any_image_size(small_env, size: int) -> None:
    picture = small_env(1, observations=("pixels",), image_size=size).reset()["pixels"]
    assert picture.shape == (1, size, size, 3)
    assert size == 1 or picture.float().std() > 5


def test_shadows_darken_the_ground(small_env) -> None:
    plain, shadowed = (
        small_env(1, **PIXELS, enable_shadows=on).reset(seed=0)["pixels"].float() for on in (False, True)
    )
    assert (shadowed <= plain + 1).float().mean() > 0.98
    assert ((plain - shadowed).amax(-1) > 10).float().mean() > 0.01


def test_projection_of_known_points() -> None:
    config, size = FrankaConfig(), 200
    eye, centre = (1.15, 0.0, 0.65), (0.0, 0.0, 0.45)
    points = torch.tensor([centre, (0.0, 0.1, 0.45), (0.0, -0.1, 0.45), (0.0, 0.0, 0.55)])
    seen = project(points, config, size)
    torch.testing.assert_close(seen[0], torch.tensor([100.0, 100.0]), atol=1e-3, rtol=0)
    # A point beside the centre, as far away as it: a right triangle.
    focal = 100 / math.tan(math.radians(30))
    shift = focal * 0.1 / np.linalg.norm(np.subtract(eye, centre))
    torch.testing.assert_close(seen[1], torch.tensor([100 + shift, 100.0]).float(), atol=1e-2, rtol=0)
    torch.testing.assert_close(seen[2], torch.tensor([100 - shift, 100.0]).float(), atol=1e-2, rtol=0)
    assert seen[3, 1] < 95 and abs(seen[3, 0] - 100) < 1e-3
    # The top of the picture is 30° above the middle.
    down = math.atan2(0.2, 1.15)
    top = torch.tensor(
        [[eye[0] - math.cos(down - math.radians(30)), 0.0, 0.65 - math.sin(down - math.radians(30))]]
    )
    torch.testing.assert_close(project(top, config, size), torch.tensor([[100.0, 0.0]]), atol=1e-2, rtol=0)


def test_projection_hits_the_fingers(small_env) -> None:
    """Only the fingers' opening differs between two pictures; the tool point lies between their tips."""
    closed, opened = (small_env(3, finger_opening=o, goal_sampling="reachable") for o in (0.0, 0.04))
    for one in (closed, opened):
        one.reset(seed=5)
    marks = project(closed.tool_position(), closed.config, 256)
    changed = difference(closed.render(256), opened.render(256)) > 25
    for k in range(3):
        rows, columns = changed[k].nonzero(as_tuple=True)
        assert rows.numel() > 20
        distance = torch.hypot(columns + 0.5 - marks[k, 0], rows + 0.5 - marks[k, 1])
        assert distance.mean() < 16 and distance.min() < 14, (k, distance.mean(), distance.min())


def test_another_lens_is_another_camera(small_env) -> None:
    """All that a configuration says about images counts, not where the camera stands alone."""
    env = small_env(1)
    env.reset(seed=0)
    before = env.render(48)
    for change in ({"camera_fov_degrees": 20.0}, {"enable_shadows": not env.config.enable_shadows}):
        assert not torch.equal(env.render(48, config=replace(env.config, **change)), before), change
    assert torch.equal(env.render(48), before)


def test_the_camera_of_videos_has_the_whole_arm_in_view_and_leaves_observations_alone(small_env) -> None:
    """The tool in poses over the middle 60 % of every joint's range."""
    env = small_env(64, goal_sampling="reachable", observations=("pixels", "joint_target"))
    before = env.reset(seed=1)["pixels"].clone()
    config = whole_arm(env.config, env.kinematics)
    film = env.render(64, config=config)
    assert torch.equal(env.render(), before) and not torch.equal(film, env.render(64))

    generator = torch.Generator().manual_seed(3)
    low, high = env.kinematics.lower, env.kinematics.upper
    middle, half = (low + high) / 2, 0.3 * (high - low)
    tools = env.kinematics.forward(middle + half * (2 * torch.rand(512, 7, generator=generator) - 1))
    seen = project(tools[tools[:, 2] > 0], config, 100)
    assert ((seen > 0) & (seen < 100)).float().mean() > 0.99
    seen = project(tools[tools[:, 2] > 0], env.config, 100)
    assert ((seen > 0) & (seen < 100)).all(-1).float().mean() < 0.9, "the camera of observations cuts"


LOW = {
    "camera_distance": 1.1,
    "camera_height": 0.5,
    "camera_target_distance": 0.45,
    "camera_target_height": 0.12,
}
OVER = {**LOW, "camera_distance": 1.5, "camera_height": 1.05, "camera_target_distance": 0.55}


@pytest.mark.parametrize(
    ("task", "camera"), [("push", LOW), ("drawer", OVER)]
)  # those of env=push, env=drawer
def test_the_camera_of_videos_has_what_a_task_is_about_in_view(small_env, task: str, camera: dict) -> None:
    env = small_env(128, task=task, camera_fov_degrees=50.0, **camera)
    env.reset(seed=1)
    tensors, goal = env.simulation.tensors, env.goal
    if task == "push":
        disc = 0.1 * torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        points = torch.cat([goal[:, None] + disc, tensors.true_objects[:, None, :3]], 1)
    else:
        (chest,) = env.config.resolved_scene.articulated
        length, width, height = chest.size
        corners = [
            (0.5 * i * length, 0.5 * j * width, z) for i in (-1, 1) for j in (-1, 1) for z in (0, height)
        ]
        x, y, z, w = tensors.bases[:, 0, 3:].unbind(-1)
        assert x.abs().max() < 1e-6 and y.abs().max() < 1e-6  # it stands upright
        cos, sin = (1 - 2 * z * z)[:, None], (2 * z * w)[:, None]
        u, v, up = torch.tensor(corners).unbind(-1)
        turned = torch.stack([cos * u - sin * v, sin * u + cos * v, up.expand(len(goal), 8)], -1)
        points = torch.cat([tensors.bases[:, :1, :3] + turned, goal[:, None]], 1)  # goal: the handle, open
    config = whole_arm(env.config, env.kinematics)
    seen = project(points, config, 100)
    assert ((seen > 0) & (seen < 100)).all()
    arm = project(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), config, 100)
    assert 30 < arm[0, 1] - arm[1, 1] < 60  # a metre of it is a third of the image at least


def test_the_camera_of_videos_without_a_scene_and_with_one_beyond_reach(env: FrankaEnv) -> None:
    """What the arm cannot meet does not make it small."""

    def framed(**changes: Any) -> list[float]:
        config = whole_arm(FrankaConfig(**changes), env.kinematics)
        return [config.camera_distance, config.camera_height, config.camera_target_height]

    assert framed() == pytest.approx([1.654562, 0.806710, 0.518960], abs=1e-5)
    wall = {"name": "wall", "size": [0.02, 3.0, 2.0], "at": [0.6, 0.0, 1.0]}
    cut, far = {**wall, "size": [0.02, 1.6, 0.8], "at": [0.6, 0.0, 0.4]}, {**wall, "at": [9.0, 0.0, 1.0]}
    none, beyond, whole, part = (
        framed(gripper=True, scene={"obstacles": some}) for some in ([], [far], [wall], [cut])
    )
    assert beyond == none and whole == pytest.approx(part) and whole[0] > none[0]
    tables = [
        framed(gripper=True, scene={"table": {"at": at}})
        for at in ([5.0, 0, 0], [0, 9.0, 0], [0.35, 0, -5.0])
    ]
    assert tables == [framed()] * 3


def test_framing(env: FrankaEnv) -> None:
    assert env.camera_framing == ((1.15, 0.0, 0.65), (0.0, 0.0, 0.45))
    with pytest.raises(UserError):
        look_at((1, 1, 1), (1, 1, 1))
    straight_down = np.array(look_at((0, 0, 2), (0, 0, 0)))
    assert np.isfinite(straight_down).all()


def test_the_marker_is_at_the_goal_where_nothing_is_observed_in_images(small_env) -> None:
    """As videos of a model that reads vectors show it: after a reset, a step and a goal set by hand."""
    options = {"goal_sampling": "reachable", "show_goal": True, "image_size": 48}
    seen = small_env(3, **options, observations=("pixels", "state", "joint_target"))
    blind = small_env(3, **options)
    action = TensorDict({"action": torch.zeros(3, 7)}, batch_size=[3])
    for change in (
        lambda env: env.reset(seed=2),
        lambda env: env.step(action.clone()),
        lambda env: env.set_goal(torch.tensor([0.3, -0.3, 0.3])),
    ):
        change(seen), change(blind)
        assert torch.equal(blind.render(48), seen.render(48))
    plain = small_env(3, goal_sampling="reachable", image_size=48)
    plain.reset(seed=2), blind.reset(seed=2)
    changed = difference(plain.render(96), blind.render(96)) > 25
    for k, mark in enumerate(project(blind.goal, blind.config, 96)):
        rows, columns = changed[k].nonzero(as_tuple=True)
        assert rows.numel() and torch.hypot(columns - mark[0], rows - mark[1]).max() < 6, k


def test_a_camera_that_looks_straight_down_is_not_turned_by_a_small_offset(small_env) -> None:
    straight = {"camera_distance": 0.4, "camera_target_distance": 0.4, "camera_height": 1.2}
    env = small_env(16, **straight, randomization={"camera_position": 0.02})
    env.reset(seed=0)
    x, y, z, w = env.simulation.tensors.poses[:, 3:].unbind(-1)
    right = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], -1)
    expected = np.array(look_at((0.4, 0.0, 1.2), (0.4, 0.0, 0.45)))[3:]
    torch.testing.assert_close(right, torch.tensor([[0.0, 1.0, 0.0]]).expand(16, 3), atol=0.05, rtol=0)
    ours = env.simulation.tensors.poses[:, 3:]
    assert ((ours @ torch.tensor(expected, dtype=torch.float32)).abs() > 0.999).all()
