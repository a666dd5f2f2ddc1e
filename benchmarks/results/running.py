"""Runs of a row as processes of their own, some at a time, and their files in docs/results/."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from queue import Queue
from threading import Lock

from benchmarks.results.records import BESIDE, PLACE, record_benchmark, record_run, write
from benchmarks.results.rows import Row
from franka_wm.data.lerobot.provenance import recorded_sessions
from franka_wm.errors import UserError
from franka_wm.source import ROOT

Slot = tuple[list[str], list[str], dict[str, str]]
"""What stands before a run's command, what after it, and what in its environment."""


@dataclass(frozen=True)
class Machine:
    """Where the runs go.

    Attributes:
        jobs: runs at a time, on each device.
        beside: other runs that share each device or the cores' host meanwhile; recorded beside the times.
        devices: of runs on GPUs, as ``device=`` takes them; empty: what train.py chooses.
        threads: of each run; on CPU cores it has these to itself. ``None``: as many as the section says, and as torch
            chooses on a GPU.
        commit: of the code, where there is no repository.
        extra: arguments of train.py beside the row's that change no number but times: ``evaluation.video_episodes=0``.
    """

    jobs: int = 1
    beside: int = 0
    devices: Sequence[str] = ()
    threads: int | None = None
    commit: str | None = None
    extra: Sequence[str] = ()

    def __post_init__(self) -> None:
        if other := [one for one in self.extra if not one.startswith(tuple(f"{name}=" for name in BESIDE))]:
            raise UserError(
                f"--extra {shlex.join(other)}: may be {'=…, '.join(BESIDE)}=… alone; others change the row"
            )

    def slots(self, row: Row) -> list[Slot]:
        """One for each run at a time, a round over the devices after the other.

        Raises:
            UserError: There are too few cores for so many runs.
        """
        extra = list(self.extra)
        further = os.environ.get("PYTHONPATH")
        environment = {"PYTHONPATH": os.pathsep.join([str(ROOT), further] if further else [str(ROOT)])}
        if self.commit:
            environment["FRANKA_WM_COMMIT"] = self.commit
        if row.section.threads is None:
            if self.threads:
                environment["OMP_NUM_THREADS"] = str(self.threads)
            devices = [[f"device={device}"] for device in self.devices] or [[]]
            return [([], [*device, *extra], environment) for _ in range(self.jobs) for device in devices]
        threads = self.threads or row.section.threads
        cores = sorted(os.sched_getaffinity(0))
        if threads * self.jobs > len(cores):
            raise UserError(
                f"--jobs {self.jobs} with {threads} threads each need {threads * self.jobs} cores, and there are "
                f"{len(cores)}; use fewer, or times would not be those of {threads} cores"
            )
        environment |= {"OMP_NUM_THREADS": str(threads), "CUDA_VISIBLE_DEVICES": ""}
        own = [cores[k * threads : (k + 1) * threads] for k in range(self.jobs)]
        return [(["taskset", "-c", ",".join(map(str, some))], extra, environment) for some in own]


def run(
    work: Sequence[tuple[Row, Sequence[int]]],
    machine: Machine,
    *,
    out: Path,
    place: Path = PLACE,
    minutes: float | None = None,
) -> list[str]:
    """Runs rows and writes their files; returns what failed, a line for each.

    The runs of all rows wait in one line, so that no device idles while one of another row could run. A benchmark has
    the machine to itself.

    Args:
        work: Rows, and seeds of each; a benchmark has none.
        machine: Where.
        out: Folder for the runs' own folders and what they print.
        place: Folder of the results.
        minutes: No run begins later; those that run are waited for. ``None``: all begin.

    Raises:
        UserError: Before anything runs.
    """
    begun, failed = time.monotonic(), []
    if not work:
        return []
    if machine.extra and (scripts := [row.name for row, _ in work if row.script is not None]):
        raise UserError(
            f"--extra: {', '.join(scripts)}: benchmarks have no arguments of train.py; run them apart"
        )
    slots_of = [machine.slots(row) for row, _ in work]
    if any(slots != slots_of[0] for slots in slots_of):
        raise UserError("these rows do not run on the same kind of device or cores; run them apart")
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    line: list[tuple[Row, int]] = []

    def late() -> str | None:
        over = minutes is not None and time.monotonic() - begun > 60 * minutes
        return f"not begun, {minutes:g} minutes were over" if over else None

    for row, seeds in work:
        if row.script is not None and (why := late()):
            failed.append(f"{row.name}: {why}")
        elif made := prepare(row, ROOT, ROOT):
            failed.append(made)
        elif row.script is None:
            line += [(row, seed) for seed in seeds]
        else:
            failed += _benchmark(row, slots_of[0][0], out / row.name / stamp, place, 1 + machine.beside)
    slots: Queue[Slot] = Queue()
    for slot in slots_of[0]:
        slots.put(slot)
    jobs = min(machine.jobs, len(line)) + machine.beside
    writing = Lock()  # runs of the same code write the same file of it

    def one(run: tuple[Row, int]) -> str | None:
        (row, seed), slot = run, slots.get()
        try:
            if why := late():
                return f"{row.name}, seed {seed}: {why}"
            before, after, environment = slot
            folder = out / row.name / stamp
            folder.mkdir(parents=True, exist_ok=True)  # another command may have begun in the same second
            target = folder / f"seed-{seed}"
            command = [
                *before,
                sys.executable,
                "train.py",
                *row.words,
                *after,
                f"seed={seed}",
                f"hydra.run.dir={target}",
            ]
            failure = _call(command, environment, folder / f"seed-{seed}.log")
            if failure is None:
                record = record_run(row, target, jobs=jobs)
                with writing:
                    print(write(record, place), flush=True)
            return failure
        except UserError as error:
            return str(error)
        finally:
            slots.put(slot)

    with ThreadPoolExecutor(slots.qsize()) as pool:
        return failed + [failure for failure in pool.map(one, line) if failure]


def _benchmark(row: Row, slot: Slot, folder: Path, place: Path, jobs: int) -> list[str]:
    before, _, environment = slot
    folder.mkdir(parents=True, exist_ok=True)
    command = [*before, sys.executable, *row.command[1:], "--out", str(folder / "run.json")]
    failure = _call(command, environment, folder / "run.log")
    if failure is None:
        try:
            print(write(record_benchmark(row, folder / "run.json", jobs=jobs), place), flush=True)
        except UserError as error:  # the rows after it run all the same
            failure = str(error)
    return [failure] if failure else []


def prepare(row: Row, top: Path, place: Path, **environment: str) -> str | None:
    """Makes what the row's runs read, at ``place`` by the code at ``top``, unless it is there; what failed.

    A dataset that is there must have been gathered by the row's own command.
    """
    environment = {"PYTHONPATH": os.pathsep.join([str(top), os.environ.get("PYTHONPATH", "")])} | environment
    for words, made in row.prepares:
        if (place / made).exists():
            if other := _gathered_otherwise(place / made, shlex.join(["franka-wm", *words])):
                return f"{made} was gathered otherwise ({other}); move it away"
            continue
        command = [sys.executable, "-m", "franka_wm", *words]
        done = subprocess.run(
            command, cwd=place, env=os.environ | environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            last = ((done.stderr or done.stdout).strip().splitlines() or ["nothing printed"])[-1]
            return f"{shlex.join(command)}: {last}"
    return None


def _gathered_otherwise(dataset: Path, command: str) -> str | None:
    """By what the dataset was gathered, if not by this command alone."""
    try:
        typed = [str(session.get("command")) for session in recorded_sessions(dataset)]
    except UserError as error:
        return str(error)
    if not typed:
        return "it does not say how"
    return next((one for one in typed if one != command), None)


def _call(command: Sequence[str], environment: dict[str, str], log: Path) -> str | None:
    """Runs a command from the top of the repository, what it prints into a file; its last line if it fails."""
    print(f"{shlex.join(command)}   > {log}", flush=True)
    with log.open("w") as file:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env=os.environ | environment,
            stdout=file,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if done.returncode == 0:
        return None
    last = (log.read_text().strip().splitlines() or ["nothing printed"])[-1]
    return f"exit status {done.returncode}, {log}: {last}"
