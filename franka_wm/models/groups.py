"""Parameter groups for AdamW."""

from collections.abc import Iterable
from typing import Any

from torch import nn

ParameterGroup = dict[str, Any]
"""Group of an optimiser: `params` and its options, a `name`, and `clip`: gradient norms are clipped over all groups
of the same `clip` together."""


def decay_groups(
    parameters: Iterable[nn.Parameter], lr: float, *, weight_decay: float, name: str = "model"
) -> list[ParameterGroup]:
    """Two groups: matrices, which decay, and biases, scales and codes of one row, which do not.

    Parameters that need no gradient are left out. So is a group that would be empty. Gradient norms of both
    are clipped together.
    """
    trained = [p for p in parameters if p.requires_grad]
    flat = [p for p in trained if p.squeeze().dim() < 2]
    apart = {id(p) for p in flat}
    groups: list[ParameterGroup] = [
        {"name": name, "clip": "model", "lr": lr, "weight_decay": weight_decay}
        | {"params": [p for p in trained if id(p) not in apart]},
        {"name": f"{name}_plain", "clip": "model", "lr": lr, "weight_decay": 0.0, "params": flat},
    ]
    return [group for group in groups if group["params"]]
