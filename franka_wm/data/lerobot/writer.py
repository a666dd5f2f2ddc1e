"""Episodes from memory to a LeRobot dataset, through shards that other processes write.

While a dataset is gathered, everything is in ``OUT.writing``:

    writer.json            schema and sessions, to go on with
    shards/shard-00000     a whole LeRobot dataset of some episodes
    shards/….partial       one that is being written; becomes the above by a rename when all of it has been checked
    merged                 all of them in one; becomes OUT by a rename
    previous               what was at OUT before, until that rename

So OUT is there whole or not at all, a kill at any moment loses no shard that was finished, and going on needs
nothing but the folder. Several processes of one job write shards side by side, which the first one merges.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.alike import check_alike
from franka_wm.data.lerobot.episodes import Episode
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.schema import Schema
from franka_wm.data.lerobot.shard import check_episode
from franka_wm.data.lerobot.shard_workers import (
    LOCK,
    PARTIAL,
    InProcess,
    Worker,
    WorkerEnded,
    WritingFailedError,
    lock_folder,
    wait_for_orphans,
)
from franka_wm.data.lerobot.source import MOST_ROWS, check_finite
from franka_wm.errors import UserError
from franka_wm.files import sync, unwritable
from franka_wm.options import is_whole, whole_rule
from franka_wm.untrusted import UntrustedFolder, linked_json, values_of

PREVIOUS = "previous"
"""Where a finished dataset waits, in ``OUT.writing``, while the one with more episodes takes its place."""

SHARD_BYTES = 64_000_000
"""Images and numbers of one shard in memory, before they are compressed."""


def check_out(out: str | Path, *, resume: bool = False, resumable: bool = True) -> None:
    """Whether a dataset can go there, as far as can be told without writing. Arguments as for :class:`DatasetWriter`.

    Raises:
        UserError: The folder exists, or holds something else, or an unfinished dataset.
    """
    out = Path(out).absolute()
    working = _working(out)
    if out.exists() and not resume:
        more = ", or add to it with resume=true" if resumable else ""
        raise UserError(f"out={out} exists; choose another folder{more}")
    if out.exists() and not (out / "meta" / "info.json").is_file():
        raise UserError(f"out={out} is not a LeRobot dataset; choose another folder")
    if not resume and (previous := working / PREVIOUS).exists():
        more = "go on with resume=true" if resumable else "choose another folder"
        raise UserError(
            f"{previous} holds the dataset of {out}, where a kill has left it; {more}, or move it back there"
        )
    if _shards(working) and not resume and (resumable or not _made_again(working)):
        more = "go on with resume=true, or " if resumable else ""
        raise UserError(f"{working} holds an unfinished dataset; {more}remove {working}")
    if _shards(working) and resumable and _made_again(working):
        raise UserError(f"{working} is what an export left, which is not gone on with; remove {working}")
    why = unwritable(working)
    if why is not None:
        raise UserError(f"out={out}: {why}; choose another folder")


def _working(out: Path) -> Path:
    return out.with_name(out.name + ".writing")


def _made_again(working: Path) -> bool:
    """Whether what is there is of an export, which is made again from its replay instead of going on."""
    path = working / "writer.json"
    return path.is_file() and linked_json(path).get("resumable") is False


def _shards(working: Path) -> list[Path]:
    return sorted(folder for folder in (working / "shards").glob("shard-*") if folder.suffix != PARTIAL)


class DatasetWriter:
    """Gathers episodes into a dataset. Use it as a context manager; leaving it stops the writing processes.

    Each process of a job makes one and calls :meth:`finish`: of all their episodes becomes one dataset.

    Args:
        out: The dataset's folder; appears when :meth:`finish` returns.
        schema: What an episode holds.
        provenance: Provenance of this session (:func:`~franka_wm.data.lerobot.provenance.describe`).
        workers: Writing processes; 0 writes in this one, which needs no time to start and gathers nothing meanwhile.
        shard_frames: Steps in a shard; by their size if not given. A kill loses the shards that are not finished.
        resume: Go on with what is in ``OUT.writing``, and add to ``OUT`` if it is there.
        resumable: Whether whoever gathers it has ``resume``; an export does not, and is made again instead: what a
            killed one has left in ``OUT.writing`` is removed.

    Attributes:
        episodes, frames: Written or waiting to be, with those of earlier sessions; of several processes, this one's.
        resumed: How many of the episodes were there already.

    Raises:
        UserError: The folder exists, holds something else, or another process is writing it.
    """

    def __init__(
        self,
        out: str | Path,
        schema: Schema,
        *,
        provenance: Mapping[str, Any],
        workers: int = 2,
        shard_frames: int | None = None,
        resume: bool = False,
        resumable: bool = True,
    ):
        whole_rule(least=0).check("workers", workers)
        whole_rule(least=1, null="by their size").check("shard_frames", shard_frames)
        self.out = Path(out).absolute()
        self.schema = schema
        self.working = _working(self.out)
        self.shard_frames = default_shard_frames(schema) if shard_frames is None else shard_frames
        self._buffer: list[Episode] = []
        self._buffered = 0
        self._workers: list[Worker | InProcess] = []
        self._session = dict(provenance)
        self._number_of_workers = workers
        self._resumable = resumable
        self._lock = None
        from franka_wm import processes  # here: it imports torch

        if processes.is_first():
            self._open(resume)
        found = (self.resumed, self.frames, self._next_shard) if processes.is_first() else None
        self.resumed, self.frames, first = processes.objects(found)[0]
        self.episodes = self.resumed
        processes.require_seen(self.working, "out")
        self._next_shard, self._apart = first + processes.rank(), processes.count()
        self._first_worker = processes.rank() * workers

    # -- before ------------------------------------------------------------------------------------------------

    def _open(self, resume: bool) -> None:
        check_out(self.out, resume=resume, resumable=self._resumable)
        try:
            (self.working / "shards").mkdir(parents=True, exist_ok=True)
            self._lock = lock_folder(self.working / "lock")
        except OSError as error:
            raise UserError(
                f"out={self.out}: cannot write there ({error.strerror}); choose another"
            ) from error
        try:
            wait_for_orphans(self.working / LOCK)
            self._recover()
        except BaseException as error:
            empty = not _shards(self.working) and not (self.working / PREVIOUS).exists()
            if empty and isinstance(error, UserError):
                self._remove_working()
            self.close()
            raise

    def _recover(self) -> None:
        """Puts what a kill has left in order, and counts what is there."""
        state = self._state()
        if not self._resumable and state.get("resumable") is False:
            self._remove_shards()
        merged, previous = self.working / "merged", self.working / PREVIOUS
        if state.pop("replacing", False):  # killed while the finished dataset moved to its place
            if self.out.exists() and not merged.exists():  # it is in its place: what is left here is in it
                self._remove_shards()
                shutil.rmtree(previous, ignore_errors=True)
            self._write_state(state)  # before `merged` goes: without it the shards would seem to be in OUT
        if previous.exists() and not self.out.exists():
            os.rename(previous, self.out)
        shutil.rmtree(merged, ignore_errors=True)
        for folder in (self.working / "shards").glob("*" + PARTIAL):
            shutil.rmtree(folder)
        kept = _shards(self.working)
        with values_of(str(self.out if self.out.exists() else self.working), "choose another out"):
            self._check_schema(state)
        if self.out.exists():
            UntrustedFolder(self.out).check_links()
            check_finite(self.out)
        totals = [_totals(folder) for folder in ([self.out] if self.out.exists() else []) + kept]
        self.resumed = sum(episodes for episodes, _ in totals)
        self.frames = sum(frames for _, frames in totals)
        self._next_shard = 1 + max((_number(folder) for folder in kept), default=-1)
        earlier = state["sessions"] if kept else []
        self._sessions = [*earlier, {"first_shard": self._next_shard} | self._session]
        self._save_state()

    def _remove_shards(self) -> None:
        shutil.rmtree(self.working / "shards")
        (self.working / "shards").mkdir()

    def _state(self) -> dict[str, Any]:
        path = self.working / "writer.json"
        return linked_json(path) if path.is_file() else {}

    def _check_schema(self, state: dict[str, Any]) -> None:
        """Refuses to mix: the shards that are kept, and a finished dataset, must have our schema."""
        finished = read_provenance(self.out) if self.out.exists() else None
        if self.out.exists() and finished is None:
            raise UserError(f"out={self.out} was not written by franka-wm; merge with lerobot-edit-dataset")
        mine = json.loads(json.dumps(self.schema.to_dict()))
        env = json.loads(json.dumps(self._session.get("config", {}).get("env", {})))
        for other in (state if _shards(self.working) else None, finished):
            if other is not None:
                check_alike(f"out={self.out}", other, mine, env, images=self.schema.images)

    def _save_state(self, **more: Any) -> None:
        kind = {} if self._resumable else {"resumable": False}
        self._write_state({"schema": self.schema.to_dict(), "sessions": self._sessions} | kind | more)

    def _write_state(self, state: dict[str, Any]) -> None:
        path = self.working / "writer.json"
        path.with_suffix(".new").write_text(json.dumps(state, indent=1), encoding="utf-8")
        path.with_suffix(".new").replace(path)

    # -- during ------------------------------------------------------------------------------------------------

    def start(self, *, wait: bool = False) -> None:
        """Starts the writing processes; otherwise done when there is something to write.

        Args:
            wait: Until they are ready to write.
        """
        if not self._workers:
            numbers = range(self._number_of_workers)
            self._workers = [Worker(self.working, self._first_worker + n) for n in numbers] or [InProcess()]
        if wait:
            with self._rescuing():
                for worker in self._workers:
                    worker.send(("nothing",))
                while any(worker.busy for worker in self._workers):
                    self._receive()

    def add(self, episodes: Iterable[Episode]) -> None:
        """Takes episodes over; returns when they are in memory or on their way to a process.

        Raises:
            UserError: An episode that cannot be written (:func:`~franka_wm.data.lerobot.shard.check_episode`), or
                writing failed.
        """
        with self._rescuing():
            for worker in self._workers:
                worker.check()
            for episode in episodes:
                check_episode(self.schema, episode)
                self._buffer.append(episode)
                self._buffered += episode.length
                self.episodes += 1
                self.frames += episode.length
                if self._buffered >= self.shard_frames:
                    self._dispatch()

    @contextmanager
    def _rescuing(self) -> Iterator[None]:
        """Inside, the end of a writing process costs the shard that it was at: what is in memory is written here."""
        more = ": collect goes on with resume=true" if self._resumable else ""
        try:
            yield
        except WritingFailedError as error:
            raise UserError(str(error) + (more and f"; what is finished is kept{more}")) from error
        except WorkerEnded as error:
            for worker in self._workers:
                worker.stop()  # with its shard written, unless that takes half a minute
            self._workers = [InProcess()]
            also = ""
            try:
                if self._buffer:
                    self._dispatch()
            except UserError as other:
                also = f"; what was in memory is lost: {other}"
            raise UserError(
                f"{error}{also}; {episodes_there(self.out)} episodes are on disk{more}"
            ) from error

    def _dispatch(self) -> None:
        self.start()
        folder = self.working / "shards" / f"shard-{self._next_shard:05d}"
        self._idle_worker().send(("shard", folder, self.schema, self._buffer))
        self._next_shard += self._apart
        self._buffer, self._buffered = [], 0

    def _idle_worker(self) -> Worker | InProcess:
        for worker in self._workers:
            if not worker.busy:
                return worker
        self._receive()
        return self._idle_worker()

    def _receive(self) -> None:
        """Waits until at least one busy process has answered."""
        busy = [worker for worker in self._workers if isinstance(worker, Worker) and worker.busy]
        ready = wait([worker.connection for worker in busy])
        for worker in busy:
            if worker.connection in ready:
                worker.receive()

    def flush(self) -> None:
        """Writes what is in memory as a shard and waits until all shards are on disk."""
        with self._rescuing():
            if self._buffer:
                self._dispatch()
            while any(worker.busy for worker in self._workers):
                self._receive()

    # -- after -------------------------------------------------------------------------------------------------

    def finish(self) -> Path:
        """Merges the shards; the dataset is at ``out`` when this returns.

        Raises:
            UserError: There is no episode, or writing failed. What is finished stays in ``OUT.writing``.
        """
        from franka_wm import processes

        self.flush()
        if processes.is_first():
            processes.wait()
            self._merge()
        else:
            self.close()  # the first one removes the folder
            processes.wait()
        processes.wait()
        return self.out

    def _merge(self) -> None:
        shards = _shards(self.working)
        if not shards:
            self._remove_working()
            if self.out.exists():  # resumed, with nothing to add
                return
            raise UserError("no episode was gathered, so there is no dataset to write")
        self.start()
        roots = ([self.out] if self.out.exists() else []) + shards
        sessions = self._sessions_with_episodes(shards)
        merged = self.working / "merged"
        provenance = {"sessions": sessions, "schema": self.schema.to_dict()}
        with self._rescuing():
            self._idle_worker().send(("merge", merged, roots, provenance))
        self.flush()
        for path in (*merged.rglob("*"), merged):  # on the disk before the shards go
            sync(path)
        self._save_state(replacing=True)
        if self.out.exists():
            os.rename(self.out, self.working / PREVIOUS)
        os.rename(merged, self.out)
        sync(self.out.parent)
        self._remove_working()

    def _sessions_with_episodes(self, shards: list[Path]) -> list[dict[str, Any]]:
        """Every session with the number of its episodes; those without any are left out."""
        earlier = read_provenance(self.out) if self.out.exists() else None
        out = [] if earlier is None else list(earlier["sessions"])
        first = [session["first_shard"] for session in self._sessions] + [math.inf]
        for session, low, high in zip(self._sessions, first[:-1], first[1:], strict=True):
            episodes = sum(_totals(folder)[0] for folder in shards if low <= _number(folder) < high)
            if episodes:
                out.append({"episodes": episodes} | {k: v for k, v in session.items() if k != "first_shard"})
        return out

    def _remove_working(self) -> None:
        self.close()
        for part in ("shards", PREVIOUS):  # before writer.json, which says that they are in OUT
            shutil.rmtree(self.working / part, ignore_errors=True)
        shutil.rmtree(self.working)

    def close(self) -> None:
        """Stops the writing processes. Finished shards stay where they are."""
        for worker in self._workers:
            worker.stop()
        self._workers = []
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def episodes_there(out: str | Path) -> int:
    """How many episodes going on with ``out`` begins with, as :class:`DatasetWriter` will count them; writes nothing.

    Raises:
        UserError: What is there cannot be read.
    """
    out = Path(out).absolute()
    working, shards = _working(out), _shards(_working(out))
    state = linked_json(file) if (file := working / "writer.json").is_file() else {}
    if state.get("replacing") and out.exists() and not (working / "merged").exists():
        shards = []  # they are in OUT
    whole = [folder for folder in (out, working / PREVIOUS) if folder.exists()][:1]
    return sum(_totals(folder)[0] for folder in (*whole, *shards))


def default_shard_frames(schema: Schema) -> int:
    """Steps that :data:`SHARD_BYTES` hold, within reason."""
    size = sum(
        int(np.prod(feature["shape"])) * schema.numpy_dtype(name).itemsize
        for name, feature in schema.features.items()
    )
    return max(200, min(20_000, SHARD_BYTES // size))


def _number(shard: Path) -> int:
    match = re.search(r"(\d+)$", shard.name)
    assert match is not None
    return int(match[1])


def _totals(folder: Path) -> tuple[int, int]:
    """Episodes and frames of a dataset."""
    info = linked_json(folder / "meta" / "info.json")
    episodes, frames = info.get("total_episodes"), info.get("total_frames")
    if not (is_whole(episodes) and is_whole(frames) and 0 <= episodes <= frames <= MOST_ROWS):
        raise UserError(
            f"{folder}: meta/info.json tells of {episodes!r} episodes and {frames!r} frames, which makes no sense; "
            "copy the dataset again, or choose another out"
        )
    return episodes, frames
