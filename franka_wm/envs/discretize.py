"""The arm with discrete actions."""

from __future__ import annotations

import math

import torch
from torchrl.data import Categorical, Composite
from torchrl.envs.transforms import Transform

from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.errors import UserError
from franka_wm.options import check_whole


def discrete_action_table(
    action_dim: int, magnitude: float = 1.0, include_noop: bool = True, gripper: bool = False
) -> torch.Tensor:
    """Actions along one axis each, and the no-op that lets an agent stay where it arrived.

    The fingers' command is a place, not a way to go: left out of a move, it would let go of what is held. So with a
    gripper all moves of the arm are there twice, with open and with closed fingers.

    Args:
        action_dim: Number of axes, A.
        magnitude: Size of an action, in (0, 1]: actions are clipped there. The fingers' are always 1 and −1.
        include_noop: Whether the last move is all zeros.
        gripper: Whether the last axis is the fingers'.

    Returns:
        (M, A) float32. Without a gripper M = 2·A + 1, or 2·A without the no-op: row 2·i is +magnitude on axis i, row
        2·i + 1 is −magnitude, and the **last** row is the no-op: the other indices do not depend on it. With one
        the first half of the rows are these of the A − 1 other axes, with open fingers. The second half are the same,
        with closed ones.
    """
    check_whole("action_dim", action_dim, least=1 + gripper)
    if not (math.isfinite(magnitude) and 0.0 < magnitude <= 1.0):
        raise UserError(f"magnitude={magnitude}: must be above 0 and at most 1, where actions are clipped")
    table = magnitude * torch.eye(action_dim - gripper).repeat_interleave(2, 0)
    table[1::2] *= -1.0
    if include_noop:
        table = torch.cat([table, torch.zeros(1, table.shape[1])])
    if gripper:
        fingers = torch.tensor([1.0, -1.0]).repeat_interleave(len(table)).unsqueeze(1)
        table = torch.cat([table.repeat(2, 1), fingers], 1)
    return table


class DiscreteActions(Transform):
    """A TorchRL transform that replaces continuous actions by the rows of :func:`discrete_action_table`.

    The action becomes a :class:`~torchrl.data.Categorical` of int64 whose shape is the **batch size alone**,
    (N,), without a trailing 1: that is what TorchRL's own modules emit for a categorical action (the argmax of
    ``QValueActor``, a sample of ``torch.distributions.Categorical``). The environment sees the row, (N, A).

    One gather on the device: no host sync. A number outside the table is an error (on CUDA a device-side assert).

    Args:
        action_dim: Number of axes, A.
        magnitude, include_noop, gripper: As in :func:`discrete_action_table`.

    Attributes:
        table: (number of actions, A) float32, a buffer that follows the environment's device.

    Example::

        env = TransformedFrankaEnv(FrankaEnv(num_envs=64), DiscreteActions())
        env.action_spec.n  # 15
    """

    table: torch.Tensor

    def __init__(
        self,
        action_dim: int = NUM_JOINTS,
        magnitude: float = 1.0,
        include_noop: bool = True,
        gripper: bool = False,
    ):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.gripper = gripper
        self.register_buffer("table", discrete_action_table(action_dim, magnitude, include_noop, gripper))

    @property
    def num_actions(self) -> int:
        """Rows of the table."""
        return self.table.shape[0]

    def _inv_apply_transform(self, action: torch.Tensor) -> torch.Tensor:
        if action.device.type == "cpu":  # elsewhere asking waits for the device
            outside = action[(action < 0) | (action >= self.num_actions)]
            if len(outside):
                raise UserError(f"action {int(outside[0])}: must be from 0 to {self.num_actions - 1}")
        return torch.nn.functional.embedding(action, self.table)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        continuous = input_spec["full_action_spec", "action"]
        if continuous.shape[-1:] != self.table.shape[1:]:
            raise UserError(
                f"DiscreteActions(action_dim={self.table.shape[1]}): the environment's actions have shape "
                f"{tuple(continuous.shape)}; use action_dim={continuous.shape[-1] if continuous.shape else 1}"
            )
        arm = getattr(getattr(self.parent, "base_env", None), "config", None)
        has = getattr(arm, "has_gripper", self.gripper)
        if has != self.gripper:
            raise UserError(
                f"DiscreteActions(gripper={self.gripper}): the last action of this arm is "
                f"{'' if has else 'not '}its fingers'; use gripper={has}"
            )
        input_spec["full_action_spec", "action"] = Categorical(
            self.num_actions, shape=continuous.shape[:-1], device=continuous.device, dtype=torch.int64
        )
        return input_spec
