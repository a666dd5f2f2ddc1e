"""Where a plan would lead the arm: the path of the tool that its actions command."""

from __future__ import annotations

from types import MappingProxyType

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.config import ACTION_MODES
from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.kinematics import Kinematics
from franka_wm.models.base import WorldModel
from franka_wm.planning import MPPI
from franka_wm.policies import PlannerPolicy

DAMPING = 1e-3
"""Added to J Jᵀ [m²] by the environment where actions move the tool."""


def next_targets(config: FrankaConfig, kinematics: Kinematics, targets: Tensor, action: Tensor) -> Tensor:
    """The servo's targets after an action: (..., 7) [rad], (..., A) → (..., 7) [rad].

    As the environment computes them for an arm that keeps up with its targets.
    """
    lower, upper = kinematics.lower, kinematics.upper
    action = action.clamp(-1.0, 1.0)
    if config.action_mode == "joint_position":
        targets = 0.5 * (lower + upper) + 0.5 * (upper - lower) * action
    elif config.action_mode == "ee_delta":
        jacobian = kinematics.jacobian(targets)
        gram = jacobian @ jacobian.mT + DAMPING * torch.eye(3, device=targets.device)
        pull = torch.linalg.solve(gram, config.ee_scale * action.unsqueeze(-1))
        step = (jacobian.mT @ pull).squeeze(-1)
        most = step.abs().amax(-1, keepdim=True).clamp_min(1e-9)
        targets = targets + step * (config.action_scale / most).clamp_max(1.0)
    else:
        targets = targets + config.action_scale * action
    return torch.clamp(targets, lower, upper)


@torch.no_grad()
def commanded_path(env: FrankaEnv, plan: Tensor) -> Tensor:
    """Integrates a plan into joint targets and puts them through forward kinematics.

    It needs no decoder and asks no model: it is what the plan *orders*, from the servo's present targets on, within
    the joint limits. The arm follows with the servo's lag, and, with `limit_velocity`, no faster than it may.

    Args:
        env: Tells what an action means, and the present targets.
        plan: Actions (N, H, A), of the environment's own kind.

    Returns:
        Tool positions (N, H + 1, 3) [m]; the first belongs to the present targets.
    """
    targets = [env.joint_targets()[:, :NUM_JOINTS]]
    for action in plan[..., : ACTION_MODES[env.config.action_mode]].unbind(
        1
    ):  # a gripper's is its last number
        targets.append(next_targets(env.config, env.kinematics, targets[-1], action))
    return env.kinematics.forward(torch.stack(targets, 1))


def planned_path(env: FrankaEnv, decided: TensorDictBase) -> Tensor | None:
    """:func:`commanded_path` of a decision's plan; None where it has no plan, or one of discrete actions."""
    plan = decided.get("plan", None)
    if plan is not None and plan.dim() == 4:  # iCEM's holds its mean first, then elites
        plan = plan[:, 0]
    if plan is None or not plan.is_floating_point() or plan.shape[2:] != (env.action_dim,):
        return None
    return commanded_path(env, plan)


class KinematicModel(WorldModel):
    """A world model that nobody trained: the arm's own geometry, as if it followed every command at once.

    The latent is (joint targets 7 [rad], goal 3 [m]). With it a planner can be watched before anything was learned;
    what it does is not the achievement of a learned model.

    Args:
        env: Whose arm and actions these are.
    """

    observation_sizes = MappingProxyType({"joint_target": 7, "goal": 3})

    def __init__(self, env: FrankaEnv):
        super().__init__()
        self.config, self.kinematics = env.config, env.kinematics

    def encode(self, observation: TensorDictBase) -> Tensor:
        """(..., 10)."""
        return torch.cat([observation.get("joint_target"), observation.get("goal")], -1)

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """(..., 10), (..., A) → (..., 10)."""
        targets = next_targets(self.config, self.kinematics, z[..., :7], action)
        return torch.cat([targets, z[..., 7:]], -1)

    def score(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        """Nearness to the goal at each step, less a price on effort: (E, S, H + 1, 10), (E, S, H, A) → (E, S)."""
        distance = (self.kinematics.forward(trajectory[..., 1:, :7]) - trajectory[..., 1:, 7:]).norm(dim=-1)
        return -distance.sum(-1) - 0.01 * actions.square().mean(-1).sum(-1)


def kinematic_planner(env: FrankaEnv) -> PlannerPolicy:
    """MPPI over :class:`KinematicModel`: 6 steps ahead, sized for one arm on a CPU."""
    model = KinematicModel(env)
    planner = MPPI(
        action_dim=env.action_dim,
        horizon=6,
        num_samples=128,
        num_policy_samples=0,
        num_elites=16,
        iterations=3,
        max_std=1.0,
        temperature=2.0,
    )
    # Its inverse kinematics solve a linear system, which waits for the device.
    return PlannerPolicy.for_model(model, planner, objective=model.score, capture=False)
