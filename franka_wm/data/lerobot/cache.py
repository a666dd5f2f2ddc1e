"""A LeRobot dataset decoded once into plain arrays that training reads at memory's speed.

A cache is a folder of ``.npy`` files, memory-mapped when read, and ``cache.json``:

    episodes             (E, 3) int64   first row, number of rows, and whether one more row holds o_T, the
                                        observation after the last action
    observation.<key>    (R, …)         images uint8 (H, W, 3), vectors float32
    action               (R, A) float32, or (R,) int64 where actions are discrete
    next.<entry>         (R, 1)         reward float32, the others bool: what followed the action of that row

Its name is a hash of what it was made from: the dataset's files (path, size, time of change), the mapping, the size
of images, and the version of this form. So a cache is never out of date; those of a dataset that has changed since
are removed. It is built under another name and renamed, and only one process builds it at a time.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import shutil
import uuid
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from franka_wm.data.lerobot.build_cache import VERSION, build_cache
from franka_wm.data.lerobot.decode_workers import Say
from franka_wm.data.lerobot.mapping import FeatureMap
from franka_wm.data.lerobot.source import Source
from franka_wm.errors import UserError
from franka_wm.files import sync
from franka_wm.untrusted import linked_json


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
        """Size of all arrays [bytes]."""
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
        UserError: If a file is missing or damaged, images do not belong to rows, a number is not finite, or
            there is no room.
    """
    from filelock import FileLock, Timeout

    fingerprint = source.fingerprint()
    identity = json.dumps([VERSION, fingerprint, mapping.to_dict()], sort_keys=True)
    parent = Path(cache_dir).expanduser() if cache_dir else default_cache_dir()
    name = f"{source.root.resolve().name}-{hashlib.sha256(identity.encode()).hexdigest()[:24]}"
    folder = parent / name
    if (cache := _read(folder, lambda _: None)) is not None:
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
            if folder.is_dir():
                shutil.rmtree(folder)
            for left_over in parent.glob(f"{glob.escape(name)}.writing-*"):
                shutil.rmtree(left_over)
            temporary = parent / f"{name}.writing-{uuid.uuid4().hex[:8]}"
            try:
                temporary.mkdir()
                build_cache(source, mapping, fingerprint, temporary, workers, say)
                # Else a power cut leaves names without content.
                for path in (
                    *temporary.iterdir(),
                    temporary,
                ):
                    sync(path)
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
    """The cache in ``folder``; ``None`` if there is none, or one that is damaged."""
    if not folder.is_dir():
        return None
    try:
        facts = linked_json(folder / "cache.json")
        # Mapped first: what is larger than its file is refused, not allocated.
        episodes = np.array(np.load(folder / "episodes.npy", mmap_mode="r", allow_pickle=False))
        arrays = {}
        for name, (shape, dtype) in facts["arrays"].items():
            # Copy-on-write: torch warns of arrays that it may not write.
            array = np.load(folder / f"{name}.npy", mmap_mode="c", allow_pickle=False)
            if list(array.shape) != shape or str(array.dtype) != dtype:
                raise ValueError(f"{name}.npy is {array.dtype} {array.shape}")
            arrays[name] = array
        return Cache(folder, float(facts["fps"]), episodes, arrays, tuple(facts["notes"]))
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError) as error:
        say(f"the cache {folder} is damaged ({error}); building it again")
        return None


def _remove_outdated(parent: Path, folder: Path, source: Source, fingerprint: str) -> None:
    """Removes caches of the same folder's former content: nothing can ask for them any more."""
    root = str(source.root.resolve())
    for path in parent.glob("*/cache.json"):
        if path.parent == folder or ".writing-" in path.parent.name:
            continue
        try:
            facts = linked_json(path)
        except (OSError, ValueError):
            continue  # not ours to judge: another process may be removing it
        if facts.get("root") == root and facts.get("fingerprint") != fingerprint:
            shutil.rmtree(path.parent)
