"""What a run logged comes back from its checkpoint, however long it ran."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from franka_wm.errors import UserError
from franka_wm.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from franka_wm.training.history import columns_of, read_rows


def saved(folder: Path, rows: object) -> Checkpoint:
    config = OmegaConf.create({"seed": 0})
    model = torch.nn.Linear(1, 1)
    return load_checkpoint(
        save_checkpoint(folder, model=model, config=config, counters={}, extra={"rows": rows})
    )


def test_rows_come_back(tmp_path: Path) -> None:
    rows = [
        {"loss": 0.1, "updates": 20, "env_steps": 2**40},
        {"eval/planner/success": 1.0, "updates": 20, "env_steps": 2**40},
        {"loss": float("inf"), "updates": 40, "env_steps": 2**40 + 1},
    ]
    read = read_rows(saved(tmp_path / "a", columns_of(rows)))
    assert read == rows and isinstance(read[0]["updates"], int)
    assert read_rows(saved(tmp_path / "none", columns_of([]))) == []
    assert read_rows(saved(tmp_path / "before", rows)) == rows


def test_a_run_of_weeks_can_be_opened(tmp_path: Path) -> None:
    rows = [{f"quantity_{k}": 0.1 * number for k in range(30)} for number in range(100_000)]
    assert read_rows(saved(tmp_path / "a", columns_of(rows))) == rows


@pytest.mark.parametrize("where", [[0, 7], [0]])
def test_rows_that_are_none_are_one_line(tmp_path: Path, where: list[int]) -> None:
    column = {"row": torch.tensor(where), "value": torch.tensor([1.0, 2.0])}
    with pytest.raises(UserError, match=r"damaged: extra\.json"):
        read_rows(saved(tmp_path / "a", {"loss": column}))
