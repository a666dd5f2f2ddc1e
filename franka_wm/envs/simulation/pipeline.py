# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (Newton's annotations do not say what a built model always has.)
"""Newton's own collision detection, which finds contacts for MuJoCo's solver in the place of MuJoCo's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import newton
import warp as wp

from franka_wm.envs.kernels import bodies as kernels

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation


class Pipeline:
    """Contacts of N worlds, found anew in each substep; each method only launches.

    Args:
        sim: The simulation, its solver made.
    """

    def __init__(self, sim: Simulation):
        self.sim = sim
        self._room = sim.solver.mjw_data.naconmax
        self._pipeline = newton.CollisionPipeline(
            sim.model,
            broad_phase="explicit",  # pairs are few and known; only these need no room of their own
            reduce_contacts=False,
            rigid_contact_max=self._room + 1,  # where it has none, it goes on without counting
            verify_buffers=False,  # it prints from the device
        )
        self._contacts = self._pipeline.contacts()

    def find(self) -> newton.Contacts:
        """Contacts at the present poses. Those without room are noted in all worlds: nothing says whose they were."""
        sim, found = self.sim, self._contacts
        self._pipeline.collide(sim.newton_state, found)
        inputs = [found.rigid_contact_count, self._room, sim.warp.overflow]
        wp.launch(kernels.note_lost, sim.num_envs, inputs, device=sim.device)
        # MuJoCo's solver would print how many there are.
        wp.launch(kernels.cap, 1, [self._room, found.rigid_contact_count], device=sim.device)
        return found
