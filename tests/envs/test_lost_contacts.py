"""Contacts for which there was no room: each kind is noticed, whom it marks, and what it ends."""

from __future__ import annotations

import pytest
import torch
from mujoco_warp import OverflowType
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.simulation.bodies import CAPACITY
from franka_wm.envs.tasks import TorchTask

BOXES = tuple(Body(name=f"box{k}", at=(0.45 + 0.05 * (k % 2), -0.2 + 0.1 * k)) for k in range(5))


class Anything(TorchTask):
    """Whatever happens is a success."""

    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(draws[:, :3]) + 0.4

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return state[..., 0] * 0.0

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return state[..., 0] < 1e9


def still(env: FrankaEnv, root: TensorDictBase) -> TensorDictBase:
    action = torch.zeros(env.num_envs, env.action_dim)
    action[:, -1] = 1.0
    return env.step(root.set("action", action))["next"]


def test_each_kind_of_overflow_that_loses_contacts_is_noticed() -> None:
    """All that MuJoCo knows, but for rounds that were used up, sensors and islands, which no scene has."""
    others = ("ITERATIONS", "LS_ITERATIONS", "CONTACT_MATCH", "TACTILE", "HFIELD", "NVMAX")
    for kind in OverflowType:
        if kind.name not in ("NONE", "ALL"):
            assert bool(CAPACITY & kind) == (kind.name not in others), kind


@pytest.mark.parametrize("ends", [True, False])
def test_a_heap_that_fills_the_room_of_all_ends_all_and_none_has_succeeded(ends: bool) -> None:
    """Where worlds share the room, nobody can say whose contacts were lost: a world at rest is marked, too."""
    config = FrankaConfig(
        gripper=True,
        scene=Scene(objects=BOXES),
        max_contacts=28,
        terminate_on_success=ends,
        observations=("state", "objects"),
        gravity_compensation=True,
    )
    env = FrankaEnv(config, num_envs=2, device="cpu", task=Anything(config))
    after = still(env, env.reset())
    assert after["success"].all() and (after["terminated"] == ends).all() and not after["overflow"].any()
    root, rest_q = env.reset(), env.simulation.tensors.rest_q.view(2, -1)
    for k in range(5):  # thrown into one another
        rest_q[0, 2 + 7 * k : 5 + 7 * k] = torch.tensor([0.5, 0.002 * k, 0.021 + 0.001 * k])
    after = still(env, root)
    assert after["overflow"].all() and after["truncated"].all()
    assert not after["success"].any() and not after["terminated"].any()
    assert env.statistics()["success"] == (0.5 if ends else 0.0), "two ended well before, if they could"


def test_there_is_the_room_that_was_asked_for(recwarn: pytest.WarningsRecorder) -> None:
    """Also where objects that may start anywhere in a region would be drawn into one another before the first reset."""
    crowd = tuple(
        Body(name=f"cube{k}", size=(0.03,) * 3, at=(0.5, 0.0), spread=(0.15, 0.25)) for k in range(8)
    )
    config = FrankaConfig(gripper=True, scene=Scene(objects=crowd), max_contacts=48, observations=("state",))
    env = FrankaEnv(config, num_envs=2, device="cpu")
    assert env.simulation.solver.mjw_data.naconmax == 2 * 48  # pyright: ignore[reportAttributeAccessIssue]
    assert not [one for one in recwarn if "nconmax" in str(one.message)]
