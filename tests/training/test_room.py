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
    ("size", "free", "last", "wanted", "why"),
    [
        (1e9, 100e9, False, None, None),
        (3e9, 100e9, False, None, "written at the end"),
        (3e9, 100e9, True, None, None),
        (9e9, 100e9, True, None, "checkpoint_replay=true keeps more than 8 GB"),
        (9e9, 100e9, False, True, "written at the end"),
        (9e9, 100e9, True, True, None),
        (3e9, 3.1e9, True, True, "WITHOUT"),
        (1e9, 1.1e9, False, None, "WITHOUT"),
    ],
)
def test_left_out(
    size: float, free: float, last: bool, wanted: bool | None, why: str | None, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(room.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    said = room.left_out(int(size), tmp_path / "not" / "yet", last=last, wanted=wanted)
    if why is None:
        assert said is None
    else:
        assert said is not None and why in said and "\n" not in said
