"""What actions do to the arm: three modes, limits of speed and effort, latency, numbers that are none."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from importlib.resources import files

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm.envs import FrankaEnv

LATENCY = 3


def play(env: FrankaEnv, actions: torch.Tensor, seed: int = 0) -> TensorDictBase:
    """(N, T)."""
    root, steps = env.reset(seed=seed), []
    for t in range(actions.shape[1]):
        step, root = env.step_and_maybe_reset(root.set("action", actions[:, t]))
        steps.append(step.clone())
    return torch.stack(steps, 1)


@pytest.fixture(scope="module")
def position(small_env) -> FrankaEnv:
    return small_env(3, action_mode="joint_position", substeps=4, episode_length=1000)


@pytest.fixture(scope="module")
def tool(small_env) -> FrankaEnv:
    return small_env(6, action_mode="ee_delta", substeps=4, pose_noise=0.1, episode_length=1000)


@pytest.fixture(scope="module")
def delta(small_env) -> FrankaEnv:
    return small_env(5, episode_length=1000)


@pytest.fixture(scope="module")
def late(small_env) -> FrankaEnv:
    return small_env(5, episode_length=1000, randomization={"action_latency": LATENCY})


# -- modes -----------------------------------------------------------------------------------------------


def test_joint_position_moves_the_arm_to_the_pose(position: FrankaEnv) -> None:
    """Wherever it starts: within 0.005 rad after two seconds, at rest; −1 and 1 are the limits."""
    lower, upper = position.kinematics.lower, position.kinematics.upper
    share = 0.2 + 0.6 * torch.rand(3, 7, generator=torch.Generator().manual_seed(0))
    pose = lower + share * (upper - lower)
    data = play(position, (2 * share - 1)[:, None].expand(3, 60, 7))
    start = data["state"][:, 0, :7]
    assert ((start - pose).abs().amax(-1) > 0.5).all()
    torch.testing.assert_close(data["next", "joint_target"][:, 0], pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(data["next", "state"][:, -1, :7], pose, atol=5e-3, rtol=0)
    assert data["next", "state"][:, -1, 7:14].abs().max() < 0.02
    for sign, limit in ((-1.0, lower), (1.0, upper), (7.0, upper)):
        target = play(position, torch.full((3, 1, 7), sign))["next", "joint_target"][:, 0]
        torch.testing.assert_close(target, limit.expand(3, 7), atol=1e-5, rtol=0)


def test_joint_delta_adds_up(delta: FrankaEnv, random_actions) -> None:
    actions = 0.2 * random_actions(5, 6)
    data = play(delta, actions)
    expected = data["joint_target"][:, :1] + delta.config.action_scale * actions.cumsum(1)
    torch.testing.assert_close(data["next", "joint_target"], expected, atol=1e-5, rtol=0)


def test_ee_delta_moves_the_tool_along_the_axes(tool: FrankaEnv) -> None:
    """Six worlds, ±x, ±y, ±z: 75 mm in five steps, then the servo settles. Within 10 mm along and sideways."""
    wish = torch.cat([torch.eye(3), -torch.eye(3)])
    actions = torch.zeros(6, 25, 3)
    actions[:, :5] = 0.3 * wish[:, None]
    data = play(tool, actions)
    moved = data["next", "state"][:, -1, 14:17] - data["state"][:, 0, 14:17]
    along = (moved * wish).sum(-1)
    sideways = (moved - along[:, None] * wish).norm(dim=-1)
    commanded = 5 * 0.3 * tool.config.ee_scale
    assert ((along - commanded).abs() < 0.010).all(), along
    assert (sideways < 0.010).all(), sideways


def test_ee_delta_keeps_its_direction_where_joints_may_not_follow(small_env) -> None:
    """A twentieth of the wish, at 5 mrad of a joint: cut off joint by joint, the tool would go elsewhere."""
    env = small_env(6, action_mode="ee_delta", action_scale=0.005, ee_scale=0.05, substeps=4, pose_noise=0.3)
    env.reset(seed=0)
    wish, k = torch.cat([torch.eye(3), -torch.eye(3)]), env.kinematics
    before = env.joint_targets()
    env.step(TensorDict({"action": wish}, [6]))
    after = env.joint_targets()
    torch.testing.assert_close((after - before).abs().amax(-1), torch.full((6,), 0.005), atol=1e-5, rtol=0)
    moved = k.forward(after) - k.forward(before)
    assert ((moved * wish).sum(-1) / moved.norm(dim=-1) > 0.995).all()


def test_ee_delta_stands_still_without_action(tool: FrankaEnv) -> None:
    data = play(tool, torch.zeros(6, 10, 3))
    moved = (data["next", "state"][:, -1] - data["state"][:, 0])[:, 14:17].norm(dim=-1)
    assert (moved < 1e-3).all()
    assert torch.equal(data["next", "joint_target"][:, -1], data["joint_target"][:, 0])


def test_ee_delta_has_three_actions(tool: FrankaEnv, delta: FrankaEnv) -> None:
    assert tool.action_spec.shape == (6, 3) and delta.action_spec.shape == (5, 7)
    assert tool.action_dim == 3


# -- limits ----------------------------------------------------------------------------------------------


def speeds(env: FrankaEnv) -> float:
    """99 % of all joint speeds, as shares of the limits, are below this: smooth random actions."""
    generator = torch.Generator().manual_seed(0)
    knots = 2 * torch.rand(4, 7, 12, generator=generator) - 1
    actions = torch.nn.functional.interpolate(knots, size=60, mode="linear").mT
    state = play(env, actions)["next", "state"]
    limit = torch.as_tensor(np.asarray(env.simulation.robot.velocity_limit), dtype=torch.float32)
    return float((state[..., 7:14].abs() / limit).flatten().quantile(0.99))


def test_limit_velocity(small_env) -> None:
    options = {"action_scale": 0.25, "substeps": 4, "episode_length": 1000}
    limited, free = (speeds(small_env(4, limit_velocity=on, **options)) for on in (True, False))
    assert 0.5 < limited < 1.25
    assert free > 1.25


def test_effort_limits_reach_mujoco(delta: FrankaEnv) -> None:
    urdf = ET.fromstring((files("franka_wm.envs.robots") / "fr3.urdf").read_text())
    effort = np.array(
        [float(j.find("limit").get("effort")) for j in urdf.iter("joint") if j.get("type") == "revolute"]
    )
    model = delta.simulation.solver.mjw_model
    limits = model.jnt_actfrcrange.numpy()
    assert model.jnt_actfrclimited.numpy().all()
    for world in limits:
        np.testing.assert_allclose(world, np.stack([-effort, effort], -1))


# -- latency ---------------------------------------------------------------------------------------------


def test_latency_shifts_the_response(delta: FrankaEnv, late: FrankaEnv, random_actions) -> None:
    """An arm with delay k does, bit for bit, what a prompt one does when it is told k steps later."""
    actions = 0.5 * random_actions(5, 12)
    delays = set()
    for seed in range(6):
        got = play(late, actions, seed)
        delay = late.simulation.tensors.delay.tolist()
        delays |= set(delay)
        shifted = torch.zeros_like(actions)
        for world, k in enumerate(delay):
            shifted[world, k:] = actions[world, : 12 - k]
        expected = play(delta, shifted, seed)
        for key in ("state", "joint_target"):
            assert torch.equal(got["next", key], expected["next", key]), (key, seed, delay)
    assert delays == set(range(LATENCY + 1))


def test_a_late_joint_position_leaves_the_arm_where_it_is(small_env) -> None:
    """Before the first action has arrived there is none: the arm holds its pose."""
    env = small_env(3, action_mode="joint_position", randomization={"action_latency": LATENCY})
    lower, upper = env.kinematics.lower, env.kinematics.upper
    start = env.reset(seed=0)["state"][:, :7]
    hold = 2 * (start - lower) / (upper - lower) - 1
    data = play(env, hold[:, None].expand(3, 5, 7))
    assert (env.simulation.tensors.delay > 0).any()
    torch.testing.assert_close(
        data["next", "joint_target"], start[:, None].expand(3, 5, 7), atol=1e-4, rtol=0
    )


# -- numbers that are none -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["position", "tool", "delta", "late"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_action_that_is_no_number(name: str, value: float, request) -> None:
    env: FrankaEnv = request.getfixturevalue(name)
    n, width = env.num_envs, env.action_dim
    actions = torch.zeros(n, 7, width)
    calm = play(env, actions)
    actions[1, 2, width - 1] = value
    env.statistics()
    data = play(env, actions)
    delay = int(env.simulation.get_state()["delay"][1]) if name != "late" else None
    for key in ("state", "joint_target", "reward"):
        assert torch.isfinite(data["next", key]).all(), key
    caught = data["next", "truncated"][..., 0]
    others = [k for k in range(n) if k != 1]
    assert not caught[others].any() and caught[1].sum() == 1 and not data["next", "terminated"].any()
    when = int(caught[1].nonzero())
    assert when == 2 if delay is not None else 2 <= when <= 2 + LATENCY
    assert env.statistics()["nonfinite"] == 1
    for key in ("state", "reward"):
        assert torch.equal(data["next", key][others], calm["next", key][others]), key
    assert torch.equal(data["is_init"][1, :, 0].nonzero().flatten(), torch.tensor([0, when + 1]))
