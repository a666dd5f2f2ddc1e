"""Whether a planner does what `Planner` promises, tried once on a toy."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm.errors import UserError, trying


def check_planner(planner: Any, *, action_dim: int, name: str = "") -> None:
    """Ask a planner of continuous actions for two decisions of two environments, and look at what it answers.

    The toy: latents that actions add to, and an objective that holds candidates against their shapes. For tests of
    a planner of your own; a run does it before it builds anything.

    Args:
        planner: built for `action_dim`.
        action_dim: A.
        name: what it is called in messages; the class's if empty.

    Raises:
        UserError: one line: it fails, gives the objective other shapes than (E, S, H+1, D) and (E, S, H, A), or returns
            other than a TensorDict with `action` (E, A) and `plan` (E, H, A), or several
            such plans (E, …, H, A), all of them finite.
    """
    name, envs, size = name or type(planner).__name__, 2, action_dim + 1

    def following(z: Tensor, action: Tensor) -> Tensor:
        return z + torch.cat((action, action[..., :1]), -1)

    def objective(trajectory: Tensor, actions: Tensor) -> Tensor:
        _require(name, "candidates", actions, (envs, None, None, action_dim), "(E, S, H, A)")
        wanted = (envs, actions.shape[1], actions.shape[2] + 1, size)
        _require(name, "trajectories of latents", trajectory, wanted, "(E, S, H+1, D)")
        return -trajectory[:, :, -1].square().sum(-1)

    previous = None
    for _ in range(2):
        with trying(f"planner {name}: plan"), torch.random.fork_rng(devices=[]):
            found = planner.plan(
                torch.zeros(envs, size),
                following,
                objective,
                prior=lambda z: torch.zeros(*z.shape[:-1], action_dim),
                previous=previous,
                is_init=torch.tensor([[True], [False]]),
                explore=False,
                generator=torch.Generator().manual_seed(0),
            )
        if not isinstance(found, TensorDictBase) or not {"action", "plan"} <= set(found.keys()):
            there = sorted(found.keys()) if isinstance(found, TensorDictBase) else type(found).__name__
            raise UserError(
                f"planner {name}: plan must return a TensorDict with action and plan, not {there}"
            )
        _require(name, "action", found["action"], (envs, action_dim), "(E, A)")
        plan, horizon = found["plan"], None if previous is None else previous.shape[-2]
        if not isinstance(plan, Tensor):
            raise UserError(f"planner {name}: plan must be a tensor, not {type(plan).__name__}")
        alone = (
            plan if plan.ndim < 4 else plan.reshape(envs, -1, *plan.shape[-2:])[:, 0]
        )  # iCEM carries several
        _require(name, "plan", alone, (envs, horizon, action_dim), "(E, H, A)")
        for what, x in (("action", found["action"]), ("plan", plan)):
            if not bool(x.isfinite().all()):
                raise UserError(f"planner {name}: {what} is not finite (NaN or inf); it must be in [−1, 1]")
        previous = plan


def _require(name: str, what: str, x: Tensor, shape: tuple[int | None, ...], words: str) -> None:
    if not isinstance(x, Tensor) or not x.is_floating_point():
        what = f"{what} must be numbers in a tensor"
        raise UserError(f"planner {name}: {what}, not {getattr(x, 'dtype', type(x).__name__)}")
    fits = x.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, x.shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if one is None else str(one) for one in shape)
        raise UserError(f"planner {name}: {what} must be {words} = ({wanted}), not {tuple(x.shape)}")
