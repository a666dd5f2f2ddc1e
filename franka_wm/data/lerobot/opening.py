"""Opens recorded datasets: decodes them once, joins them, puts them where there is memory."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from franka_wm import processes
from franka_wm.data.lerobot.cache import Cache, Say, open_cache
from franka_wm.data.lerobot.mapping import FeatureMap, map_features
from franka_wm.data.lerobot.provenance import recorded_sessions, recorded_tasks
from franka_wm.data.lerobot.source import Source, find_dataset, read_source
from franka_wm.data.lerobot.windows import RecordedWindows, Recording
from franka_wm.data.memory import free_memory
from franka_wm.device import resolve_device
from franka_wm.errors import UserError

MEMORY_SHARE = 0.5
"""How much of the free memory a dataset may take before it is read from the disk instead."""


def open_dataset(
    root: str | Path | Sequence[str | Path] | None = None,
    *,
    repo_id: str | Sequence[str] | None = None,
    window: int,
    batch_size: int,
    device: torch.device | str = "cpu",
    split: str = "train",
    validation_fraction: float = 0.1,
    seed: int = 0,
    features: Mapping[str, str | Sequence[str]] | None = None,
    keys: Sequence[str] | None = None,
    rewards_for: str | None = None,
    image_size: int | Sequence[int] | None = None,
    normalize_actions: bool | None = None,
    cache_dir: str | Path | None = None,
    in_memory: bool | None = None,
    workers: int | None = None,
    frame_stack: int = 1,
    future: bool = False,
    burn_in: int = 0,
    fps: float | None = None,
    action_dim: int | None = None,
    say: Say = print,
) -> RecordedWindows:
    """Opens one or several LeRobot v3 datasets for training.

    Each is decoded once into a cache (:mod:`franka_wm.data.lerobot.cache`); opening it again takes no time.

    Args:
        root: Folder of a dataset, or a list of them.
        repo_id: Name on the Hub, or a list; LeRobot's own local copy is used if there is one. Besides ``root`` or
            instead of it.
        window: Transitions per window, H.
        batch_size: Windows per sample.
        device: Where batches are given out.
        split, validation_fraction, seed: See :class:`RecordedWindows`.
        features: Which feature becomes which entry; by convention if not given
            (:func:`~franka_wm.data.lerobot.mapping.map_features`).
        keys: Observations that are needed; others are not decoded.
        rewards_for: Who learns from rewards, for the message where there are none; ``None``: nobody.
        image_size: Images are resized to this square, or to (height, width) [px].
        normalize_actions: Scale actions to [−1, 1]; ``None``: where the dataset is not of this package.
        cache_dir: Where caches are kept; ``~/.cache/franka_wm/datasets`` if not given.
        in_memory: Keep everything in the device's memory, else read from the disk's cache; ``None``: where it
            takes at most half of what is free, for every process of a job, each of which calls this.
        workers: Processes that decode; ``None``: all cores.
        frame_stack, future, burn_in: See :class:`RecordedWindows`.
        fps, action_dim: Frames per second and size of actions of the environment that is to be acted in.
        say: Takes lines for the terminal.

    Raises:
        UserError: One line, for a dataset that cannot be used as asked.
    """
    roots = [folder for _, folder in find_datasets(root, repo_id)]
    asked = None if device is None else resolve_device(device)
    device = torch.empty(0, device=asked).device  # with its index
    sources, mappings = read_datasets(
        roots,
        features=features,
        keys=keys,
        rewards_for=rewards_for,
        image_size=image_size,
        normalize_actions=normalize_actions,
        fps=fps,
        action_dim=action_dim,
    )
    caches = [
        open_cache(s, m, cache_dir=cache_dir, workers=workers, say=say)
        for s, m in zip(sources, mappings, strict=True)
    ]
    notes = [note for m, c in zip(mappings, caches, strict=True) for note in (*m.notes, *c.notes)]
    episodes, low, high = _join(caches)
    scale = _scales(mappings, normalize_actions)
    if scale:
        notes.append(
            f"actions are scaled to [−1, 1] from {np.array2string(low, precision=3, suppress_small=True)} … "
            f"{np.array2string(high, precision=3, suppress_small=True)}, what the data spans"
        )
    elif not mappings[0].discrete and (np.abs([low, high]) > 1 + 1e-6).any():
        raise UserError(
            f"{roots[0]}: actions reach from {low.min():.3g} to {high.max():.3g}, models take [−1, 1]; "
            + (
                "use env=none dataset.normalize_actions=true"
                if action_dim
                else "set dataset.normalize_actions=true"
            )
        )
    arrays, in_memory = _load(caches, device, in_memory)
    recording = Recording(
        caches,
        mappings[0],
        arrays,
        in_memory,
        device,
        episodes,
        low if scale else None,
        high if scale else None,
        list(dict.fromkeys(notes)),
    )
    windows = RecordedWindows(
        recording,
        window=window,
        batch_size=batch_size,
        split=split,
        validation_fraction=validation_fraction,
        seed=seed,
        frame_stack=frame_stack,
        future=future,
        burn_in=burn_in,
    )
    where = f"in {device} memory" if in_memory else "read from the disk's cache"
    size = sum(c.nbytes for c in caches)
    say(
        f"recorded data: {len(windows.episodes)} of {len(episodes)} episodes ({split}), "
        f"{windows.transitions} transitions, {len(windows)} windows of {window}; {size / 1e6:.0f} MB {where}"
    )
    for note in recording.notes:
        say(f"  {note}")
    return windows


def find_datasets(
    root: str | Path | Sequence[str | Path] | None, repo_id: str | Sequence[str] | None, *, meta: bool = False
) -> list[tuple[str, Path]]:
    """Folders of datasets that are given by folder and by name, each behind the option that names it.

    Args:
        root, repo_id: As those of :func:`open_dataset`.
        meta: Only what datasets say of themselves is needed: of those on the Hub nothing else is fetched.

    Raises:
        UserError: One cannot be fetched.
    """
    here = [(f"dataset.root={one}", Path(one)) for one in _as_list(root)]
    return here + [(f"dataset.repo_id={one}", find_dataset(one, meta=meta)) for one in _as_list(repo_id)]


def read_datasets(
    root: str | Path | Sequence[str | Path],
    *,
    features: Mapping[str, str | Sequence[str]] | None = None,
    keys: Sequence[str] | None = None,
    rewards_for: str | None = None,
    image_size: int | Sequence[int] | None = None,
    normalize_actions: bool | None = None,
    fps: float | None = None,
    action_dim: int | None = None,
) -> tuple[list[Source], list[FeatureMap]]:
    """Reads what datasets say of themselves, and refuses what cannot be used as asked; no row is read.

    Args: as those of :func:`open_dataset`.

    Raises:
        UserError: One line.
    """
    roots = [Path(one) for one in _as_list(root)]
    if not roots:
        raise UserError("dataset=lerobot: give dataset.root=FOLDER or dataset.repo_id=USER/NAME")
    sources = [read_source(one) for one in roots]
    asked: dict[str, Any] = {"features": features, "keys": keys, "rewards_for": rewards_for}
    mappings = [map_features(s, image_size=image_size, **asked) for s in sources]
    for other, source in zip(mappings[1:], sources[1:], strict=True):
        _check_alike(mappings[0], other, str(roots[0]), str(source.root))
        if source.fps != sources[0].fps:
            raise UserError(
                f"{roots[0]} has {sources[0].fps:g} frames per second, {source.root} {source.fps:g}; "
                "train on them separately"
            )
    there, size = sources[0].fps, mappings[0].action[1]
    if fps is not None and abs(fps - there) > 1e-6 * there:
        task = _recorded_task(sources[0])
        raise UserError(
            f"{task and f'recorded with {task}: '}{roots[0]} has {there:g} frames per second, the environment {fps:g}; "
            f"a step would mean something else. Use {task and f'an env with {task} and '}env.fps={there:g}"
        )
    if action_dim is not None and not mappings[0].discrete and action_dim != size:
        task = _recorded_task(sources[0])
        raise UserError(
            f"{task and f'recorded with {task}: '}{roots[0]}: its actions have {size} numbers, the environment's "
            f"{action_dim}; "
            "choose the env that it was recorded in (or its env.action_mode), or another dataset"
        )
    if action_dim is not None and _scales(mappings, normalize_actions):
        raise UserError(
            f"{roots[0]}: actions would be scaled to [−1, 1] by what the data spans, and mean something else in the "
            "environment; use env=none to train alone, or dataset.normalize_actions=false if they are in [−1, 1]"
        )
    return sources, mappings


def _recorded_task(source: Source) -> str:
    """``env.task=NAME``, if it says so: what else is other may be since this is. It is said before that."""
    tasks = recorded_tasks(recorded_sessions(source.root))
    return f"env.task={tasks.pop()}" if len(tasks) == 1 else ""


def _scales(mappings: Sequence[FeatureMap], normalize_actions: bool | None) -> bool:
    """Whether actions are scaled by what the data spans: as asked, else where a dataset is not of this package."""
    asked = not all(one.ours for one in mappings) if normalize_actions is None else normalize_actions
    return asked and not mappings[0].discrete


def _as_list(value: Any) -> list[Any]:
    if value is None:
        return []
    return [value] if isinstance(value, (str, Path)) else list(value)


def _check_alike(a: FeatureMap, b: FeatureMap, name_a: str, name_b: str) -> None:
    """Refuses datasets that do not give the same entries of the same size."""
    for what in ("images", "vectors"):
        x = {key: size for key, (_, size) in getattr(a, what).items()}
        y = {key: size for key, (_, size) in getattr(b, what).items()}
        if x != y:
            raise UserError(
                f"{name_a} gives {x or 'no ' + what}, {name_b} {y or 'no ' + what}; several datasets must be alike: "
                "choose entries with dataset.features, sizes of images with dataset.image_size"
            )
    if a.action[1] != b.action[1]:
        raise UserError(f"actions have {a.action[1]} numbers in {name_a} and {b.action[1]} in {name_b}")
    if sorted(a.after) != sorted(b.after):
        raise UserError(
            f"{name_a} has {', '.join(a.after) or 'no reward or end'}, {name_b} {', '.join(b.after) or 'none'}; "
            "several datasets must be alike"
        )


def _join(caches: Sequence[Cache]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Episodes of all datasets, and the smallest and largest actions."""
    episodes, lows, highs, offset = [], [], [], 0
    for k, cache in enumerate(caches):
        start, length, known = cache.episodes.T
        episodes.append(np.stack([np.full_like(start, k), start + offset, length, known], 1))
        action = cache.arrays["action"]
        rows = np.zeros(len(action), bool)
        for s, n in zip(start, length, strict=True):
            rows[s : s + n] = True
        lows.append(action[rows].min(0))
        highs.append(action[rows].max(0))
        offset += len(action)
    return np.concatenate(episodes), np.minimum.reduce(lows), np.maximum.reduce(highs)


def _load(
    caches: Sequence[Cache], device: torch.device, in_memory: bool | None
) -> tuple[dict[str, list[Tensor]], bool]:
    if in_memory is None:
        free = free_memory(device)
        if free is None:  # the system does not tell: what it has in all
            free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fits = sum(c.nbytes for c in caches) <= MEMORY_SHARE * free
        # Windows are drawn where the data lies: a process that drew elsewhere would not draw its part of a batch.
        in_memory = all(processes.objects(fits))
    arrays: dict[str, list[Tensor]] = {}
    for name in caches[0].arrays:
        parts = [torch.from_numpy(np.asarray(c.arrays[name])) for c in caches]
        if in_memory:
            rows = sum(part.shape[0] for part in parts)
            whole = torch.empty((rows, *parts[0].shape[1:]), dtype=parts[0].dtype, device=device)
            first = 0
            for part in parts:
                whole[first : first + part.shape[0]].copy_(part)
                first += part.shape[0]
            parts = [whole]
        arrays[name] = parts
    return arrays, in_memory
