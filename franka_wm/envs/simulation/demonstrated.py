# pyright: reportArgumentType=false, reportCallIssue=false
# (Warp's annotations know neither vectors nor shapes as tuples.)
"""Resets from states along demonstrations: a share of the episodes begins where a recorded step did."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.envs.kernels import demonstrated

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation

READS = ("state", "joint_target", "objects", "goal")
"""Observations that say where a world with a gripper is."""


class DemonstratedStarts:
    """States along recorded episodes, on the device, and the share of new episodes that begin in one.

    The state is what was observed: joints, fingers, set points, objects, drawers and goal, with their velocities.
    Counters, statistics, the task's draws and the solver's warm start are those of a new episode.

    Args:
        sim: The simulation; with a gripper.
        steps: :data:`READS`, (T, …) each: episode after episode.
        begins: (T,) bool, the first steps of the episodes.
        share: Share of the resets, in [0, 1].
    """

    def __init__(
        self, sim: Simulation, steps: Mapping[str, torch.Tensor], begins: torch.Tensor, share: float
    ):
        first = begins.nonzero().squeeze(1)
        lengths = torch.cat((first[1:], first.new_tensor([len(begins)]))) - first
        # Kept: Warp's arrays are views of their memory.
        self._tensors = [one.to(sim.device, torch.int32) for one in (first, lengths)]
        self._tensors += [steps[key].to(sim.device, torch.float32).contiguous() for key in READS]
        self._earliest = torch.zeros(1, device=sim.device)
        self._sim, self._share = sim, float(share)
        self._rows = [wp.from_torch(one) for one in (self._earliest, *self._tensors)]

    def from_part(self, earliest: float) -> None:
        """From the next reset on, states come from the part of the episodes after ``earliest``: 0 all, 0.9 the end."""
        self._earliest.fill_(earliest)

    def launch(self, mask: wp.array) -> None:
        """Puts a share of the masked worlds there, whose resets have placed all else."""
        sim, w = self._sim, self._sim.warp
        assert sim.bodies is not None
        outputs = [
            w.joint_q, w.joint_qd, w.target, w.control, w.rest_q, w.rest_qd, w.rest_control, w.grip, w.bases,
            w.task_goal,
        ]  # fmt: skip
        inputs = [mask, w.seed, w.episode, self._share, *self._rows, *sim.bodies.layout, *outputs]
        wp.launch(demonstrated.begin_along, sim.num_envs, inputs, device=sim.device)
