"""Drawers, doors and sockets in a scene; the tasks drawer and peg: what moves, what is observed, what is refused."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
import yaml
from torchrl.envs.utils import check_env_specs

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Articulated, Body, Obstacle, Scene, Table
from franka_wm.envs.tasks import Drawer
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings
from presets import GRIPPER

OBSERVED = ("state", "joint_target", "objects", "goal")
ROOM = Scene(
    objects=(Body(name="cube", at=(0.45, 0.03), spread=(0.0, 0.02)),),
    articulated=(
        Articulated(name="chest", at=(0.70, -0.30), spread=(0.02, 0.02), turn=0.1),
        Articulated(
            name="fridge",
            kind="door",
            at=(0.65, 0.45),
            angle=0.5,
            travel=1.6,
            joint_friction=0.02,
            joint_damping=0.02,
        ),
    ),
    table=Table(size=(1.5, 2.0, 0.05), at=(0.5, 0.0, 0.0)),
)


def make(num_envs: int, task: str = "drawer", *, seed: int = 0, **changes) -> FrankaEnv:
    return FrankaEnv(
        FrankaConfig(**(GRIPPER | {"task": task} | changes)), num_envs=num_envs, device="cpu", seed=seed
    )


def expert(env: FrankaEnv) -> ExpertPolicy:
    return ExpertPolicy(env.simulation.task, env.kinematics, env.config)


def idle(env: FrankaEnv, steps: int) -> torch.Tensor:
    """``objects`` after so many steps of an arm at rest."""
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    for _ in range(steps):
        env.simulation.tensors.action.copy_(action)
        env.simulation.step()
    return env.simulation.tensors.next_objects.clone()


@pytest.fixture(scope="module")
def room() -> FrankaEnv:
    """Three worlds with a cube, a drawer and a door."""
    return make(3, "reach", gripper=True, scene=ROOM, episode_length=1000)


@pytest.fixture(scope="session")
def preset(composed) -> Callable[[str], FrankaConfig]:
    """The config of ``env=NAME``."""

    def make_config(name: str) -> FrankaConfig:
        return RunSettings.of(composed(f"env={name}")).env.arm

    return make_config


# -- what is observed -------------------------------------------------------------------------------------------


def test_specs_and_order(room: FrankaEnv) -> None:
    """13 of the cube and of each handle, then opening and speed of each joint."""
    assert room.config.object_dim == 3 * 13 + 2 * 2
    check_env_specs(make(1))
    objects = room.reset()["objects"]
    assert torch.allclose(objects[:, 2], torch.tensor(0.02), atol=1e-4)
    for k in (1, 2):
        assert torch.allclose(objects[:, 13 * k + 2], torch.tensor(0.11))
    assert (objects[:, -4:] == 0).all()
    assert len(objects[:, 13].unique()) == 3  # the chest's place is drawn
    assert (objects[:, 26] - objects[0, 26]).abs().max() < 1e-6  # the fridge's is not


def test_what_is_observed_is_where_newton_has_it(room: FrankaEnv) -> None:
    """Opened by hand and let go: places, quaternions and speeds of the handles against Newton's bodies."""
    room.reset()
    room.simulation.tensors.rest_qd.view(3, -1)[:, -2:] = torch.tensor([1.0, 2.0])
    objects = idle(room, 4)
    frames = room.simulation.tensors.body_q
    for k, body in ((1, -3), (2, -1)):
        there = objects[:, 13 * k : 13 * k + 7]
        assert (there[:, :3] - frames[:, body, :3]).abs().max() < 1e-5
        assert ((there[:, 3:] * frames[:, body, 3:]).sum(-1).abs() - 1).abs().max() < 1e-5
    before, after = idle(room, 1), idle(room, 1)
    for k in (1, 2):
        moved = (after - before)[:, 13 * k : 13 * k + 3] * room.config.fps
        mean = 0.5 * (after + before)[:, 13 * k + 7 : 13 * k + 10]
        assert (moved - mean).abs().max() < 0.03, k
    assert (after[:, -4] > 0.03).all() and (after[:, -2] > 0.03).all()  # both are open


# -- physics ----------------------------------------------------------------------------------------------------


def test_nothing_moves_by_itself(room: FrankaEnv) -> None:
    start = room.reset()["objects"].clone()
    after = idle(room, 30)
    assert (after - start)[:, [0, 1, 2, *range(13, 20), *range(26, 33)]].abs().max() < 1e-4
    assert after[:, -4:].abs().max() < 1e-5


def test_a_joint_stops_at_its_ends(room: FrankaEnv) -> None:
    room.reset()
    speed = room.simulation.tensors.rest_qd.view(3, -1)
    speed[:, -2:] = torch.tensor([1.5, 6.0])
    most = torch.zeros(3, 2)
    for _ in range(30):
        most = torch.maximum(most, idle(room, 1)[:, [-4, -2]])
    for limit, opened in zip((0.20, 1.6), most.unbind(-1), strict=True):
        assert (opened > 0.9 * limit).all() and (opened < 1.05 * limit).all(), (limit, opened)
    speed[:, -2:] = torch.tensor([-1.5, -6.0])
    assert idle(room, 30)[:, [-4, -2]].min() > -0.01


@pytest.mark.parametrize("name", ["drawer", "peg"])
def test_experts_succeed_in_every_world(name: str, preset) -> None:
    env = FrankaEnv(preset(name), num_envs=16, device="cpu", seed=1)
    played = play_episodes(env, expert(env), seed=1)
    assert played["success"].all(), played["success"].nonzero()
    assert env.statistics()["overflow"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("drawer", 0.98), ("peg", 0.90)])
def test_experts_succeed_in_nearly_all_of_many_worlds(name: str, least: float, preset) -> None:
    env = FrankaEnv(preset(name), num_envs=128, device="cpu", seed=11)
    assert play_episodes(env, expert(env), seed=11)["success"].float().mean() >= least


def test_a_block_with_a_hole_stands_still() -> None:
    env = make(2, "peg")
    start = env.reset()["objects"].clone()
    after = idle(env, 30)
    assert (after - start)[:, [0, 1, 2, 13, 14, 15]].abs().max() < 1e-4


# -- success and reward -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("opening", "enough"), [(None, 0.288), (0.30, 0.30)])
def test_the_drawer_is_open_where_it_is_open_enough(opening: float | None, enough: float) -> None:
    env = make(2, drawer_opening=opening, action_penalty=0.0)
    env.reset()
    t = env.simulation.tensors
    t.rest_q[:, -1] = torch.tensor([enough - 0.004, enough + 0.004])
    idle(env, 1)
    assert t.success.flatten().tolist() == [False, True]
    assert (t.reward >= 0.48).all() and (t.reward <= 0.6).all()  # half for the drawer, the hand is far away
    sparse = make(2, drawer_opening=opening, action_penalty=0.0, reward="sparse")
    sparse.reset()
    sparse.simulation.tensors.rest_q[:, -1] = t.rest_q[:, -1]
    idle(sparse, 1)
    assert sparse.simulation.tensors.reward.flatten().tolist() == [0.0, 1.0]


def test_a_peg_is_in_the_hole_where_it_is_deep_enough() -> None:
    env = make(4, "peg", action_penalty=0.0)
    env.reset()
    t = env.simulation.tensors
    block = t.rest_q[:, 9:16].clone()
    t.rest_q[:, 2:9] = block
    top = block[0, 2] + 0.02 + 0.05  # the peg's middle where its end is in the hole's mouth
    t.rest_q[:, 4] = top + torch.tensor([0.025, -0.006, -0.020, -0.020])
    t.rest_q[3, 2] += 0.1  # beside the block
    idle(env, 1)
    assert t.success.flatten().tolist() == [False, False, True, False]
    near, shallow, deep, _ = t.reward.flatten().tolist()
    assert near < 0.7 < shallow < 0.9 and deep == 1.0


# -- worlds -----------------------------------------------------------------------------------------------------


def played(
    num_envs: int, task: str, actions: list[torch.Tensor] | None = None
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """World 0's observations over the end of an episode and into the next one, and its actions.

    Args:
        num_envs: How many worlds the expert plays.
        task: Which.
        actions: What world 0 does instead: torch's own functions, which the expert calls, round otherwise in another
            batch on some machines.
    """
    env = make(num_envs, task, seed=3, episode_length=45)
    policy, observation, out, done = expert(env), env.reset(), [], []
    for step in range(55):
        decided = policy(observation)
        if actions is not None:
            decided["action"][0] = actions[step]
        done.append(decided["action"][0].clone())
        after, observation = env.step_and_maybe_reset(decided)
        out.append(torch.cat([after["next"][key][0].flatten() for key in (*OBSERVED, "reward")]))
    return torch.stack(out), done


@pytest.mark.parametrize("task", ["drawer", "peg"])
def test_a_world_is_the_same_whatever_their_number(task: str) -> None:
    alone, actions = played(1, task)
    for num_envs in (2, 8):
        assert torch.equal(alone, played(num_envs, task, actions)[0]), num_envs


def test_a_masked_reset_leaves_other_worlds_alone(room: FrankaEnv) -> None:
    room.reset()
    room.simulation.tensors.rest_qd.view(3, -1)[:, -2:] = torch.tensor([1.0, 2.0])
    opened = idle(room, 4)
    bases = room.simulation.tensors.bases.clone()
    room.simulation.reset(torch.tensor([False, True, False]))
    now = room.simulation.tensors.objects
    assert torch.equal(now[[0, 2]], opened[[0, 2]]) and (opened[:, [-4, -2]] > 0.03).all()
    assert (now[1, -4:] == 0).all() and not torch.equal(now[1, 13:16], opened[1, 13:16])
    assert torch.equal(room.simulation.tensors.bases[[0, 2]], bases[[0, 2]])
    frames = room.simulation.tensors.body_q  # its links moved with it
    assert (frames[1, -3, :3] - now[1, 13:16]).abs().max() < 1e-5


def test_a_state_that_was_saved_goes_on_bit_for_bit() -> None:
    env = make(2, episode_length=200)
    policy, observation = expert(env), env.reset()
    for _ in range(32):
        observation = env.step(policy(observation))["next"]
    saved, first = env.get_state(), []
    assert (observation["objects"][:, -2] > 0.01).any()  # the drawer is on its way
    for turn in range(2):
        if turn:
            env.reset()  # which places the chest elsewhere
            observation = env.set_state(saved)
        for k in range(10):
            observation = env.step(policy(observation.exclude("action")))["next"]
            if turn:
                assert all(torch.equal(observation[key], first[k][key]) for key in OBSERVED), k
            else:
                first.append(observation.clone())


def test_a_joint_that_is_not_finite_breaks_its_world_alone(room: FrankaEnv) -> None:
    room.reset()
    room.statistics()
    room.simulation.tensors.rest_qd.view(3, -1)[:, -2] = 1.0
    last = idle(room, 3)
    room.simulation.tensors.rest_q[1, -2] = torch.nan
    room.simulation.step(restart=False)
    after = room.simulation.tensors.next_objects.clone()
    assert after.isfinite().all() and room.simulation.tensors.truncated.flatten().tolist() == [
        False,
        True,
        False,
    ]
    assert after[1, -4] == last[1, -4] == room.simulation.tensors.rest_q[1, -2]
    room.simulation.reset(torch.tensor([False, True, False]))
    assert idle(room, 3).isfinite().all() and room.statistics()["nonfinite"] == 1


def test_all_stand_apart_in_every_draw() -> None:
    """A drawer and a cube drawn from the same room: the cube is never in what the drawer sweeps."""
    scene = Scene(
        objects=(Body(name="cube", at=(0.45, 0.0), spread=(0.15, 0.40)),),
        articulated=(Articulated(name="chest", at=(0.70, 0.0), spread=(0.02, 0.15), turn=0.3),),
        obstacles=(Obstacle(name="wall", size=(0.05, 0.05, 0.1), at=(0.6, -0.55, 0.05)),),
        table=Table(size=(1.5, 2.0, 0.05), at=(0.5, 0.0, 0.0)),
    )
    env = make(64, "reach", gripper=True, scene=scene)
    cube = env.reset()["objects"][:, :2]
    base = env.simulation.tensors.bases[:, 0]
    assert base[:, 0].std() > 0.005 and base[:, 1].std() > 0.05
    angle = 2 * torch.atan2(base[:, 5], base[:, 6])
    away = cube - base[:, :2]
    x = torch.cos(angle) * away[:, 0] + torch.sin(angle) * away[:, 1]
    y = torch.cos(angle) * away[:, 1] - torch.sin(angle) * away[:, 0]
    cx, cy, half_x, half_y = scene.articulated[0].footprint
    outside = torch.hypot(((x - cx).abs() - half_x).clamp_min(0), ((y - cy).abs() - half_y).clamp_min(0))
    assert outside.min() > 0.028  # the circle around the cube


# -- bad input --------------------------------------------------------------------------------------------------

CHEST = {"name": "chest"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drawer_opening": 0.5}, "at most the travel of scene.drawer, 0.32 m"),
        ({"scene": Scene(objects=(Body(name="cube"),))}, "task=drawer needs a drawer"),
        ({"scene": {"articulated": [CHEST | {"kind": "door", "travel": 1.5}]}}, "needs a drawer"),
        ({"task": "peg", "scene": {"objects": [{"name": "a"}]}}, "about 2 objects, the scene has 1"),
        (
            {"task": "peg", "scene": {"objects": [{"name": "a"}, {"name": "b", "at": [0.5, 0.2]}]}},
            "needs a shape=socket",
        ),
        ({"task": "lift", "scene": {"articulated": [CHEST]}}, "about 1 objects, the scene has 0"),
        ({"scene": {"articulated": [CHEST | {"kind": "lid"}]}}, "must be one of drawer, door"),
        ({"scene": {"articulated": [CHEST | {"travel": 0.4}]}}, "stays in its case"),
        ({"scene": {"articulated": [CHEST | {"kind": "door", "travel": 4.0}]}}, "from 0.01 to 3.142 rad"),
        ({"scene": {"articulated": [CHEST | {"mass": 0}]}}, "scene.chest.mass=0: must be from 0.01"),
        ({"scene": {"articulated": [CHEST | {"handle": [0.05, 0.016, 0.3]}]}}, "to that of the front"),
        ({"scene": {"articulated": [CHEST | {"size": [0.3, 0.02, 0.2]}]}}, "at least 0.08 m each"),
        ({"scene": {"articulated": [CHEST | {"joint_damping": -1}]}}, "joint_damping=-1: must be from 0"),
        ({"scene": {"articulated": [CHEST | {"at": [1.5, 0]}]}}, "the arm reaches"),
        ({"scene": {"articulated": [CHEST | {"length": 1}]}}, "unknown 'length'"),
        (
            {"scene": {"articulated": [CHEST | {"at": [0.80, 0]}]}},
            "case may stand beyond the table's edge in x",
        ),
        ({"scene": {"articulated": [CHEST, {"name": "other"}]}}, "scene.other: stands in something else"),
        (
            {"scene": {"articulated": [CHEST], "objects": [{"name": "a"}]}},
            "scene.a: stands in something else",
        ),
        (
            {"scene": {"objects": [{"name": "a", "shape": "socket", "size": [0.1, 0.1, 0.05]}]}},
            "walls of 2 mm",
        ),
        ({"scene": {"objects": [{}]}}, "has no name; give one"),
        ({"scene": {"objects": [{"name": "a", "shape": [1]}]}}, "must be one of box"),
        ({"scene": {"objects": [{"name": "a" * 99}]}}, "at most 64 characters"),
        ({"scene": {"obstacles": [{"name": f"o{k}"} for k in range(65)]}}, "has 65 bodies; the most is 64"),
        ({"scene": {"obstacles": [{"name": "a", "at": [1e30, 0, 0]}]}}, "must be from -10 to 10 m each"),
        ({"scene": {"obstacles": [{"name": "a", "angle": 1e9}]}}, "must be from -2π to 2π"),
        (
            {"scene": {"articulated": [CHEST], "obstacles": [{"name": "chest_case"}]}},
            "chest_case is there 2 times",
        ),
    ],
)
def test_what_cannot_be_is_said_in_one_line(changes: dict, said: str) -> None:
    with pytest.raises(UserError) as caught:
        FrankaConfig(**(GRIPPER | {"task": "drawer"} | changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_door_opens_towards_who_stands_before_it() -> None:
    door = Articulated(name="door", kind="door", at=(0.6, 0.0), travel=0.5 * math.pi)
    closed, opened = door.grip_at(0.0), door.grip_at(0.5 * math.pi)
    assert opened[0] < closed[0] - 0.2 and opened[1] > closed[1] + 0.2
    assert Drawer.scene is not None and Drawer.scene.articulated[0].grip_at(0.3)[0] == pytest.approx(-0.55)


def test_the_printed_drawers_stand_in_a_scene(root: Path) -> None:
    page = (root / "docs" / "tasks.md").read_text()
    text = next(b for b in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "kind: drawer" in b)
    scene = Scene.of(yaml.safe_load(text))
    assert [(one.name, one.slides) for one in scene.articulated] == [("chest", True), ("fridge", False)]


def test_a_config_with_drawers_reads_back_from_its_plain_values() -> None:
    """As the live page writes it beside what it records."""
    config = FrankaConfig(gripper=True, observations=("state",), scene=ROOM)
    assert FrankaConfig.from_mapping(asdict(config)) == config
