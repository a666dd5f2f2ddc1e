"""Contacts on a GPU: nothing waits for the device, every expert succeeds, and the numbers are the CPU's.

These run where there is a GPU (``make test ARGS="-m gpu"``); everywhere else they are skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.scene import Body, Scene
from franka_wm.envs.tasks import TASKS
from franka_wm.evaluation.closed_loop import play_episodes
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.training.settings import RunSettings

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
NAMES = sorted({"drawer", "lift", "peg", "pick", "push", "stack"} & set(TASKS))
N = 16


@pytest.fixture(scope="module")
def preset(composed) -> Callable[[str], FrankaConfig]:
    """The config of ``env=NAME``, which shows finger forces as well."""

    def make_config(name: str) -> FrankaConfig:
        config = RunSettings.of(composed(f"env={name}")).env.arm
        return replace(config, observations=(*config.observations, "contacts"), image_size=32)

    return make_config


def show(env: FrankaEnv, tensordict: TensorDictBase, steps: int) -> list[TensorDictBase]:
    """What an expert's steps gave."""
    policy, seen = ExpertPolicy(env.simulation.task, env.kinematics, env.config), []
    for _ in range(steps):
        step, tensordict = env.step_and_maybe_reset(policy(tensordict))
        seen.append(step["next"].clone())
    return seen


@pytest.mark.parametrize("name", [*NAMES, "lift_pixels", "lift_goal_image"])
def test_no_step_with_contacts_waits(name: str, preset) -> None:
    """Over grasps, ends of episodes and resets, the expert's decisions included."""
    env = FrankaEnv(replace(preset(name), episode_length=40), num_envs=N, device="cuda")
    first = env.reset(seed=3)
    if name in NAMES:
        show(env, first, 3)
    policy = ExpertPolicy(env.simulation.task, env.kinematics, env.config)
    action = env.rand_action(first)["action"].clone()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(85):
            chosen = policy(first) if name in NAMES else first.set("action", action)
            _, first = env.step_and_maybe_reset(chosen)
            first.pop("next", None)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("name", NAMES)
def test_experts_succeed_on_the_gpu(name: str, preset) -> None:
    """1,024 worlds; nothing overflows, nothing is lost."""
    env = FrankaEnv(preset(name), num_envs=1024, device="cuda", seed=5)
    result = play_episodes(env, ExpertPolicy(env.simulation.task, env.kinematics, env.config), seed=5)
    assert float(result["success"].float().mean()) >= (0.9 if name == "peg" else 0.98)
    statistics = env.statistics()
    assert statistics["overflow"] == 0 and statistics["nonfinite"] == 0


@pytest.mark.parametrize("name", NAMES)
def test_contacts_are_those_of_the_cpu(name: str, preset) -> None:
    """40 steps of the expert: it grasps, and carries. Contacts come in any order on a GPU, so only to a tolerance."""
    here = FrankaEnv(preset(name), num_envs=N, device="cpu", seed=2)
    there = FrankaEnv(preset(name), num_envs=N, device="cuda", seed=2)
    start, start_there = here.reset(seed=2), there.reset(seed=2)
    assert torch.allclose(start["objects"], start_there["objects"].cpu(), atol=1e-4)
    policy, actions = ExpertPolicy(here.simulation.task, here.kinematics, here.config), []
    for _ in range(40):
        start = policy(start)
        actions.append(start["action"].clone())
        start = here.step_and_maybe_reset(start)[1]
    for action in actions:
        start_there = there.step_and_maybe_reset(start_there.set("action", action.cuda()))[1]
    joints = (start["state"] - start_there["state"].cpu())[:, :7].abs()
    bodies = 13 * (here.config.num_objects + here.config.num_articulated)  # a drawer's joint follows them
    away = (start["objects"] - start_there["objects"].cpu())[:, :bodies]
    places = away.view(N, -1, 13)[..., :3].abs()
    assert joints.quantile(0.9) < 2e-2, joints.amax(1)
    assert places.quantile(0.9) < 2e-2, places.amax((1, 2))


def test_a_masked_reset_moves_no_other_cube(preset) -> None:
    env = FrankaEnv(replace(preset("lift"), auto_reset="standard"), num_envs=N, device="cuda", seed=1)
    tensordict = env.reset()
    policy = ExpertPolicy(env.simulation.task, env.kinematics, env.config)
    for _ in range(40):
        tensordict = env.step(policy(tensordict))["next"].exclude("reward")
    mask = torch.zeros(N, 1, dtype=torch.bool, device="cuda")
    mask[::2] = True
    after = env.reset(tensordict.clone().set("_reset", mask))
    for key in ("state", "objects"):
        assert torch.equal(after[key][1::2], tensordict[key][1::2]), key
        assert not torch.equal(after[key][::2], tensordict[key][::2]), key


def test_states_of_a_grasp_go_in_and_out(preset) -> None:
    env = FrankaEnv(preset("lift"), num_envs=N, device="cuda", seed=1)
    show(env, env.reset(), 40)
    state = env.get_state()

    def future() -> torch.Tensor:
        return torch.stack([seen["objects"][:, :3] for seen in show(env, env.set_state(state), 5)])

    first = future()
    env.reset(seed=9)
    torch.testing.assert_close(future(), first, rtol=1e-3, atol=1e-3)


def test_lost_contacts_are_counted_on_the_gpu() -> None:
    """Five boxes in a heap for which there is not nearly enough room."""
    boxes = tuple(Body(name=f"box{k}", at=(0.45 + 0.05 * (k % 2), -0.2 + 0.1 * k)) for k in range(5))
    observations = ("state", "joint_target", "objects")
    config = FrankaConfig(
        task="reach", gripper=True, scene=Scene(objects=boxes), observations=observations, max_contacts=28
    )
    env = FrankaEnv(config, num_envs=N, device="cuda")
    tensordict = env.reset()
    rest_q = env.simulation.tensors.rest_q.view(N, -1)
    for k in range(5):  # thrown into one another
        rest_q[:, 2 + 7 * k : 5 + 7 * k] = torch.tensor([0.5, 0.004 * k, 0.021 + 0.01 * k])
    ended = torch.zeros(N, 1, dtype=torch.bool, device="cuda")
    action = torch.zeros(N, env.action_dim, device="cuda")
    for _ in range(3):
        tensordict = env.step(tensordict.set("action", action))["next"]
        ended |= tensordict["truncated"]
    assert ended.any()
    assert env.statistics()["overflow"] > 0
