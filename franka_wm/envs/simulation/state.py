# pyright: reportArgumentType=false
# (Newton's annotations do not say what a built model always has.)
"""The worlds in and out: everything that their futures depend on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
import warp as wp

from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.simulation.simulator import Simulation

MEMORY = (
    "step_count", "episode_return", "episode_success", "ended", "episode", "task_goal", "goal_center", "goal_q",
    "initial_distance", "phase", "target", "history", "delay", "brightness", "joint_q", "joint_qd", "control",
    "body_q", "poses",
)  # fmt: skip
"""The arrays that a step or a reset reads before it writes them."""


def solver_memory(sim: Simulation) -> dict[str, wp.array]:
    """What MuJoCo carries from step to step besides positions and velocities; each (N, …)."""
    data = getattr(sim.solver, "mjw_data", None)
    names = ("qacc_warmstart", "ctrl", "act", "qfrc_applied", "xfrc_applied")
    return {} if data is None else {name: getattr(data, name) for name in names}


def memory(sim: Simulation) -> dict[str, torch.Tensor]:
    """Everything that the future depends on but the seed, by name, each (N, …): not copies."""
    out = {name: getattr(sim.tensors, name) for name in MEMORY}
    if sim.bodies:
        out |= {
            name: getattr(sim.tensors, name)
            for name in ("rest_q", "rest_qd", "rest_control", "grip", "contacts")
        }
    if sim.tensors.goal_rest.numel():
        out["goal_rest"] = sim.tensors.goal_rest
    if sim.config.num_articulated:
        out["bases"] = sim.tensors.bases
    if sim.config.randomization.object_size:
        out["sizes"] = sim.tensors.sizes
    if sim.config.randomization.table_height:
        out["raised"] = sim.tensors.raised
    out["body_qd"] = wp.to_torch(sim.newton_state.body_qd).view(sim.num_envs, -1, 6)
    out |= {f"solver_{name}": wp.to_torch(array) for name, array in solver_memory(sim).items() if array.size}
    if sim.task.num_draws:
        out["draws"] = sim.tensors.draws
    out |= {f"random_{k}": wp.to_torch(array) for k, array in enumerate(sim.randomizer.arrays())}
    return out


def read(sim: Simulation) -> dict[str, torch.Tensor]:
    """A copy of :func:`memory` and of the seed, each (N, …)."""
    state = {name: tensor.clone() for name, tensor in memory(sim).items()}
    state["seed"] = sim.tensors.seed[:1].expand(sim.num_envs).clone()
    return state


def check(sim: Simulation, state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A state that :func:`write` can put back.

    Raises:
        UserError: An array is missing or has another shape.
    """
    there = memory(sim)
    state = {"ended": torch.zeros_like(there["ended"])} | dict(state)  # states of version 0.1.0 have none
    expected = there | {"seed": sim.tensors.seed[:1].expand(sim.num_envs)}
    for name, tensor in expected.items():
        if name not in state or state[name].shape != tensor.shape or state[name].dtype != tensor.dtype:
            found = f"{tuple(state[name].shape)} {state[name].dtype}" if name in state else "nothing"
            raise UserError(
                f"set_state: {name} must be {tuple(tensor.shape)} {tensor.dtype}, is {found}; "
                "take it from get_state() of an environment with the same config, with one row for each world"
            )
    return state


def write(sim: Simulation, state: Mapping[str, torch.Tensor]) -> None:
    """Puts :func:`read`'s values back; the present observation is not refreshed.

    Raises:
        UserError: An array is missing or has another shape; nothing is changed then.
    """
    state = check(sim, state)
    for name, tensor in memory(sim).items():
        tensor.copy_(state[name])
    sim.tensors.seed[:1] = state["seed"][:1]
    with sim.recorder.on_stream_of_torch():  # what was written above is there
        sim.randomizer.apply()
