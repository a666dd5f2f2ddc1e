"""The table's height, drawn anew in each episode: what is touched, seen, starts, pays and ends by it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Obstacle, Scene
from franka_wm.envs.simulation.bodies import SUNK
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.live.objects import move_object
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings
from presets import LIFT

WIDTH, TOP = 0.08, 0.02
CHEST = {"name": "chest", "kind": "drawer", "size": (0.2, 0.2, 0.2), "travel": 0.1, "at": (0.6, -0.4)}
ROOM = Scene(
    objects=(Body(name="cube", at=(0.5, 0.0), spread=(0.05, 0.1)), Body(name="other", at=(0.4, 0.35))),
    obstacles=(Obstacle(name="step", size=(0.1, 0.1, 0.06), at=(0.6, 0.35, 0.05)),),  # it stands on the table
    articulated=(CHEST,),  # type: ignore[arg-type]
    table={"at": (0.35, 0.0, TOP), "size": (1.1, 1.4, 0.05)},  # type: ignore[arg-type]
)
LOOK: dict[str, Any] = {
    "observations": ("pixels", "segmentation"), "camera_distance": 1.3, "camera_height": 0.1, "image_size": 64,
    "camera_target_distance": 0.5, "camera_target_height": 0.05, "pose_noise": 0.0,
}  # fmt: skip


def make(num_envs: int, *, height: float = WIDTH, **changes: Any) -> FrankaEnv:
    values = LIFT | {"scene": ROOM} | changes
    ranges = {"table_height": height} | values.pop("randomization", {})
    return FrankaEnv(FrankaConfig(**values, randomization=ranges), num_envs=num_envs, device="cpu", seed=0)


def raised(env: FrankaEnv) -> torch.Tensor:
    return env.simulation.tensors.raised


def still(env: FrankaEnv, root, steps: int):
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    for _ in range(steps):
        root = env.step(root.set("action", action))["next"]
    return root


@pytest.fixture(scope="module")
def tables() -> FrankaEnv:
    return make(6)


def test_each_episode_of_each_world_has_its_own(tables: FrankaEnv) -> None:
    seen = []
    for seed in range(8):
        tables.reset(seed=seed)
        seen.append(raised(tables).clone())
    heights = torch.stack(seen)
    assert len(heights.unique()) == heights.numel() and heights.abs().max() <= WIDTH
    assert heights.min() < -0.7 * WIDTH and heights.max() > 0.7 * WIDTH
    before = raised(tables).clone()
    tables.simulation.reset(torch.tensor([False, True] * 3))
    assert torch.equal(before == raised(tables), torch.tensor([True, False] * 3))


def test_everything_rests_at_the_drawn_height(tables: FrankaEnv) -> None:
    """Cubes, the drawer's handle, an obstacle and a cube that is put onto it stay where the table is."""
    root = tables.reset(seed=3)
    start, up = root["objects"][:, :39].view(6, 3, 13).clone(), raised(tables)
    assert torch.allclose(start[:, :2, 2], (TOP + 0.02 + up)[:, None].expand(6, 2), atol=1e-4)
    assert torch.allclose(start[:, 2, 2], TOP + 0.1 + up, atol=1e-6)
    t, data = tables.simulation.tensors, tables.simulation.solver.mjw_data
    t.rest_q[:, 9:11] = torch.tensor([0.6, 0.35])
    t.rest_q[:, 11] = TOP + 0.08 + up  # the second cube onto the obstacle
    after = still(tables, root, 25)["objects"][:, :39].view(6, 3, 13)
    assert torch.allclose(after[:, 0, 2], TOP + 0.02 + up, atol=5e-4)
    assert torch.allclose(after[:, 1, 2], TOP + 0.08 + up, atol=5e-4)
    assert torch.allclose(after[:, 2, :3], start[:, 2, :3], atol=1e-4)
    assert data.contact.dist.numpy()[: int(data.nacon.numpy()[0])].min() > -1e-3
    assert tables.statistics()["overflow"] == 0


def test_it_lasts_an_episode_and_is_saved(tables: FrankaEnv) -> None:
    solver, table = tables.simulation.solver, tables.model.shape_label.index("table")
    geom = solver.mjc_geom_to_newton_shape.numpy()[0].tolist().index(table)

    def places() -> np.ndarray:
        return solver.mjw_data.geom_xpos.numpy()[:, geom].copy()

    root = tables.reset(seed=4)
    up, saved, touched = raised(tables).clone(), tables.get_state(), places()
    first = still(tables, root, 10)["objects"].clone()
    assert torch.equal(up, raised(tables))
    tables.reset(seed=5)
    assert not torch.equal(up, raised(tables))
    tables.set_state(saved)
    assert torch.equal(up, raised(tables))
    np.testing.assert_array_equal(touched, places())
    assert torch.equal(first, still(tables, root, 10)["objects"])


def test_a_world_is_the_same_whatever_their_number() -> None:
    runs = []
    for n in (1, 8):
        env = make(n, episode_length=3, randomization={"mass": 0.2, "object_size": 0.2})
        root, out = env.reset(seed=4), []
        for k in range(5):
            action = torch.sin(torch.arange(8.0) + k).expand(n, 8).contiguous()
            step, root = env.step_and_maybe_reset(root.set("action", action))
            out.append(torch.cat([step["next", "objects"][0], raised(env)[:1]]))
        runs.append(torch.stack(out))
    assert torch.equal(*runs)


def test_cameras_see_table_obstacle_and_disc_at_their_height() -> None:
    """The same pixels as of a scene that says that height; the table's edge is in another row of each world."""
    one = replace(ROOM.objects[0], spread=(0.0, 0.0), at=(0.42, 0.0))
    scene = replace(ROOM, objects=(one,), articulated=())
    env = make(3, scene=scene, task="push", show_goal=True, **LOOK)
    seen, up = env.reset(seed=1), raised(env).tolist()
    rows = [int((image == 254).any(1).nonzero()[0]) for image in seen["segmentation"][..., 0]]
    order = sorted(range(3), key=lambda k: up[k])
    assert rows[order[0]] > rows[order[1]] > rows[order[2]], (rows, up)
    for k in range(3):
        table = replace(scene.table, at=(0.35, 0.0, TOP + up[k]))
        step = replace(scene.obstacles[0], at=(0.6, 0.35, 0.05 + up[k]))
        same = replace(scene, table=table, obstacles=(step,))
        plain = make(1, height=0.0, scene=same, task="push", show_goal=True, **LOOK).reset()
        for key in ("pixels", "segmentation"):
            other = (seen[key][k].int() - plain[key][0].int()).abs().amax(-1) > 2
            assert other.float().mean() < 2e-3, key
        assert (plain["segmentation"] == 255).any() and (plain["segmentation"] == 253).any()


def test_an_object_below_the_drawn_table_is_lost() -> None:
    """Cubes in every second world are pressed into the table, deeper than one that has left it."""
    env = make(16)
    root, t = env.reset(seed=2), env.simulation.tensors
    up, deep = raised(env).clone(), torch.arange(16) % 2 == 0
    assert (
        up[deep].max() > 0.035 and up[~deep].min() < -0.035
    )  # where the scene's own height would say otherwise
    t.rest_q[:, 4] = TOP - SUNK + up + torch.where(deep, -0.03, 0.03)
    step = still(env, root, 1)
    assert torch.equal(step["truncated"].flatten(), deep)


@pytest.mark.parametrize("name", ["lift", "push", "pick", "stack", "drawer", "peg"])
def test_experts_succeed_at_every_height(name: str, composed) -> None:
    config = RunSettings.of(composed(f"env={name}", "env.randomization.table_height=0.05")).env.arm
    env = FrankaEnv(config, num_envs=12, device="cpu", seed=1)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, config), seed=1)
    assert played["success_once"].mean() >= 11 / 12, played["success_once"]


def test_cubes_of_other_sizes_are_stacked_at_every_height(composed) -> None:
    ranges = ("env.randomization.table_height=0.05", "env.randomization.object_size=0.2")
    config = RunSettings.of(composed("env=stack", *ranges)).env.arm
    env = FrankaEnv(config, num_envs=12, device="cpu", seed=1)
    played = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, config), seed=1)
    assert played["success_once"].mean() >= 11 / 12, played["success_once"]


def test_goals_of_reach_lie_over_the_drawn_table() -> None:
    env = make(256, task="reach", gripper=True, scene=Scene(), goal_sampling="reachable", height=0.1,
               observations=("state",))  # fmt: skip
    env.reset(seed=0)
    above = env.simulation.tensors.task_goal[:, 2] - raised(env)
    assert above.min() > 0.1 and (env.simulation.tensors.task_goal[:, 2] < 0.1).any()


def test_an_object_moved_by_hand_is_put_onto_the_drawn_table() -> None:
    env = make(1)
    env.reset(seed=1)
    up = float(raised(env)[0])
    assert abs(up) > 0.005
    seen = move_object(env, "cube", (0.5, 0.1, TOP - 0.01))
    assert float(seen["objects"][0, 2]) == pytest.approx(TOP + up + 0.02, abs=1e-5)


def test_the_whole_arm_does_not_touch_the_table_beside_it() -> None:
    env = make(32, scene=Scene(objects=ROOM.objects[:1]), height=0.1, collisions="self")
    root = still(env, env.reset(seed=0), 2)
    data = env.simulation.solver.mjw_data
    assert int(data.nacon.numpy()[0]) == 4 * 32, "contacts of cubes on tables alone"
    assert not root["truncated"].any()


def test_a_link_whose_shape_has_an_obstacles_name_stays() -> None:
    wall = Obstacle(name="shape_5", at=(0.6, 0.3, 0.02))  # Newton's name of a shape without one
    env = make(2, scene=Scene(obstacles=(wall,)), task="reach", gripper=True, observations=("state",))
    moving, frames = env.model.shape_body.numpy() >= 0, env.model.shape_transform.numpy().copy()
    env.reset(seed=0)
    now = env.model.shape_transform.numpy()
    np.testing.assert_array_equal(now[moving], frames[moving])
    assert (now[~moving] != frames[~moving]).any()


def test_the_tables_colour_is_drawn_too() -> None:
    env = make(2, scene=Scene(), task="reach", gripper=True, randomization={"color": 0.3}, height=0.0, **LOOK)
    plain = make(1, scene=Scene(), task="reach", gripper=True, height=0.0, **LOOK)
    seen, one = env.reset(seed=0), plain.reset()
    table = one["segmentation"][0, ..., 0] == 254
    colours = [image[table].float().mean(0) for image in (*seen["pixels"], one["pixels"][0])]
    assert min((a - b).abs().max() for a, b in pairwise(colours)) > 10


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"task": "reach", "randomization": {"table_height": 0.05}},
            "randomization.table_height: needs a scene",
        ),
        ({"randomization": {"table_height": 0.2}}, "must be from 0 to 0.1"),
        ({"randomization": {"table_height": -0.1}}, "must be from 0 to 0.1"),
    ],
)
def test_what_cannot_be_is_one_line(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**({"task": "lift", "observations": ("state",)} | changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("task", ["reach", "track"])
def test_goals_are_above_a_raised_table(task: str) -> None:
    """The scene's own height, and what a draw adds to it."""
    scene = Scene(table={"at": (0.35, 0.0, 0.2), "size": (1.1, 1.4, 0.05)})  # type: ignore[arg-type]
    options: dict[str, Any] = {"goal_sampling": "reachable", "goal_noise": 0.6, "observations": ("state",)}
    env = make(128, task=task, scene=scene, height=0.1, gripper=True, **options)
    goal = env.reset(seed=0)["goal"]
    above = goal[:, 2] - 0.2 - raised(env)
    least = 0.05 if task == "track" else 0.10
    assert above.min() > least - 1e-6 and above.min() < least + 0.1
    assert (goal[:, 2] < 0.45).any(), "without the table some would be lower"
