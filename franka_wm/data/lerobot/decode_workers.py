"""Decoding jobs, spread over processes, with progress on the terminal."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path

from franka_wm.data.lerobot.decode import TableJob, VideoJob, to_line
from franka_wm.errors import UserError
from franka_wm.versions import usable_cores

ROWS_WORTH_A_PROCESS = 4096
"""Fewer rows are decoded sooner than a process has started."""
PROGRESS_EVERY = 5.0
"""Seconds between two lines."""

type Say = Callable[[str], None]
"""Takes lines for the terminal."""


def run_jobs(
    jobs: Sequence[tuple[TableJob | VideoJob, int]], total: int, workers: int | None, say: Say
) -> None:
    if workers is None:
        cores = usable_cores()
        workers = min(cores, 16)
    workers = min(workers, len(jobs))
    progress = _Progress(total, say)
    if workers <= 1 or total < ROWS_WORTH_A_PROCESS:
        for job, rows in jobs:
            job.run()
            progress.add(rows)
            progress.tell()
        return
    waiting: queue.SimpleQueue[tuple[TableJob | VideoJob, int]] = queue.SimpleQueue()
    for item in jobs:
        waiting.put(item)
    processes = [_start_worker() for _ in range(workers)]
    try:
        with ThreadPoolExecutor(workers) as threads:
            busy: set[Future[None]] = {threads.submit(_drive, p, waiting, progress) for p in processes}
            try:
                while busy:
                    done, busy = wait(busy, timeout=0.5, return_when=FIRST_EXCEPTION)
                    for future in done:
                        future.result()
                    progress.tell()
            finally:
                # After an error or Ctrl-C the threads wait for answers: this ends them.
                for process in processes:
                    process.kill()
    finally:
        for process in processes:
            process.wait()
            assert process.stdin is not None and process.stdout is not None
            process.stdout.close()
            with contextlib.suppress(BrokenPipeError):  # a job that a dead worker never took
                process.stdin.close()


def _start_worker() -> subprocess.Popen[str]:
    package = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join(p for p in (package, os.environ.get("PYTHONPATH")) if p)
    return subprocess.Popen(
        [sys.executable, "-m", "franka_wm.data.lerobot.decode"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
        env={**os.environ, "PYTHONPATH": path},
        start_new_session=True,  # Ctrl-C is for this process; it ends its workers itself
    )


def _drive(
    process: subprocess.Popen[str],
    waiting: queue.SimpleQueue[tuple[TableJob | VideoJob, int]],
    progress: _Progress,
) -> None:
    """Gives one worker job after job, until none is left."""
    assert process.stdin is not None and process.stdout is not None
    while True:
        try:
            job, rows = waiting.get_nowait()
        except queue.Empty:
            return
        try:
            process.stdin.write(to_line(job))
            answer = process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise UserError(
                f"a process that decodes {job.path} ended (exit status {process.wait()}); if it is out of memory, "
                "use dataset.workers=1"
            )
        values = json.loads(answer)
        if "error" in values:
            raise UserError(values["error"])
        progress.add(rows)


class _Progress:
    """Rows done, rows per second, time left."""

    def __init__(self, total: int, say: Say):
        self.total, self.say, self.done = total, say, 0
        self._started = self._last = time.perf_counter()
        self._lock = threading.Lock()

    def add(self, rows: int) -> None:
        with self._lock:
            self.done += rows

    def tell(self) -> None:
        now = time.perf_counter()
        if now - self._last < PROGRESS_EVERY or not self.done:
            return
        self._last = now
        rate = self.done / (now - self._started)
        self.say(
            f"  {100 * self.done / self.total:.0f} %   {rate:.0f} rows/s   {(self.total - self.done) / rate:.0f} s left"
        )
