"""A LeRobot dataset decoded once into plain arrays that training reads at memory's speed.

A cache is a folder of ``.npy`` files, memory-mapped when read, and ``cache.json``:

    episodes             (E, 3) int64   first row, number of rows, and whether one more row holds o_T, the
                                        observation after the last action
    observation.<key>    (R, …)         pictures uint8 (H, W, 3), vectors float32
    action               (R, A) float32, or (R,) int64 where actions are discrete
    next.<entry>         (R, 1)         reward float32, the others bool: what followed the action of that row

Its name is a hash of what it was made from: the dataset's files (path, size, time of change), the mapping, the size
of pictures, and the version of this form. So a cache is never out of date; those of a dataset that has changed since
are removed. It is built under another name and renamed, and only one process builds it at a time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from franka_wm.data.lerobot import schema
from franka_wm.data.lerobot.decode import TableJob, VideoJob, filled_name, resized, row_groups, to_line
from franka_wm.data.lerobot.mapping import FeatureMap
from franka_wm.data.lerobot.source import Source, unique_files
from franka_wm.errors import UserError

VERSION = 1
ROWS_PER_JOB = 2048
ROWS_WORTH_A_PROCESS = 4096
"""Fewer rows are decoded sooner than a process has started."""
PROGRESS_EVERY = 5.0

type Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Cache:
    """A dataset as arrays; see the module's head.

    Attributes:
        folder: Where they are.
        fps: Frames per second.
        episodes: (E, 3) int64.
        arrays: Name → memory-mapped array (copy-on-write: never changed on disk).
        notes: One line for each thing found while it was built that a user should know.
    """

    folder: Path
    fps: float
    episodes: np.ndarray
    arrays: dict[str, np.ndarray]
    notes: tuple[str, ...]

    @property
    def nbytes(self) -> int:
        """Of all arrays."""
        return sum(array.nbytes for array in self.arrays.values())


def default_cache_dir() -> Path:
    """``$XDG_CACHE_HOME/franka_wm/datasets``, usually ``~/.cache/franka_wm/datasets``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "franka_wm" / "datasets"


def open_cache(
    source: Source,
    mapping: FeatureMap,
    *,
    cache_dir: str | Path | None = None,
    workers: int | None = None,
    say: Say = print,
) -> Cache:
    """The cache of a dataset, built if there is none that fits.

    Args:
        source: The dataset.
        mapping: What is read from it.
        cache_dir: Where caches are kept; :func:`default_cache_dir` if not given.
        workers: Processes that decode; the cores this process may use, at most 16, if not given. 0 or 1: none
            but this one.
        say: Takes lines for the terminal.

    Raises:
        UserError: If a file is missing or damaged, pictures do not belong to rows, a number is not finite, or
            there is no room.
    """
    from filelock import FileLock, Timeout

    fingerprint = source.fingerprint()
    identity = json.dumps([VERSION, fingerprint, mapping.to_dict()], sort_keys=True)
    parent = Path(cache_dir).expanduser() if cache_dir else default_cache_dir()
    name = f"{source.root.resolve().name}-{hashlib.sha256(identity.encode()).hexdigest()[:24]}"
    folder = parent / name
    if (cache := _read(folder, say)) is not None:
        return cache
    try:
        parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(parent / f"{name}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            say(f"another process is decoding {source.root}; waiting for it")
            lock.acquire()
        try:
            # Another process may have built it while this one waited.
            if (cache := _read(folder, say)) is not None:
                return cache
            for left_over in parent.glob(f"{name}.writing-*"):
                shutil.rmtree(left_over)
            temporary = parent / f"{name}.writing-{uuid.uuid4().hex[:8]}"
            try:
                temporary.mkdir()
                _build(source, mapping, fingerprint, temporary, workers, say)
                temporary.replace(folder)
            finally:
                if temporary.is_dir():
                    shutil.rmtree(temporary)
            _remove_outdated(parent, folder, source, fingerprint)
        finally:
            lock.release()
    except OSError as error:
        raise UserError(
            f"cannot write the cache {parent}: {error}; choose another with dataset.cache_dir=…"
        ) from error
    cache = _read(folder, say)
    assert cache is not None
    return cache


def _read(folder: Path, say: Say) -> Cache | None:
    """The cache in ``folder``; ``None`` if there is none. One that is damaged is removed."""
    if not folder.is_dir():
        return None
    try:
        facts = json.loads((folder / "cache.json").read_text())
        episodes = np.load(folder / "episodes.npy", allow_pickle=False)
        arrays = {}
        for name, (shape, dtype) in facts["arrays"].items():
            # Copy-on-write: torch warns of arrays that it may not write.
            array = np.load(folder / f"{name}.npy", mmap_mode="c", allow_pickle=False)
            if list(array.shape) != shape or str(array.dtype) != dtype:
                raise ValueError(f"{name}.npy is {array.dtype} {array.shape}")
            arrays[name] = array
        return Cache(folder, float(facts["fps"]), episodes, arrays, tuple(facts["notes"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        say(f"the cache {folder} is damaged ({error}); building it again")
        shutil.rmtree(folder)
        return None


def _build(
    source: Source, mapping: FeatureMap, fingerprint: str, folder: Path, workers: int | None, say: Say
) -> None:
    started = time.perf_counter()
    videos = [f for f in mapping.image_features if source.features[f]["dtype"] == "video"]
    source.check_files(videos)
    slots = source.lengths + (1 if mapping.ours else 0)
    starts = np.concatenate([[0], np.cumsum(slots)[:-1]])
    episodes = np.stack([starts, source.lengths, np.zeros_like(starts)], 1).astype(np.int64)
    arrays = _allocate(source, mapping, folder, int(slots.sum()), videos)
    _save(folder / "episodes.npy", episodes)
    jobs = _jobs(source, mapping, folder, videos)
    total = sum(rows for _, rows in jobs)
    say(
        f"decoding {source.root}: {len(episodes)} episodes, {source.lengths.sum()} rows, once, into {folder.parent}"
    )
    _run(jobs, total, workers, say)
    _check_filled(source, folder, episodes, videos)
    notes = _terminals(source, mapping, folder, episodes)
    _save(folder / "episodes.npy", episodes)
    _derive_terminated(mapping, folder, arrays)
    for path in folder.glob("filled.*.npy"):
        path.unlink()
    (folder / "episode_key.npy").unlink(missing_ok=True)
    if source.fingerprint() != fingerprint:
        raise UserError(f"{source.root} was changed while it was read; start again when nothing writes to it")
    facts = {
        "version": VERSION,
        "root": str(source.root.resolve()),
        "fingerprint": fingerprint,
        "fps": source.fps,
        "mapping": mapping.to_dict(),
        "notes": notes,
        "arrays": arrays,
    }
    (folder / "cache.json").write_text(json.dumps(facts, indent=2) + "\n")
    say(f"  done in {time.perf_counter() - started:.1f} s")


def _allocate(
    source: Source, mapping: FeatureMap, folder: Path, rows: int, videos: Sequence[str]
) -> dict[str, tuple[list[int], str]]:
    """Makes the files, all zeros, their room on the disk taken; returns name → shape, dtype of those that stay."""
    arrays: dict[str, tuple[list[int], str]] = {}
    for key, (_, shape) in mapping.images.items():
        arrays[f"observation.{key}"] = [rows, *shape], "uint8"
    for key, (_, size) in mapping.vectors.items():
        arrays[f"observation.{key}"] = [rows, size], "float32"
    arrays["action"] = ([rows], "int64") if mapping.discrete else ([rows, mapping.action[1]], "float32")
    for entry in mapping.after:
        arrays[f"next.{entry}"] = [rows, 1], "float32" if entry == "reward" else "bool"
    if {"reward", "done"} & set(mapping.after):
        arrays["next.terminated"] = [rows, 1], "bool"
    passing = {filled_name(what): ([rows], "uint8") for what in ("table", *videos)}
    if mapping.ours:
        passing["episode_key"] = [rows], "int64"
    everything = arrays | passing
    needed = sum(int(np.prod(s, dtype=np.int64)) * np.dtype(d).itemsize for s, d in everything.values())
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise UserError(
            f"the cache of {source.root} needs {needed / 1e9:.1f} GB, {folder.parent} has {free / 1e9:.1f} GB free; "
            "choose dataset.cache_dir=… on another disk, or a smaller dataset.image_size"
        )
    for name, (shape, dtype) in everything.items():
        path = folder / f"{name}.npy"
        np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=tuple(shape)).flush()
        if hasattr(os, "posix_fallocate"):
            # A full disk is then an error here instead of a killed process while decoding.
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return arrays


def _jobs(
    source: Source, mapping: FeatureMap, folder: Path, videos: Sequence[str]
) -> list[tuple[TableJob | VideoJob, int]]:
    """All there is to read, with the number of rows of each."""
    numbers: dict[str, list[tuple[str, int, int]]] = {}

    def place(feature: str, array: str, first: int = 0) -> int:
        size = int(source.features[feature]["shape"][0])
        numbers.setdefault(feature, []).append((array, first, size))
        return first + size

    for key, (features, _) in mapping.vectors.items():
        first = 0
        for feature in features:
            first = place(feature, f"observation.{key}", first)
    first = 0
    for feature in mapping.action[0]:
        first = place(feature, "action", first)
    for entry, feature in mapping.after.items():
        place(feature, f"next.{entry}")
    if mapping.ours:
        place(schema.EPISODE_KEY, "episode_key")
    images: dict[str, list[tuple[str, int, int]]] = {}
    for key, (feature, (height, width, _)) in mapping.images.items():
        images.setdefault(feature, []).append((f"observation.{key}", height, width))
    stored = {feature: places for feature, places in images.items() if feature not in videos}
    jobs: list[tuple[TableJob | VideoJob, int]] = []
    for feature in videos:
        for file in unique_files(source.video_files[feature]):
            inside = np.flatnonzero((source.video_files[feature] == file).all(1))
            job = VideoJob(
                path=str(source.video_path(feature, *file)),
                feature=feature,
                fps=source.fps,
                episodes=inside.tolist(),
                begins=source.video_starts[feature][inside].tolist(),
                targets=images[feature],
                folder=str(folder),
            )
            jobs.append((job, int(source.lengths[inside].sum())))
    for file in unique_files(source.data_files):
        path = source.data_path(*file)
        for groups, rows in row_groups(path, ROWS_PER_JOB):
            jobs.append((TableJob(str(path), list(groups), numbers, stored, str(folder)), rows))
    # The longest first: no worker is left alone with one at the end.
    return sorted(jobs, key=lambda job: -job[1])


def _run(jobs: Sequence[tuple[TableJob | VideoJob, int]], total: int, workers: int | None, say: Say) -> None:
    if workers is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
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


def _check_filled(source: Source, folder: Path, episodes: np.ndarray, videos: Sequence[str]) -> None:
    """Every row of every episode exactly once, from the table and from each video."""
    wanted = None
    for what in ("table", *videos):
        filled = np.load(folder / f"{filled_name(what)}.npy", allow_pickle=False)
        if wanted is None:
            wanted = np.zeros_like(filled)
            for start, length, _ in episodes:
                wanted[start : start + length] = 1
        wrong = np.flatnonzero(filled != wanted)
        if len(wrong):
            episode = int(np.searchsorted(episodes[:, 0], wrong[0], side="right")) - 1
            raise UserError(
                f"{source.root}: {len(wrong)} rows are missing or doubled ({what}), the first in episode {episode}, "
                f"frame {wrong[0] - episodes[episode, 0]}; copy or download the dataset again"
            )


def _terminals(source: Source, mapping: FeatureMap, folder: Path, episodes: np.ndarray) -> list[str]:
    """Puts each known o_T into the row after its episode's last; notes what is missing."""
    if not mapping.ours:
        return [
            "no observation after the last action is recorded: the last action of every episode is left out"
        ]
    from franka_wm.data.lerobot.terminal import read_terminals

    keys = np.load(folder / "episode_key.npy", allow_pickle=False)[episodes[:, 0]]
    needed = [f for features, _ in mapping.vectors.values() for f in features] + mapping.image_features
    terminals = read_terminals(
        source.root,
        keys=keys.tolist(),
        lengths=episodes[:, 1].tolist(),
        features={name: source.features[name] for name in needed},
    )
    notes = [] if terminals.problem is None else [terminals.problem]
    found = np.flatnonzero(terminals.found)
    if not len(found):
        return notes
    rows = episodes[found, 0] + episodes[found, 1]
    for key, (features, _) in mapping.vectors.items():
        target = _writable(folder, f"observation.{key}")
        values = [np.asarray(terminals.values[f], np.float32)[found] for f in features]
        target[rows] = np.concatenate([v.reshape(len(found), -1) for v in values], 1)
        target.flush()
    for key, (feature, (height, width, _)) in mapping.images.items():
        target = _writable(folder, f"observation.{key}")
        for row, episode in zip(rows, found, strict=True):
            target[row] = resized(terminals.values[feature][episode], height, width)
        target.flush()
    episodes[found, 2] = 1
    return notes


def _derive_terminated(mapping: FeatureMap, folder: Path, arrays: dict[str, tuple[list[int], str]]) -> None:
    """Fills ``next.terminated`` where the dataset has none; the mapping's notes say by which rule."""
    if "next.terminated" not in arrays or "terminated" in mapping.after:
        return
    if "done" not in mapping.after:
        return  # never: all zeros already
    done = _writable(folder, "next.done")
    target = _writable(folder, "next.terminated")
    if "truncated" in mapping.after:
        target[:] = done & ~_writable(folder, "next.truncated")
    elif "success" in mapping.after:
        target[:] = done & _writable(folder, "next.success")
    target.flush()


def _writable(folder: Path, name: str) -> np.memmap:
    return np.lib.format.open_memmap(folder / f"{name}.npy", mode="r+")


def _save(path: Path, array: np.ndarray) -> None:
    np.save(path, array, allow_pickle=False)


def _remove_outdated(parent: Path, folder: Path, source: Source, fingerprint: str) -> None:
    """Removes caches of the same folder's former content: nothing can ask for them any more."""
    root = str(source.root.resolve())
    for path in parent.glob("*/cache.json"):
        if path.parent == folder or ".writing-" in path.parent.name:
            continue
        try:
            facts = json.loads(path.read_text())
        except (OSError, ValueError):
            continue  # not ours to judge: another process may be removing it
        if facts.get("root") == root and facts.get("fingerprint") != fingerprint:
            shutil.rmtree(path.parent)
