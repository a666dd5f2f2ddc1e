# pyright: reportArgumentType=false
# (TorchRL's annotations do not know shapes as tuples.)
"""TorchRL's specs of what the arm observes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import MOST_OPEN
from franka_wm.envs.kinematics import Kinematics
from franka_wm.errors import UserError
from franka_wm.keys import LOST

MARKS = ("success", "is_init", LOST)
"""Flags among what a step gives, none of them an observation; the last one with a scene alone."""


def observation_spec(
    config: FrankaConfig, images: Sequence[str], kinematics: Kinematics, n: int, device: torch.device
) -> Composite:
    """Shapes, types and bounds of the observations of ``n`` worlds, in the order in which they are emitted.

    Args:
        config: What is observed.
        images: Keys of the images.
        kinematics: The joint limits.
        n, device: Number of worlds; where the tensors live.
    """
    size = config.image_size
    entries: dict = {}
    for key in images:
        if key.startswith("depth"):
            entries[key] = Unbounded(shape=(n, size, size, 1), device=device)
        else:
            channels = 1 if key.startswith("segmentation") else 3 * config.frame_stack
            shape = (n, size, size, channels)
            entries[key] = Bounded(0, 255, shape=shape, dtype=torch.uint8, device=device)
    if "state" in config.observations:
        entries["state"] = Unbounded(shape=(n, config.state_dim), device=device)
    if "joint_target" in config.observations:
        low, high = (limit.expand(n, -1) for limit in (kinematics.lower, kinematics.upper))
        if config.has_gripper:
            low, high = (
                torch.nn.functional.pad(low, (0, 1)),
                torch.nn.functional.pad(high, (0, 1), value=MOST_OPEN),
            )
        entries["joint_target"] = Bounded(low, high, device=device)
    if "objects" in config.observations:
        entries["objects"] = Unbounded(shape=(n, config.object_dim), device=device)
    if config.contact_dim:
        entries["contacts"] = Unbounded(shape=(n, config.contact_dim), device=device)
    entries["goal"] = Unbounded(shape=(n, 3), device=device)
    entries["success"] = Binary(shape=(n, 1), dtype=torch.bool, device=device)
    entries["is_init"] = Binary(shape=(n, 1), dtype=torch.bool, device=device)
    if config.resolved_scene:
        entries[LOST] = Binary(shape=(n, 1), dtype=torch.bool, device=device)
    return Composite(**entries, shape=(n,), device=device)


def goals_given(goal: Any, n: int, device: torch.device, lowest: float) -> torch.Tensor:
    """Goals (n, 3) [m] from as many, or from one (3,) for all worlds.

    Raises:
        UserError: No numbers, another shape, a number that is not finite, or a goal below ``lowest`` [m].
    """
    try:
        goals = torch.as_tensor(goal, dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"set_goal: {goal!r} must be numbers, ({n}, 3) or (3,), in metres") from error
    if goals.shape not in ((3,), (n, 3)):
        raise UserError(f"set_goal: got shape {tuple(goals.shape)}; it must be ({n}, 3) or (3,), in metres")
    wrong = goals[~goals.isfinite()]
    if len(wrong):
        raise UserError(f"set_goal: has {float(wrong[0])}; all numbers must be finite, in metres")
    low = goals[..., 2].min()
    if low < lowest:
        raise UserError(
            f"set_goal: has a goal {low:.3g} m high; this task keeps them at {lowest:g} m or above"
        )
    return goals.expand(n, 3)


def check_state(state: object, batch_size: torch.Size | None = None) -> None:
    """Refuses what no ``get_state`` gave.

    Raises:
        UserError: No TensorDict, or, where ``batch_size`` is given, one of another number of worlds.
    """
    if not isinstance(state, TensorDictBase):
        raise UserError(
            f"set_state: got {type(state).__name__}; it must be the TensorDict that get_state() gives"
        )
    if batch_size is not None and state.batch_size != batch_size:
        raise UserError(
            f"set_state: {tuple(state.batch_size)} worlds for {batch_size.numel()}; index or expand the state first"
        )
