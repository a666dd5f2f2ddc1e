"""A dataset decoded into the arrays of its cache; :mod:`~franka_wm.data.lerobot.cache` says what they are."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from franka_wm.data.lerobot import schema
from franka_wm.data.lerobot.decode import TableJob, VideoJob, filled_name, resized, row_groups
from franka_wm.data.lerobot.decode_workers import Say, run_jobs
from franka_wm.data.lerobot.mapping import FeatureMap
from franka_wm.data.lerobot.source import Source, unique_files
from franka_wm.errors import UserError

VERSION = 1
"""Version of a cache's form: a cache of another one is built anew."""
ROWS_PER_JOB = 2048


def build_cache(
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
    run_jobs(jobs, total, workers, say)
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
