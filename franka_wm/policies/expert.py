"""Experts: what a task says of where the hand shall be, turned into actions of all worlds by inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import MOST_OPEN, NUM_JOINTS
from franka_wm.envs.kinematics import Kinematics
from franka_wm.envs.multitask import MultiTaskEnv
from franka_wm.envs.tasks import Task
from franka_wm.envs.tasks.experts import Aim, Sight
from franka_wm.errors import UserError
from franka_wm.policies.scripted import DrawingPolicy, ScriptedPolicy
from franka_wm.seeding import of_worlds

FAST, SLOW = 0.5, 0.15
"""Speed of the hand [m/s]: on its way, and within :data:`NEAR` of where it shall be."""
NEAR = 0.04
QUIET = 0.25
"""Nearer than this to where the hand shall be its noise fades [m]: on the way it strays, but grasps with care."""
TURN = 2.0
"""Speed of the hand around the vertical axis [rad/s]."""


class ExpertPolicy(DrawingPolicy):
    """What a task can show: its own plan (``Task.expert``) from the true positions of all objects.

    The hand points down and moves straight, at up to 0.5 m/s; joint targets follow by inverse kinematics from those
    that are there. It keeps nothing from step to step, so it goes on from any state.

    Args:
        task: The environment's.
        kinematics: The arm's.
        config: The environment's: what an action means.
        noise: Standard deviation of noise on the joints' part of the action while the hand is on its way.
        generator: Source of the noise.

    Raises:
        UserError: The task has no expert, the arm hangs under its own weight, or actions are tool displacements.
    """

    in_keys = ["state", "joint_target", "objects", "goal"]

    def __init__(
        self,
        task: Task,
        kinematics: Kinematics,
        config: FrankaConfig,
        *,
        noise: float = 0.0,
        generator: torch.Generator | None = None,
    ):
        super().__init__(generator)
        if task.expert is None:
            raise UserError(
                f"policy=expert: task={config.task} has none; a task says it with a method expert"
            )
        if not config.gravity_compensation:
            raise UserError(
                "policy=expert: needs gravity_compensation=true; without it the tool hangs 2 cm below where it is told "
                "to be, and grasps nothing"
            )
        if config.action_mode == "ee_delta":
            raise UserError("policy=expert: drives joints; use env.action_mode=joint_delta or joint_position")
        self.task, self.kinematics, self.config = task, kinematics, config
        self.noise = noise

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        k, c = self.kinematics, self.config
        for key in self.in_keys:
            if tensordict.get(key, None) is None:
                raise UserError(f"the expert reads {key}; add it to the environment's observations")
        sight = Sight.of(tensordict, k, joints=c.num_articulated)
        assert self.task.expert is not None
        aim = self.task.expert(sight)
        target = tensordict.get("joint_target")[..., :NUM_JOINTS]
        joints = self._follow(sight, aim, target)
        if c.action_mode == "joint_position":
            action = 2 * (joints - k.lower) / (k.upper - k.lower) - 1
        else:
            action = (joints - target) / c.action_scale
        if self.noise:
            drawn = of_worlds(
                lambda shape: torch.randn(shape, device=action.device, generator=self.generator), action.shape
            )
            way = (aim.tool - sight.tool).norm(dim=-1, keepdim=True)
            action = action + self.noise * (way / QUIET).clamp_max(1.0).square() * drawn
        grip = 2 * aim.opening / MOST_OPEN - 1
        return tensordict.set("action", torch.cat([action, grip.unsqueeze(-1)], -1).clamp(-1.0, 1.0))

    def _follow(self, sight: Sight, aim: Aim, target: torch.Tensor) -> torch.Tensor:
        """Joint targets one step nearer to the aim, (N, 7) [rad]."""
        k, fps = self.kinematics, self.config.fps
        tool, yaw = sight.target, sight.target_yaw
        way = aim.tool - tool
        distance = way.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        pace = (SLOW + (FAST - SLOW) * (distance / NEAR - 1).clamp(0, 1)) / fps
        tool = tool + way * (pace / distance).clamp_max(1.0)
        turn = torch.remainder(aim.yaw - yaw + torch.pi, 2 * torch.pi) - torch.pi
        return k.solve_upright(tool, yaw + turn.clamp(-TURN / fps, TURN / fps), target)


class TaskwisePolicy(ScriptedPolicy):
    """Policy of several tasks at once: each task's worlds act by one of their own.

    Args:
        env: The worlds.
        policies: Task -> policy, which sees what that task's worlds observe.
    """

    def __init__(self, env: MultiTaskEnv, policies: Mapping[str, TensorDictModuleBase]):
        super().__init__()
        self.split, self.join, self.policies = env.split, env.join, dict(policies)
        self.in_keys = list(dict.fromkeys(key for one in policies.values() for key in one.in_keys))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = self.split(tensordict)
        actions = {name: self.policies[name](one).get("action") for name, one in seen.items()}
        return tensordict.set("action", self.join(actions))
