"""Goals that are drawn keep clear of obstacles, on whichever table, and are as before where there are none."""

from __future__ import annotations

import math

import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.envs.tasks import pick
from franka_wm.envs.tasks.reach import CLEAR

WORLDS = 64
CUBE = Body(name="cube", at=(0.5, 0.0), spread=(0.02, 0.02))
WALL = Obstacle(name="wall", size=(0.04, 0.30, 0.20), at=(0.65, 0.06, 0.25), angle=0.2)


def goals(task: str, *obstacles: Obstacle, lift: float = 0.0) -> torch.Tensor:
    """(episodes × worlds, 3), of several; a table that is higher is taken off again."""
    config = FrankaConfig(
        task=task,
        scene=Scene(objects=(CUBE,), obstacles=obstacles),
        observations=("state",),
        gripper=True,
        goal_sampling="reachable",
        home=FrankaConfig(task="pick").home if task == "pick" else None,
        randomization={"table_height": lift} if lift else {},
    )
    env = FrankaEnv(config, num_envs=WORLDS, device="cpu", seed=0)
    drawn = []
    for _ in range(4):
        env.reset()
        place = (
            env.simulation.tensors.goal_center if task == "track" else env.simulation.tensors.task_goal
        ).clone()
        place[:, 2] -= env.simulation.tensors.raised
        drawn.append(place)
    return torch.cat(drawn)


def away(place: torch.Tensor, one: Obstacle) -> torch.Tensor:
    """From a box, by a plain formula."""
    x, y = place[:, 0] - one.at[0], place[:, 1] - one.at[1]
    cos, sin = math.cos(one.angle), math.sin(one.angle)
    local = torch.stack((cos * x + sin * y, cos * y - sin * x, place[:, 2] - one.at[2]), -1)
    return (local.abs() - 0.5 * torch.tensor(one.size)).clamp_min(0).norm(dim=-1)


@pytest.mark.parametrize(("task", "clear"), [("reach", CLEAR), ("pick", CLEAR), ("track", CLEAR + 0.1)])
@pytest.mark.parametrize("lift", [0.0, 0.05])
def test_drawn_goals_keep_clear_of_obstacles(task: str, clear: float, lift: float) -> None:
    free, beside = goals(task, lift=lift), goals(task, WALL, lift=lift)
    assert (away(free, WALL) < clear).any(), "else nothing is tested"
    assert away(beside, WALL).min() > clear - 1e-5
    kept = away(free, WALL) > clear + 1e-5
    torch.testing.assert_close(beside[kept], free[kept])  # those that were clear are as they were


def test_where_no_place_is_clear_the_cubes_is_the_goal(monkeypatch) -> None:
    far = Obstacle(name="far", size=(0.1, 0.1, 0.2), at=(0.4, 0.6, 0.1))
    assert torch.equal(goals("pick", far), goals("pick"))
    monkeypatch.setattr(pick, "CLEAR", 10.0)
    there = goals("pick", far)
    assert (there[:, 2] - 0.02).abs().max() < 2e-3 and (
        there[:, :2] - torch.tensor(CUBE.at)
    ).abs().max() <= 0.0201


def test_empty_shapes_do_not_count() -> None:
    socket = Obstacle(name="hole", shape="socket", size=(0.2, 0.05, 0.2), at=(0.4, 0.6, 0.1))
    assert Scene(objects=(CUBE,), obstacles=(socket,)).solids == []
    assert len(Scene(objects=(CUBE,), obstacles=(WALL,)).solids) == 1
