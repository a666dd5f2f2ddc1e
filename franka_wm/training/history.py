"""Logged rows in a checkpoint: as columns of numbers, since a run of days has hundreds of thousands of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from franka_wm.training.checkpoint import Checkpoint
from franka_wm.training.tree import damaged


def columns_of(rows: Sequence[Mapping[str, float]]) -> dict[str, dict[str, Tensor]]:
    """For each quantity in which rows it stands, and its values; whole numbers stay whole."""
    found: dict[str, tuple[list[int], list[float]]] = {}
    for number, row in enumerate(rows):
        for name, value in row.items():
            where, values = found.setdefault(name, ([], []))
            where.append(number)
            values.append(value)
    return {
        name: {
            "row": torch.tensor(where),
            "value": torch.tensor(
                values, dtype=torch.int64 if all(isinstance(x, int) for x in values) else torch.float64
            ),
        }
        for name, (where, values) in found.items()
    }


def read_rows(checkpoint: Checkpoint) -> list[dict[str, float]]:
    """The rows logged until a checkpoint was written, oldest first; none if it has no history.

    Raises:
        UserError: Something else stands in their place.
    """
    with damaged(checkpoint.folder, "extra.json"):
        saved = (checkpoint.extra() or {}).get("rows") or []
        if isinstance(saved, list):  # written before there were columns
            return list(saved)
        # Some quantities stand in every row: env_steps, updates.
        rows: list[dict[str, float]] = [{} for _ in range(max(len(one["row"]) for one in saved.values()))]
        for name, column in saved.items():
            for number, value in zip(column["row"].tolist(), column["value"].tolist(), strict=True):
                rows[number][name] = value
        return rows
