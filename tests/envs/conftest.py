"""What tests of the environment share."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def printed_class(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., type]:
    """A class as docs/tasks.md prints it, from the block that has ``class NAME(BASE)``, in at most so many lines."""

    def load(declared: str, *, lines: int) -> type:
        blocks = re.findall(r"```python\n(.*?)```", (root / "docs" / "tasks.md").read_text(), re.DOTALL)
        block = next(block for block in blocks if f"class {declared}" in block)
        assert len(block.splitlines()) <= lines
        name = declared.split("(")[0]
        path = tmp_path_factory.mktemp("task") / f"{name.lower()}.py"
        path.write_text(block)
        spec = importlib.util.spec_from_file_location(name.lower(), path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)  # Warp reads a kernel's source from its file
        return getattr(module, name)

    return load
