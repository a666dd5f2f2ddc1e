"""The state of optimizers: saved by name, and given back to ones that may run elsewhere."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from franka_wm.errors import UserError
from franka_wm.options import is_real

type Optimizers = Optimizer | Mapping[str, Optimizer]
"""One optimizer, or several by name."""

# How an optimizer runs, not what it has learned: kept from the optimizer that is loaded into, so that a
# checkpoint from a GPU (fused, capturable) goes on on a CPU and the other way round.
_EXECUTION_FLAGS = ("capturable", "differentiable", "foreach", "fused")

_MOMENTS = {name: {"step", "exp_avg", "exp_avg_sq"} for name in ("Adam", "AdamW")}
"""What an optimizer that has made a step holds for each parameter."""


def optimizer_state(optimizer: Optimizers) -> dict[str, Any]:
    """Name → `type` and `state_dict`."""
    return {
        name: {"type": type(one).__name__, "state_dict": one.state_dict()}
        for name, one in _by_name(optimizer).items()
    }


def load_optimizer_state(saved: Mapping[str, Any], optimizer: Optimizers, source: str) -> None:
    """Give `optimizer` what :func:`optimizer_state` returned; how it runs stays as it was built.

    Args:
        saved: from :func:`optimizer_state`.
        optimizer: one or several by name, as they were saved.
        source: where `saved` is from, for messages.

    Raises:
        UserError: other optimizers, or for other parameters. None of them is then changed.
    """
    optimizers = _by_name(optimizer)
    if saved.keys() != optimizers.keys():
        raise UserError(
            f"{source} holds the optimizers {sorted(saved)}, asked for are "
            f"{sorted(optimizers)}; resume with the trainer that wrote it."
        )
    fitted = {}
    for name, one in optimizers.items():
        difference = _optimizer_difference(saved[name], one)
        if difference is not None:
            raise UserError(
                f"optimizer {name!r} of {source} does not fit: {difference}; "
                "build model and optimizer from the checkpoint's config.yaml."
            )
        fitted[name] = _as_it_runs_here(saved[name]["state_dict"], one)
    for name, one in optimizers.items():
        rates = [group["lr"] for group in one.param_groups]
        one.load_state_dict(fitted[name])
        for group, rate in zip(one.param_groups, rates, strict=True):
            if isinstance(rate, Tensor):  # a captured graph reads this very tensor
                group["lr"] = rate.copy_(torch.as_tensor(group["lr"]))


def _by_name(optimizer: Optimizers) -> dict[str, Optimizer]:
    return {"optimizer": optimizer} if isinstance(optimizer, Optimizer) else dict(optimizer)


def _optimizer_difference(saved: Mapping[str, Any], optimizer: Optimizer) -> str | None:
    """In words, why the saved state is for another optimizer, or None. torch checks only the counts."""
    if saved["type"] != type(optimizer).__name__:
        return f"it is {saved['type']}, here is {type(optimizer).__name__}"
    groups = saved["state_dict"]["param_groups"]
    if [len(g["params"]) for g in groups] != [len(g["params"]) for g in optimizer.param_groups]:
        return "its groups hold other numbers of parameters"
    for group, group_here in zip(groups, optimizer.param_groups, strict=True):
        for name, here in group_here.items():
            if name not in ("params", *_EXECUTION_FLAGS) and not _alike(group.get(name), here):
                return f"{name} is {group.get(name)!r}, here {here!r}"
        for index, parameter in zip(group["params"], group_here["params"], strict=True):
            state = saved["state_dict"]["state"].get(index, {})
            if state and saved["type"] in _MOMENTS and not state.keys() >= _MOMENTS[saved["type"]]:
                return f"of parameter {index} it holds {sorted(state)}"
            for name, value in state.items():
                if not isinstance(value, Tensor) or not bool(value.isfinite().all()):
                    return f"{name} of parameter {index} holds no finite numbers"
                if name == "step" and value.ndim:
                    return f"step of parameter {index} has shape {tuple(value.shape)}"
                if isinstance(value, Tensor) and value.ndim > 0 and value.shape != parameter.shape:
                    return (
                        f"{name} of parameter {index} has shape {tuple(value.shape)}, "
                        f"the parameter {tuple(parameter.shape)}"
                    )
    return None


def _alike(saved: object, here: object) -> bool:
    """Whether a saved option of a group is of the kind that it has here."""
    if isinstance(here, tuple):
        return isinstance(saved, tuple) and len(saved) == len(here) and all(map(_alike, saved, here))
    if isinstance(here, Tensor) or is_real(here):
        number = saved.item() if isinstance(saved, Tensor) and saved.numel() == 1 else saved
        return is_real(number) and number >= 0
    return type(saved) is type(here)


def _as_it_runs_here(state: Mapping[str, Any], optimizer: Optimizer) -> dict[str, Any]:
    """The saved state with the execution flags, and the kind of learning rate, that `optimizer` has."""
    groups = []
    for saved, here in zip(state["param_groups"], optimizer.param_groups, strict=True):
        group = {**saved, **{flag: here[flag] for flag in _EXECUTION_FLAGS if flag in here}}
        if isinstance(group["lr"], Tensor) and not isinstance(here["lr"], Tensor):
            group["lr"] = group["lr"].item()
        groups.append(group)
    return {"state": state["state"], "param_groups": groups}
