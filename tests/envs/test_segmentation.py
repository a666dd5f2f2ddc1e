"""Each thing of a scene has its own number in ``segmentation``, where its colour is."""

from __future__ import annotations

from dataclasses import replace

import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Articulated, Body, Obstacle, Scene
from franka_wm.training.settings import RunSettings

BASE, FINGERS, TABLE = 2, (10, 11), 254
NAMED = {12: "cube", 13: "can", 14: "case", 15: "drawer", 254: "table", 253: "wall", 252: "post"}


def test_each_thing_has_its_own_number() -> None:
    """Numbers as docs/tasks.md has them, compared with the hue of what is drawn there."""
    colors = {
        "cube": (0.9, 0.0, 0.0),
        "can": (0.0, 0.9, 0.0),
        "case": (0.0, 0.0, 0.9),
        "drawer": (0.9, 0.9, 0.0),
        "table": (0.9, 0.0, 0.9),
        "wall": (0.0, 0.9, 0.9),
        "post": (0.9, 0.45, 0.0),
    }
    scene = {
        "objects": (
            Body(name="cube", at=(0.4, -0.2), color=colors["cube"]),
            Body(name="can", shape="cylinder", size=(0.03, 0.1), at=(0.4, -0.35), color=colors["can"]),
        ),
        "articulated": (
            Articulated(name="drawer", at=(0.68, 0.3), color=colors["drawer"], case_color=colors["case"]),
        ),
        "obstacles": (
            Obstacle(name="wall", size=(0.02, 0.1, 0.1), at=(0.5, -0.5, 0.05), color=colors["wall"]),
            Obstacle(name="post", size=(0.03, 0.03, 0.1), at=(0.6, -0.1, 0.05), color=colors["post"]),
        ),
        "table": {"color": colors["table"]},
    }
    config = FrankaConfig(
        task="lift",
        scene=Scene.of(scene),
        observations=("pixels", "segmentation"),
        cameras=("side", "front"),  # from the side the drawer's front is seen
        image_size=96,
        camera_distance=1.3,
        camera_height=1.2,
        camera_target_distance=0.4,
        camera_target_height=0.0,
    )
    seen = FrankaEnv(config, num_envs=2, device="cpu", seed=0).reset()
    images = torch.cat([seen["pixels"], seen["pixels_front"]]).float()
    numbers = torch.cat([seen["segmentation"], seen["segmentation_front"]])[..., 0]
    for number, name in NAMED.items():
        there = images[numbers == number]
        assert len(there) >= 10, name
        hue = there / there.amax(-1, keepdim=True).clamp_min(1.0)  # shading changes the brightness alone
        expected = torch.tensor(colors[name]) / 0.9
        assert (hue - expected).abs().max() < 0.1, name
    assert set(numbers.unique().tolist()) <= {*range(16), *NAMED}
    assert (numbers == BASE).any() and all((numbers == f).any() for f in FINGERS)


def test_the_drawer_s_preset_sees_its_handle(composed) -> None:
    """At its own size, in every world: what of the closed drawer stands out towards the robot, handle and front."""
    config = RunSettings.of(composed("env=drawer_pixels")).env.arm
    config = replace(config, observations=("segmentation",), cameras=config.cameras[:1])
    seen = FrankaEnv(config, num_envs=8, device="cpu", seed=0).reset()
    assert (seen["segmentation"] == 13).sum((1, 2, 3)).min() >= 20  # from the front 5 to 12
