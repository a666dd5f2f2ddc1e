"""What is no dataset, or not a whole one: one line, before anything is decoded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from franka_wm.data.lerobot import source
from franka_wm.errors import UserError


def edited_info(root: Path, to: Path, **changes: object) -> Path:
    shutil.copytree(root, to)
    path = to / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return to


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.1"}, r"format v2\.1; v3 is read.*convert_dataset_v21_to_v30"),
        ({"total_episodes": 0}, "holds 0 episodes"),
        ({"total_episodes": 5}, "tells of 5 episodes, meta/episodes of 3.*probably killed"),
        ({"total_frames": 99}, "tells of 99 frames, its episodes of 16"),
        ({"fps": 0}, "make no sense"),
        ({"data_path": "../{chunk_index}"}, "leaves the dataset"),
        ({"data_path": "{nothing}"}, "makes no path"),
    ],
)
def test_metadata_that_cannot_be(
    changes: dict, message: str, pictures: Path, opened: Callable, tmp_path: Path
) -> None:
    root = edited_info(pictures, tmp_path / "data", **changes)
    with pytest.raises(UserError, match=message) as error:
        opened(root)
    assert "\n" not in str(error.value)


def test_no_dataset(opened: Callable, tmp_path: Path) -> None:
    (tmp_path / "begun.writing").mkdir()
    with pytest.raises(UserError, match=r"begun\.writing holds one that is not finished; .* resume=true"):
        opened(tmp_path / "begun")
    with pytest.raises(UserError, match="no such folder"):
        opened(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"no LeRobot dataset, meta/info\.json is missing"):
        opened(tmp_path / "empty")
    with pytest.raises(UserError, match="not on this machine, and HF_HUB_OFFLINE is set"):
        source.find_dataset("nobody/nothing")
    with pytest.raises(UserError, match="must look like user/name"):
        source.find_dataset("a/b/c d")


@pytest.mark.parametrize(
    ("kind", "pattern"), [("pictures", "data"), ("video", "videos"), ("video", "meta/episodes")]
)
def test_missing_files(
    kind: str, pattern: str, request: pytest.FixtureRequest, opened: Callable, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    shutil.copytree(request.getfixturevalue(kind), root)
    for path in (root / pattern).rglob("file-*"):
        path.unlink()
    with pytest.raises(UserError, match=r"files are missing|meta/episodes is empty"):
        opened(root)


def test_a_writer_that_was_killed(pictures: Path, opened: Callable, tmp_path: Path) -> None:
    """A parquet file without its end, as LeRobot's writer leaves it."""
    root = tmp_path / "data"
    shutil.copytree(pictures, root)
    path = next((root / "meta" / "episodes").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(UserError, match=r"meta/episodes cannot be read.*probably killed"):
        opened(root)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there(pictures: Path, opened: Callable) -> None:
    with pytest.raises(UserError, match="cuda"):
        opened(pictures, device="cuda")
    assert opened(pictures, device="auto").device.type == "cpu"
