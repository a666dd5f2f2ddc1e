"""LeRobot datasets: out (write, export, publish) and in (cache, windows). Everything here loads when it is used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# name -> module of this package that has it
_PUBLIC = {
    "Schema": "schema",
    "schema_for": "schema",
    "open_dataset": "opening",
    "DatasetWriter": "writer",
    "read_terminals": "terminal",
    "export_replay": "export",
    "publish_dataset": "publish",
    "download": "hub",
}

__all__ = list(_PUBLIC)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
