"""The processes that write a dataset's shards, and the locks that keep runs apart."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import traceback
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from franka_wm.data.lerobot.episodes import Episode
from franka_wm.data.lerobot.merge import merge
from franka_wm.data.lerobot.schema import Schema
from franka_wm.data.lerobot.shard import write_shard
from franka_wm.errors import UserError
from franka_wm.files import sync

LOCK = "lock.workers"
"""Held by the writing processes together, in the folder of a dataset that is being written."""

ORPHANS_HAVE = 60.0
"""Seconds that writing processes of a killed run get to finish their shard."""

PARTIAL = ".partial"
"""Ending of a shard that is being written."""


def lock_folder(path: Path) -> int:
    """A lock that ends with this process, however it ends."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise UserError(
            f"another process is writing {path.parent}; wait for it, or choose another out"
        ) from None
    return descriptor


def wait_for_orphans(path: Path) -> None:
    """Writing processes outlive a killed run until their shard is done; they hold this lock together."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        deadline = time.monotonic() + ORPHANS_HAVE
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise UserError(
                        f"a process of an earlier run still writes {path.parent}; end it"
                    ) from None
                time.sleep(0.05)
    finally:
        os.close(descriptor)


class WritingFailedError(UserError):
    """A shard, or the dataset of all of them, could not be written."""


class WorkerEnded(Exception):
    """A writing process ended by itself, and with it the shard that it was writing."""


class Worker:
    """A process that writes shards, and the connection to it. It ends when this process does, however that ends.

    A plain subprocess and not one of ``multiprocessing``, which would import the program's main module there, and
    with it, as a rule, torch and the simulator.
    """

    def __init__(self, working: Path, number: int):
        self.connection, theirs = multiprocessing.Pipe()
        self.log = working / f"worker-{number}.log"
        code = f"from {__name__} import work; work()"
        path = os.pathsep.join(entry for entry in sys.path if entry)
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, str(theirs.fileno()), str(working)],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stderr=log,  # encoders and progress bars talk there
                env=os.environ | {"PYTHONPATH": path, "SVT_LOG": "1", "OMP_NUM_THREADS": "1"},
            )
        theirs.close()
        self.busy = False

    def send(self, job: tuple[Any, ...]) -> None:
        try:
            self.connection.send(job)
            self.busy = True
        except OSError:
            self.busy = False
        # Not raised in there: it would keep the frames of the failed send, and Python 3.12 crashes as it collects
        # their buffer.
        if not self.busy:
            raise self._died()

    def check(self) -> None:
        """Raises :class:`WorkerEnded` if the process is there no more."""
        if self._process.poll() is not None:
            raise self._died()

    def receive(self) -> None:
        try:
            problem = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._died() from error
        self.busy = False
        _raise(problem)

    def _died(self) -> WorkerEnded:
        self.busy = False
        self._process.wait()
        return WorkerEnded(
            f"a writing process ended (exit code {self._process.returncode}; {self.log} may say why)"
        )

    def stop(self) -> None:
        self.connection.close()  # it reads the end of the connection, and ends
        try:
            self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class InProcess:
    """Does the same jobs in this process."""

    busy = False

    def check(self) -> None: ...

    def send(self, job: tuple[Any, ...]) -> None:
        _raise(_do(*job))

    def stop(self) -> None: ...


def _raise(problem: str | None) -> None:
    if problem is not None:
        raise WritingFailedError(f"writing failed: {problem}")


def _do(kind: str, *job: Any) -> str | None:
    """Does a job; what went wrong, in one line."""
    try:
        {"shard": _write_shard, "merge": merge, "nothing": lambda: None}[kind](*job)
    except Exception as error:  # every reason goes to the one who asked
        if isinstance(error, UserError):
            return str(error)
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return None


def work() -> None:
    """A writing process: does jobs until the connection, whose number is its first argument, ends."""
    for one in (signal.SIGINT, signal.SIGTERM):  # to a group, they are for the process that sends the jobs
        signal.signal(one, signal.SIG_IGN)
    connection, working = Connection(int(sys.argv[1])), Path(sys.argv[2])
    descriptor = os.open(working / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    fcntl.flock(descriptor, fcntl.LOCK_SH)
    for module in ("pandas", "pyarrow.parquet", "PIL.Image", "av"):  # now, while episodes are still gathered
        import_module(module)
    while True:
        try:
            connection.send(_do(*connection.recv()))
        except (EOFError, OSError):  # no one is there any more
            return


def _write_shard(folder: Path, schema: Schema, episodes: list[Episode]) -> None:
    partial = folder.with_name(folder.name + PARTIAL)
    write_shard(partial, schema, episodes)
    for path in (*partial.rglob("*"), partial):  # on the disk before it counts as whole
        sync(path)
    os.rename(partial, folder)
