"""Newton's own collision detection in the place of MuJoCo's: experts succeed, worlds stay apart, nothing is lost."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.constants import NUM_FINGERS
from franka_wm.envs.scene import Articulated, Body, Scene
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from presets import LIFT

OBSERVED = ("state", "joint_target", "objects", "contacts")
CUBE = Body(name="cube", at=(0.5, 0.0), spread=(0.1, 0.15), turn=math.pi / 4)


def make(num_envs: int = 2, *, seed: int = 0, **changes) -> FrankaEnv:
    values = LIFT | {"observations": OBSERVED, "collision_pipeline": "newton"}
    return FrankaEnv(FrankaConfig(**(values | changes)), num_envs=num_envs, device="cpu", seed=seed)


def expert(env: FrankaEnv) -> ExpertPolicy:
    return ExpertPolicy(env.simulation.task, env.kinematics, env.config)


def still(env: FrankaEnv, observation, steps: int):
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    for _ in range(steps):
        observation = env.step(observation.set("action", action))["next"]
    return observation


@pytest.mark.parametrize("value", ["bullet", "newton"])
def test_what_it_cannot_be_is_refused(value: str) -> None:
    said = "touches nothing" if value == "newton" else "must be one of mujoco, newton"
    with pytest.raises(UserError, match=said):
        FrankaConfig(task="reach", collision_pipeline=value)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "steps"), [("lift", 60), ("push", 60), ("drawer", 90)])
def test_experts_succeed(task: str, steps: int) -> None:
    env = make(16, seed=1, task=task, episode_length=steps)
    assert play_episodes(env, expert(env), seed=1)["success"].all()
    statistics = env.statistics()
    assert statistics["overflow"] == 0 and statistics["nonfinite"] == 0


@pytest.mark.slow
def test_what_is_held_stays_and_is_felt() -> None:
    """Two seconds at rest: slips by less than 0.1 mm, and each finger feels what its servo pushes with."""
    env = make(8, seed=1, episode_length=200)
    policy, root = expert(env), env.reset()
    for _ in range(60):
        root = env.step(policy(root))["next"]
    held, seen = torch.zeros(8, 8), []
    held[:, -1] = -1.0
    for _ in range(80):
        root = env.step(root.set("action", held))["next"]
        seen.append(root["objects"][:, 2] - root["state"][:, 16])
    assert root["success"].all()
    assert (seen[-1] - seen[19]).abs().max() < 1e-4
    assert (root["contacts"] - 1000.0 * root["state"][:, 20:22]).abs().max() < 1.0


@pytest.mark.slow
def test_a_world_is_the_same_whatever_stands_beside_it() -> None:
    """Bit for bit, over a grasp and into the next episode; and not bit for bit what MuJoCo's contacts make of it."""

    actions = []

    def world0(num_envs: int, **changes) -> torch.Tensor:
        env = make(num_envs, seed=3, **changes)
        policy, root, out = expert(env), env.reset(), []
        for k in range(70):
            decided = policy(root)
            if k == len(actions):  # the first time
                actions.append(decided["action"][0].clone())
            decided["action"][0] = actions[k]
            step, root = env.step_and_maybe_reset(decided)
            out.append(torch.cat([step["next", key][0] for key in OBSERVED]))
        return torch.stack(out)

    alone = world0(1)
    assert all(torch.equal(alone, world0(n)) for n in (2, 8))
    other = world0(1, collision_pipeline="mujoco")
    assert not torch.equal(alone, other) and (alone - other)[:60, :7].abs().max() < 0.05


@pytest.mark.slow
def test_the_same_state_has_the_same_future() -> None:
    env = make(2, seed=1)
    policy, root = expert(env), env.reset()
    for _ in range(35):
        root = env.step(policy(root))["next"]
    state, futures = env.get_state(), []
    for _ in range(2):
        root = env.set_state(state)
        for _ in range(5):
            root = env.step(policy(root))["next"]
        futures.append(root["objects"].clone())
    assert torch.equal(*futures) and (futures[0][:, 2] > 0.1).all()


@pytest.mark.slow
def test_lost_contacts_end_all_worlds_and_nothing_is_printed(capfd) -> None:
    """A heap of boxes in one world, 40 contacts of its own and 20 of the other where there is room for 56.

    All worlds share the room, and nobody can say whose contacts were lost. Newton counts no more than it has room for.
    """
    boxes = tuple(Body(name=f"box{k}", at=(0.45 + 0.05 * (k % 2), -0.2 + 0.1 * k)) for k in range(5))
    env = make(2, task="reach", gripper=True, scene=Scene(objects=boxes), max_contacts=28)
    env.reset()
    state = env.get_state()
    for k, box in enumerate(boxes):  # thrown into one another
        at = NUM_FINGERS + 7 * k
        state["rest_q"][0, at : at + 3] = torch.tensor([0.5, 0.002 * k, 0.021 + 0.001 * k])
        row = env.simulation.model.body_label.index(box.name)
        state["body_q"][0, row] = state["rest_q"][0, at : at + 7]
    root = env.set_state(state)
    still(env, root, 1)
    env.statistics()
    capfd.readouterr()
    after = still(env, env.set_state(state), 1)
    assert after["truncated"].all() and env.statistics()["overflow"] == 2
    assert capfd.readouterr().out == ""


@pytest.mark.slow
def test_a_broken_world_breaks_alone() -> None:
    env = make(2)
    action = torch.zeros(2, 8)
    action[1, 7] = torch.nan
    after = env.step(env.reset().set("action", action))["next"]
    assert after["truncated"].squeeze(-1).tolist() == [False, True]
    assert all(after[key].isfinite().all() for key in OBSERVED) and env.statistics()["nonfinite"] == 1


@pytest.mark.slow
def test_drawn_sizes_and_heights_are_touched() -> None:
    """Cubes of each world's own size rest on a table of its own height, a drawer beside them."""
    cubes = tuple(Body(name=f"cube{k}", at=(0.45, 0.1 * k)) for k in range(2))
    scene = Scene(objects=cubes, articulated=(Articulated(name="chest", at=(0.7, -0.3)),))
    env = make(
        6, task="reach", gripper=True, scene=scene, randomization={"object_size": 0.3, "table_height": 0.05}
    )
    root = env.reset(seed=3)
    t = env.simulation.tensors
    expected = 0.02 * t.sizes + t.raised[:, None]
    assert (expected - 0.02).abs().max() > 0.02
    heights = still(env, root, 20)["objects"][:, :26].view(6, 2, 13)[..., 2]
    assert (heights - expected).abs().max() < 2e-4
    assert env.statistics()["overflow"] == 0


@pytest.mark.slow
def test_meshes_are_touched_as_their_hulls(tmp_path: Path) -> None:
    """A file's cube is lifted as the box is; its triangles alone would let it be thrown off the table."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((40, 40, 40)).export(tmp_path / "cube.obj")
    drawn = {"at": CUBE.at, "spread": CUBE.spread, "turn": CUBE.turn}
    cube = Body(name="cube", shape="mesh", file=str(tmp_path / "cube.obj"), scale=0.001, **drawn)
    env = make(8, seed=1, scene=Scene(objects=(cube,)))
    assert play_episodes(env, expert(env), seed=1)["success"].all()
    assert env.statistics()["overflow"] == 0
