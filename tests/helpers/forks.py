"""Commands in a fork of the tests' process, in which torch and the simulator are loaded already.

A Python process of its own takes seconds of CPU time to load them, more than most of what is tested takes. A fork has
file descriptors, signals and an exit status of its own, too. Where what is imported is what is tested, use `light.py`.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra

TRAIN = Path(__file__).resolve().parents[2] / "train.py"


def script(path: Path, *arguments: str) -> Callable[[], Any]:
    """``python PATH ARGUMENT …``, as work for a fork."""

    def work() -> None:
        sys.argv = [str(path), *arguments]
        sys.path.insert(0, str(path.parent))
        runpy.run_path(str(path), run_name="__main__")

    return work


class Fork:
    """Work in a fork, in a folder of its own, which also holds its output.

    Args:
        work: Its end is exit status 0; ``SystemExit`` and exceptions are as they are in Python.
        cwd: The working directory.
        log: The stem of the files of standard output and standard error.
    """

    def __init__(self, work: Callable[[], Any], cwd: Path, log: Path) -> None:
        self._logs = [log.with_suffix(".stdout"), log.with_suffix(".stderr")]
        for path in self._logs:
            path.touch()
        sys.stdout.flush()
        sys.stderr.flush()
        with warnings.catch_warnings():  # that this process has threads: none that the fork needs
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if self.pid == 0:
            os._exit(self._run(work, cwd))

    def _run(self, work: Callable[[], Any], cwd: Path) -> int:
        status = 1
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for descriptor, path in zip((1, 2), self._logs, strict=True):
                os.dup2(os.open(path, os.O_WRONLY), descriptor)
            sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
            sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
            os.chdir(cwd)
            if "torch" in sys.modules:  # OpenMP's threads do not survive a fork
                sys.modules["torch"].set_num_threads(1)
            GlobalHydra.instance().clear()
            work()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
        return status

    def said(self) -> tuple[str, str]:
        """What is on standard output and standard error so far."""
        out, err = (path.read_text() for path in self._logs)
        return out, err

    def wait(self, seconds: float) -> subprocess.CompletedProcess[str]:
        """Its end; it is killed after so long, which fails the test."""
        ends = time.monotonic() + seconds
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        while not pid and time.monotonic() < ends:
            time.sleep(0.02)
            pid, status = os.waitpid(self.pid, os.WNOHANG)
        if not pid:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            raise AssertionError(f"more than {seconds:g} s: {self.said()}")
        return subprocess.CompletedProcess([], os.waitstatus_to_exitcode(status), *self.said())


def run_in_fork(
    work: Callable[[], Any], cwd: Path, *, seconds: float = 240.0
) -> subprocess.CompletedProcess[str]:
    """Run `work` in a fork to its end; its exit status and output."""
    with tempfile.TemporaryDirectory() as folder:
        return Fork(work, cwd, Path(folder, "log")).wait(seconds)


def train_in_fork(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """``python train.py ARGUMENT …`` in a fork, or in a process of its own where a fork could not train."""
    if can_differentiate(cwd):
        return run_in_fork(script(TRAIN, *arguments), cwd)
    command = [sys.executable, str(TRAIN), *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def can_differentiate(cwd: Path) -> bool:
    """Whether forks can: torch refuses it in those of a process that did it before them, in any test."""
    import torch  # light.py has none

    done = run_in_fork(lambda: torch.ones(1, requires_grad=True).sum().backward(), cwd)
    return done.returncode == 0
