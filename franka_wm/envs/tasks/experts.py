"""What experts of tasks with a gripper see and want, and how they grasp; they remember nothing from step to step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import torch
from tensordict import TensorDictBase

from franka_wm.envs.constants import JOINT_DIM, MOST_OPEN, NUM_JOINTS, OBJECT_DIM

if TYPE_CHECKING:
    from franka_wm.envs.kinematics import Kinematics
    from franka_wm.envs.solids import Solid


@dataclass(frozen=True)
class Sight:
    """What an expert sees of N worlds.

    Attributes:
        tool, target: (N, 3) where the tool is, and where the servo is told to bring it [m].
        yaw, target_yaw: (N,) of the hand, pointing down; at 0 the fingers move along y [rad].
        opening, closing: (N,) each finger's distance from the closed position [m], and how fast it falls [m/s].
        command: (N,) the fingers' set point [m].
        objects: (N, K + M, 13), see :data:`~franka_wm.envs.constants.OBJECT_DIM`: objects, then handles of the M
            articulated bodies.
        joints: (N, M, 2) how far these are open [m or rad], and their speeds.
        goal: (N, 3) [m].
    """

    tool: torch.Tensor
    target: torch.Tensor
    yaw: torch.Tensor
    target_yaw: torch.Tensor
    opening: torch.Tensor
    closing: torch.Tensor
    command: torch.Tensor
    objects: torch.Tensor
    joints: torch.Tensor
    goal: torch.Tensor

    @classmethod
    def of(cls, observation: TensorDictBase, kinematics: Kinematics, *, joints: int = 0) -> Self:
        """From ``state`` (N, 28), ``joint_target`` (N, 8), ``objects`` with so many ``joints``, and ``goal``."""
        state, objects = observation.get("state"), observation.get("objects")
        bodies = objects.shape[-1] - JOINT_DIM * joints
        x, y, z, w = state[..., 24:28].unbind(-1)
        target, target_yaw = kinematics.upright(observation.get("joint_target")[..., :NUM_JOINTS])
        return cls(
            tool=state[..., 14:17],
            target=target,
            target_yaw=target_yaw,
            yaw=torch.atan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)),
            opening=state[..., 20:22].mean(-1),
            closing=-state[..., 22:24].mean(-1),
            command=observation.get("joint_target")[..., NUM_JOINTS],
            objects=objects[..., :bodies].unflatten(-1, (-1, OBJECT_DIM)),
            joints=objects[..., bodies:].unflatten(-1, (joints, JOINT_DIM)),
            goal=observation.get("goal"),
        )

    def body(self, number: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Place (N, 3) [m] of an object and its angle around the vertical axis (N,) [rad]."""
        one = self.objects[..., number, :]
        x, y, z, w = one[..., 3:7].unbind(-1)
        return one[..., :3], torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def squeezes(self) -> torch.Tensor:
        """(N,) bool: the fingers are stopped by something."""
        return (self.opening - self.command > 0.003) & (self.closing.abs() < 0.1)


@dataclass(frozen=True)
class Aim:
    """Where an expert wants the hand, which points down: (N, 3) [m], yaw (N,) [rad], each finger's opening (N,) [m]."""

    tool: torch.Tensor
    yaw: torch.Tensor
    opening: torch.Tensor


GAIN, CLOSE = 0.4, 0.04
"""Share, in each step, of what a held object is off by, where that is less [m]: more would make the arm swing."""


def moved(place: torch.Tensor, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> torch.Tensor:
    """Places (..., 3) moved by numbers [m], without a copy from the host."""
    return torch.stack([place[..., 0] + x, place[..., 1] + y, place[..., 2] + z], -1)


def quarter_turn(angle: torch.Tensor, near: torch.Tensor, *, step: float = 0.5 * math.pi) -> torch.Tensor:
    """The angle nearest to ``near`` that is ``angle`` up to quarter turns, or ``step``: how to grasp a box."""
    return near + torch.remainder(angle - near + 0.5 * step, step) - 0.5 * step


def fetch(
    sight: Sight,
    number: int,
    to: torch.Tensor,
    *,
    above: float = 0.08,
    grip: float = 0.0,
    step: float = 0.5 * math.pi,
    turn: float = 0.0,
) -> tuple[Aim, torch.Tensor]:
    """Grasps an object from above and brings it to ``to``; begins anew where it was lost. It remembers nothing.

    Over the object, down, close, and once the fingers are stopped by it, on to ``to``.

    Args:
        sight: What is seen.
        number: Number of the object.
        to: (N, 3) where its centre shall be [m].
        above: Height over the object in which the hand gets into place [m].
        grip: Where to grasp it: so far over its centre [m].
        step: By which turns of the hand the object can be grasped [rad].
        turn: Angle of the hand that grasps it, from the object's [rad].

    Returns:
        Where the hand shall be, and (N,) bool: the object is held.
    """
    place, angle = sight.body(number)
    missing = to - place
    if grip:
        place = moved(place, z=grip)
    yaw = quarter_turn(angle + turn, sight.yaw, step=step)
    away = place - sight.tool
    aside, below = away[..., :2].norm(dim=-1), away[..., 2].abs()
    closing = sight.command < 0.9 * MOST_OPEN
    slack = torch.where(closing, 2.0, 1.0)  # what has begun goes on
    there = (aside < 0.008 * slack) & (below < 0.010 * slack)
    held = there & sight.squeezes & closing
    over = (aside < 0.02) & ((yaw - sight.yaw).abs() < 0.15)
    hover = moved(place, z=above)
    hover[..., :2] = torch.where(
        (below < 0.5 * above)[..., None] & ~over[..., None], sight.tool[..., :2], hover[..., :2]
    )
    tool = torch.where((over | there)[..., None], place, hover)
    tool = torch.where((there & closing)[..., None], sight.target, tool)
    gain = torch.where(missing.norm(dim=-1, keepdim=True) < CLOSE, GAIN, 1.0)
    tool = torch.where(held[..., None], sight.target + gain * missing, tool)
    opening = torch.where(there, 0.0, MOST_OPEN)
    return Aim(tool, torch.where(there, sight.target_yaw, yaw), opening), held


PALM_ABOVE, TIPS_BELOW = 0.033, 0.0105
"""Room from the tool up to the palm, and from the tool down to the fingers' tips [m], a few millimetres spared."""


def grasp_of(solid: Solid) -> dict[str, Any]:
    """How :func:`fetch` grasps an upright solid of the scene: by a side that fits between the fingers, and so high that
    the palm does not touch its top, nor the tips what it stands on.

    Returns:
        ``grip``, and for what fits only one way ``step`` and ``turn``.
    """
    grip = max(0.0, solid.half_height - PALM_ABOVE, TIPS_BELOW - solid.half_height)
    along, across = (width < 2 * MOST_OPEN for width in solid.widths)
    if solid.shape == "mesh" or along == across:
        return {"grip": grip}
    # At turn 0 the fingers move along its y.
    return {"grip": grip, "step": math.pi, "turn": 0.0 if across else 0.5 * math.pi}
