"""Experts grasp what a scene may hold: tall and long things, flat ones, and boxes of which one side fits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from franka_wm.envs import FrankaEnv
from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.solids import Solid
from franka_wm.envs.tasks.experts import grasp_of
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("cylinder", (0.033, 0.11)),
        ("capsule", (0.02, 0.08)),
        ("box", (0.04, 0.04, 0.16)),
        ("box", (0.02, 0.12, 0.03)),
        ("box", (0.12, 0.02, 0.03)),
    ],
)
def test_it_lifts_what_fits_between_the_fingers(shape: str, size: tuple[float, ...], composed) -> None:
    thing = Body(name="thing", shape=shape, size=size, at=(0.5, 0.0), spread=(0.1, 0.15), turn=math.pi / 4)
    config = replace(RunSettings.of(composed("env=lift")).env.arm, scene=Scene(objects=(thing,)))
    env = FrankaEnv(config, num_envs=8, device="cpu")
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, config), seed=1)
    assert played["success"].float().mean() >= 7 / 8


def test_a_cube_is_grasped_in_its_middle_by_either_side() -> None:
    """As tasks' own objects are; a flat box higher, so that the fingers do not stand on the table."""
    assert grasp_of(Solid(name="cube", shape="box", size=(0.04, 0.04, 0.04))) == {"grip": 0.0}
    assert grasp_of(Solid(name="ball", shape="sphere", size=(0.03,))) == {"grip": 0.0}
    assert grasp_of(Solid(name="plate", shape="box", size=(0.04, 0.04, 0.01)))["grip"] == pytest.approx(
        0.0055
    )
