"""The observation after the last action of each episode, kept beside LeRobot's rows.

LeRobot's form has one row for each action, so an episode of T actions loses its last observation, o_T. Here each is
a row of ``meta/franka_wm/terminal/file-NNN.parquet``, which LeRobot's readers do not look at:

    episode_key  int64       which episode it belongs to; the feature ``episode_key`` of its rows
    length       int64       rows of that episode
    <feature>    list, or binary (PNG) for images, exact in every format

Episodes are found by key, not by index: LeRobot's tools may delete, split, reorder or merge episodes. Where such a
tool has dropped this folder, or has changed an episode's length, reading says so and gives what is left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.png import decode_image, encode_png
from franka_wm.data.lerobot.schema import OWN_FOLDER
from franka_wm.errors import UserError
from franka_wm.untrusted import values_of

TERMINAL_FOLDER = f"{OWN_FOLDER}/terminal"


@dataclass(frozen=True)
class Terminals:
    """Terminal observations for a list of episodes.

    Attributes:
        found: (E,) bool: which episodes have one.
        values: Feature → (E, …); zeros where none was found.
        problem: One line about what is missing, or ``None``.
    """

    found: np.ndarray
    values: dict[str, np.ndarray]
    problem: str | None


def write_terminals(
    path: Path, *, keys: Sequence[int], lengths: Sequence[int], values: Mapping[str, np.ndarray]
) -> None:
    """Writes one file.

    Args:
        path: The file; its folder is made.
        keys, lengths: (E,) of each episode.
        values: Feature → (E, …); uint8 of four dimensions (E, H, W, 3) are images.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {
        "episode_key": pa.array(keys, pa.int64()),
        "length": pa.array(lengths, pa.int64()),
    }
    for feature, array in values.items():
        if array.dtype == np.uint8 and array.ndim == 4:
            columns[feature] = pa.array([encode_png(image) for image in array], pa.binary())
        else:
            flat = pa.array(np.ascontiguousarray(array).reshape(-1))
            columns[feature] = pa.FixedSizeListArray.from_arrays(
                flat, int(np.prod(array.shape[1:], dtype=int))
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def read_terminals(
    root: str | Path,
    *,
    keys: Sequence[int],
    lengths: Sequence[int],
    features: Mapping[str, Mapping[str, Any]],
) -> Terminals:
    """The terminal observations of these episodes.

    Args:
        root: The dataset's folder.
        keys, lengths: (E,) of each episode: its feature ``episode_key`` and its number of rows.
        features: The features wanted, with ``dtype`` (``image`` and ``video`` are images) and ``shape``.

    Returns:
        What was found, and in ``problem`` one line about what was not.
    """
    files = sorted((Path(root) / TERMINAL_FOLDER).glob("*.parquet"))
    wanted = {int(key): [] for key in keys}
    for place, key in enumerate(keys):
        wanted[int(key)].append(place)
    found = np.zeros(len(keys), bool)
    values: dict[str, np.ndarray] = {}
    for feature, spec in features.items():
        is_image = spec["dtype"] in ("image", "video")
        values[feature] = np.zeros((len(keys), *spec["shape"]), "uint8" if is_image else spec["dtype"])
    changed = 0
    for file in files:
        with values_of(str(file), "delete it, and the last step of every episode is left out."):
            changed += _read_file(file, wanted, lengths, found, values)
    missing = int((~found).sum())
    problem = None
    if missing:
        why = (
            "there is no " + TERMINAL_FOLDER
            if not files
            else f"{changed} episodes changed their length"
            if changed
            else "they are not in " + TERMINAL_FOLDER
        )
        problem = (
            f"{root}: {missing} of {len(keys)} episodes have no terminal observation ({why}); their last step is "
            "not used where the observation after it is needed"
        )
    return Terminals(found, values, problem)


def _read_file(
    file: Path,
    wanted: Mapping[int, Sequence[int]],
    lengths: Sequence[int],
    found: np.ndarray,
    values: Mapping[str, np.ndarray],
) -> int:
    """Fills in what a file has of the episodes that are wanted; returns how many of them changed their length."""
    import pyarrow.parquet as pq

    names = pq.read_schema(file).names
    lacking = [feature for feature in values if feature not in names]
    if lacking:
        raise UserError(f"{file}: has no {lacking[0]!r}; it belongs to another dataset")
    table = pq.read_table(file, columns=["episode_key", "length", *values])
    changed = 0
    for row, (key, length) in enumerate(
        zip(table["episode_key"].to_pylist(), table["length"].to_pylist(), strict=True)
    ):
        for place in wanted.get(key, ()):
            if found[place]:
                continue
            if length != lengths[place]:
                changed += 1
                continue
            found[place] = True
            for feature, array in values.items():
                cell = table[feature][row].as_py()
                value = (
                    decode_image(cell)
                    if isinstance(cell, bytes)
                    else np.asarray(cell, array.dtype).reshape(array.shape[1:])
                )
                if value.shape != array.shape[1:]:
                    raise ValueError(f"{feature} of shape {value.shape}")
                if value.dtype.kind == "f" and not np.isfinite(value).all():
                    raise UserError(
                        f"{file}: {feature} holds a number that is not finite, in row {row}; delete the file, and the "
                        "last step of every episode is left out."
                    )
                array[place] = value
    return changed
