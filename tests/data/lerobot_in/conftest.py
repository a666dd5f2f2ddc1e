"""Datasets that the tests of this folder share; each is made once."""

from __future__ import annotations

import os

os.environ["HF_HUB_OFFLINE"] = "1"  # before LeRobot is imported: it reads this once

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from franka_wm.data.lerobot.windows import RecordedWindows, open_dataset


@pytest.fixture(scope="session")
def foreign() -> ModuleType:
    """The module that makes datasets as other people's look."""
    spec = importlib.util.spec_from_file_location("foreign", Path(__file__).with_name("foreign.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def pictures(foreign: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of 5, 4 and 7 rows, two cameras as PNG. Not to be changed: copy it."""
    return foreign.make_foreign(tmp_path_factory.mktemp("foreign") / "pictures")


@pytest.fixture(scope="session")
def video(foreign: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as video. Not to be changed: copy it."""
    return foreign.make_foreign(tmp_path_factory.mktemp("foreign") / "video", video=True)


@pytest.fixture
def opened(tmp_path: Path) -> Callable[..., RecordedWindows]:
    """:func:`open_dataset`, all episodes in one process, with a cache of the test's own, silent."""

    def open_(root: Any, **options: Any) -> RecordedWindows:
        defaults = {
            "window": 2,
            "batch_size": 8,
            "split": "all",
            "workers": 0,
            "cache_dir": tmp_path / "cache",
            "say": lambda line: None,
        }
        return open_dataset(root, **(defaults | options))

    return open_
