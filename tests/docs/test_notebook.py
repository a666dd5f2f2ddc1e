"""The notebook of the documentation, run from its first cell to its last."""

import os
import stat
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = "docs/from-zero-to-a-dataset.ipynb"


@pytest.mark.slow
def test_notebook_runs(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The command of this checkout, also where another one is installed.
    command = tmp_path / "bin/franka-wm"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m franka_wm "$@"\n')
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{command.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(root))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")

    folder = tmp_path / "empty"
    folder.mkdir()
    notebook = nbformat.read(root / NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()

    printed = [
        "".join(out.get("text", "") for out in cell.get("outputs", []))
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]
    assert "12 episodes, 180 frames" in printed[2]
    assert "cm at the end" in printed[3]
    assert "dry run: nothing was sent" in printed[-1]
    images = [o for c in notebook.cells for o in c.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(images) == 1


def test_notebook_is_stored_without_outputs(root: Path) -> None:
    notebook = nbformat.read(root / NOTEBOOK, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells)
