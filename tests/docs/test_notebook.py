"""The notebook of the documentation, run from its first cell to its last."""

from __future__ import annotations

import json
import os
import socket
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import nbformat
import pytest
from nbclient import NotebookClient

from forks import module, spare

NOTEBOOK = "docs/from-zero-to-a-dataset.ipynb"


COMMAND = """\
#!{python} -SE
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as there:
    there.connect({address!r})
    there.sendall(json.dumps([os.getcwd(), *sys.argv[1:]]).encode() + b"\\n")
    status, out, err = json.load(there.makefile())
sys.stdout.write(out)
sys.stderr.write(err)
sys.exit(status)
"""


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Path]:
    """``franka-wm`` of this checkout, also where another one is installed, in forks of a process that has loaded it."""
    file, address = tmp_path / "bin/franka-wm", tmp_path / "asked"
    file.parent.mkdir()
    file.write_text(COMMAND.format(python=sys.executable, address=str(address)))
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    with socket.create_server(str(address), family=socket.AF_UNIX) as server:

        def serve() -> None:
            while True:
                try:
                    asked, _ = server.accept()
                except OSError:  # it is closed
                    return
                with asked, asked.makefile() as words:
                    cwd, *arguments = json.loads(words.readline())
                    done = spare().fork(module("franka_wm", *arguments), Path(cwd))
                    asked.sendall(json.dumps([done.returncode, done.stdout, done.stderr]).encode())

        thread = Thread(target=serve, daemon=True)
        thread.start()
        yield file
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


@pytest.mark.slow
def test_notebook_runs(root: Path, command: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
