"""LeRobot datasets: out (write, export, publish) and in (cache, windows). What reads one is loaded when it is used."""

from __future__ import annotations

from typing import Any

__all__ = ["open_dataset"]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "open_dataset":
        from franka_wm.data.lerobot.opening import open_dataset

        return open_dataset
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
