"""Checkpoints whose experience is large, or does not fit on the disk."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from franka_wm.training import room


def test_size_of_what_is_filled() -> None:
    replay = ReplayBuffer(storage=LazyTensorStorage(10 * 4, ndim=2), batch_size=2)
    replay.extend(TensorDict({"x": torch.zeros(4, 5, 3)}, [4, 5]))
    assert room.held(replay) == replay[:].bytes()


@pytest.mark.parametrize(
    ("size", "free", "last", "why"),
    [
        (1e9, 100e9, False, None),
        (3e9, 100e9, False, "written at the end"),
        (3e9, 100e9, True, None),
        (3e9, 3.1e9, True, "WITHOUT"),
        (1e9, 1.1e9, False, "WITHOUT"),
    ],
)
def test_left_out(size: float, free: float, last: bool, why: str | None, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(room.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    said = room.left_out(int(size), tmp_path / "not" / "yet", last=last)
    if why is None:
        assert said is None
    else:
        assert said is not None and why in said and "\n" not in said
