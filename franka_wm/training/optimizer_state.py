"""The state of an optimizer: saved, and given back to one that may run elsewhere."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from franka_wm.errors import UserError
from franka_wm.options import is_real

_NAME = "optimizer"  # what it is called in files and messages

_MOMENTS = {name: {"step", "exp_avg", "exp_avg_sq"} for name in ("Adam", "AdamW")}
"""What an optimizer that has made a step holds for each parameter."""


def optimizer_state(optimizer: Optimizer) -> dict[str, Any]:
    """Its `type` and `state_dict`, under its name."""
    return {_NAME: {"type": type(optimizer).__name__, "state_dict": optimizer.state_dict()}}


def load_optimizer_state(saved: Mapping[str, Any], optimizer: Optimizer, source: str) -> None:
    """Give `optimizer` what it had learned, and its rates; its other options stay as it was built.

    Args:
        saved: from :func:`optimizer_state`.
        optimizer: one of the same kind, for the same parameters.
        source: where `saved` is from, for messages.

    Raises:
        UserError: another optimizer, or for other parameters. It is then not changed.
    """
    if saved.keys() != {_NAME}:
        raise UserError(
            f"{source} holds the optimizers {sorted(saved)}; resume with the trainer that wrote it."
        )
    difference = _optimizer_difference(saved[_NAME], optimizer)
    if difference is not None:
        raise UserError(
            f"optimizer {_NAME!r} of {source} does not fit: {difference}; "
            "build model and optimizer from the checkpoint's config.yaml."
        )
    rates = [group["lr"] for group in optimizer.param_groups]
    optimizer.load_state_dict(_as_built_here(saved[_NAME]["state_dict"], optimizer))
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        if isinstance(rate, Tensor):  # a captured graph reads this very tensor
            group["lr"] = rate.copy_(torch.as_tensor(group["lr"]))


def _optimizer_difference(saved: Mapping[str, Any], optimizer: Optimizer) -> str | None:
    """In words, why the saved state is for another optimizer, or None. torch checks only the counts."""
    if saved["type"] != type(optimizer).__name__:
        return f"it is {saved['type']}, here is {type(optimizer).__name__}"
    groups = saved["state_dict"]["param_groups"]
    if [len(g["params"]) for g in groups] != [len(g["params"]) for g in optimizer.param_groups]:
        return "its groups hold other numbers of parameters"
    for group, group_here in zip(groups, optimizer.param_groups, strict=True):
        if not _is_rate(group.get("lr")):
            return f"lr is {group.get('lr')!r}, here {group_here['lr']!r}"
        for index, parameter in zip(group["params"], group_here["params"], strict=True):
            state = saved["state_dict"]["state"].get(index, {})
            if state and saved["type"] in _MOMENTS and not state.keys() >= _MOMENTS[saved["type"]]:
                return f"of parameter {index} it holds {sorted(state)}"
            for name, value in state.items():
                if not isinstance(value, Tensor) or not bool(value.isfinite().all()):
                    return f"{name} of parameter {index} holds no finite numbers"
                if name == "step" and value.ndim:
                    return f"step of parameter {index} has shape {tuple(value.shape)}"
                if value.ndim and value.shape != parameter.shape:
                    return (
                        f"{name} of parameter {index} has shape {tuple(value.shape)}, "
                        f"the parameter {tuple(parameter.shape)}"
                    )
    return None


def _is_rate(saved: object) -> bool:
    number = saved.item() if isinstance(saved, Tensor) and saved.numel() == 1 else saved
    return is_real(number) and number >= 0


def _as_built_here(state: Mapping[str, Any], optimizer: Optimizer) -> dict[str, Any]:
    """The saved state and rates; how it runs, and options that a resumed run may change, are those of `optimizer`."""
    groups = []
    for saved, here in zip(state["param_groups"], optimizer.param_groups, strict=True):
        rate = saved["lr"]
        if isinstance(rate, Tensor) and not isinstance(here["lr"], Tensor):
            rate = rate.item()
        groups.append({**here, "params": saved["params"], "lr": rate})
    return {"state": state["state"], "param_groups": groups}
