"""Episodes that begin along a demonstration: in one of its states, as often as asked, whatever the number of worlds."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Articulated, Body, Scene, Table
from franka_wm.envs.simulation.demonstrated import READS
from franka_wm.policies.expert import ExpertPolicy
from presets import LIFT

PRESET = LIFT | {"episode_length": 40}
ROOM = Scene(
    objects=(Body(name="cube", at=(0.45, 0.03), spread=(0.0, 0.02)),),
    articulated=(
        Articulated(name="chest", at=(0.70, -0.30), spread=(0.02, 0.02), turn=0.1),
        Articulated(
            name="fridge", kind="door", at=(0.65, 0.45), angle=0.5, travel=1.6, joint_friction=0.02, joint_damping=0.02
        ),
    ),
    table=Table(size=(1.5, 2.0, 0.05), at=(0.5, 0.0, 0.0)),
)  # fmt: skip
EPISODES = 2


def make(num_envs: int, **changes: Any) -> FrankaEnv:
    return FrankaEnv(FrankaConfig(**(PRESET | changes)), num_envs=num_envs, device="cpu", seed=0)


@pytest.fixture(scope="module")
def shown() -> tuple[dict[str, torch.Tensor], torch.Tensor, dict[str, torch.Tensor]]:
    """The expert's lifts: what is observed at each step, first steps, and (action, what it led to)."""
    env = make(EPISODES)
    played = env.rollout(
        40, ExpertPolicy(env.simulation.task, env.kinematics, env.config), break_when_any_done=False
    )
    assert played["next", "success"][:, -1].all()
    rows = {key: played[key].flatten(0, 1) for key in READS}
    after = {key: played["next", key].flatten(0, 1) for key in ("state", "objects")}
    return rows, played["is_init"].flatten(), {"action": played["action"].flatten(0, 1), **after}


def nearest(observed: Any, rows: dict[str, torch.Tensor]) -> torch.Tensor:
    """(N,) the row whose joint angles a world has, to the last bit."""
    same = (observed["state"][:, None, :7] == rows["state"][None, :, :7]).all(-1)
    assert (same.sum(1) <= 1).all()
    return torch.where(same.any(1), same.float().argmax(1), -1)


def test_a_world_goes_on_as_the_demonstration_did(shown) -> None:
    rows, begins, after = shown
    env = make(64)
    env.simulation.start_along(rows, begins, 1.0)
    observed = env.reset(seed=5)
    row = nearest(observed, rows)
    assert (row >= 0).all() and len(row.unique()) > 30
    for key in READS:
        assert torch.allclose(observed[key], rows[key][row], atol=2e-6), key
    assert observed["is_init"].all() and (env.simulation.tensors.step_count == 0).all()
    assert rows["objects"][row, 2].max() > 0.1  # some hold the cube in the air
    following = env.step(observed.set("action", after["action"][row]))["next"]
    inside = row % 40 < 39
    # The solver's warm start is a new one, so contacts are solved to its tolerance.
    assert (following["objects"][inside, :3] - after["objects"][row[inside], :3]).norm(dim=-1).max() < 1e-3
    assert (following["state"][inside, :7] - after["state"][row[inside], :7]).abs().max() < 1e-3


def test_as_many_as_asked_for_and_alike_whatever_the_number_of_worlds(shown) -> None:
    rows, begins, _ = shown
    many, few = make(96), make(3)
    plain = many.reset(seed=5)
    for env in (many, few):
        env.simulation.start_along(rows, begins, 0.5)
    mixed, first = many.reset(seed=5), few.reset(seed=5)
    row = nearest(mixed, rows)
    assert 30 < (row >= 0).sum() < 66
    for key in READS:
        assert torch.equal(mixed[key][:3], first[key]), key
        assert torch.equal(mixed[key][row < 0], plain[key][row < 0]), key  # the others begin as they would


def test_they_begin_inside_the_step_too_and_later_parts_alone_if_asked(shown) -> None:
    rows, begins, _ = shown
    env = make(32, episode_length=3)
    _, root = env.step_and_maybe_reset(env.reset(seed=1).set("action", torch.zeros(32, env.action_dim)))
    env.simulation.start_along(rows, begins, 1.0)
    assert env.simulation.starts is not None
    env.simulation.starts.from_part(0.75)
    for _ in range(2):
        _, root = env.step_and_maybe_reset(root.set("action", torch.zeros(32, env.action_dim)))
    row = nearest(root, rows)
    assert root["is_init"].all() and (row >= 0).all()
    assert (row % 40).min() >= 30 and {*(row // 40).tolist()} == {0, 1}


def test_drawers_and_doors_stand_where_their_handles_were_seen() -> None:
    env = make(3, task="reach", gripper=True, scene=ROOM)
    env.reset(seed=3)
    env.simulation.tensors.rest_qd.view(3, -1)[:, -2:] = torch.tensor([1.0, 2.0])
    action = torch.zeros(3, env.action_dim)
    for _ in range(4):
        env.simulation.tensors.action.copy_(action)
        env.simulation.step()
    rows = {key: getattr(env.simulation.tensors, key).clone() for key in READS}
    state = env.get_state()
    assert (rows["objects"][:, -4] > 0.05).all() and (rows["objects"][:, -2] > 0.1).all()
    env.simulation.start_along(rows, torch.ones(3, dtype=torch.bool), 1.0)
    observed = env.reset(seed=4)
    row = nearest(observed, rows)
    assert (row >= 0).all()
    for key in READS:
        assert torch.allclose(observed[key], rows[key][row], atol=1e-5), key
    bases = env.simulation.tensors.bases
    assert torch.allclose(bases[..., :3], state["bases"][row][..., :3], atol=1e-5)
    assert ((bases[..., 3:] * state["bases"][row][..., 3:]).sum(-1).abs() > 1 - 1e-6).all()


def test_an_image_of_the_goal_is_that_of_the_demonstrated_one(shown) -> None:
    rows, begins, _ = shown
    env = make(8, observations=("goal_pixels", "state", "joint_target", "objects"), image_size=32)
    plain = env.reset(seed=5)["goal_pixels"]
    env.simulation.start_along(rows, begins, 1.0)
    observed = env.reset(seed=5)
    assert torch.equal(observed["goal"], rows["goal"][nearest(observed, rows)])
    assert (observed["goal_pixels"] != plain).flatten(1).any(1).all()
    # Upright at the goal, however the hand held it.
    turned = env.simulation.tensors.goal_rest.view(8, -1)[:, 5:9]
    assert (turned[:, :2] == 0).all() and torch.allclose(turned.norm(dim=-1), torch.ones(8))
