"""Shards into one dataset.

The result is what LeRobot's ``aggregate_datasets`` makes of them, with one data and one video file for each of
theirs; a test holds the two to the same tables. That function takes every image out of its file and puts it back,
row by row, which is some twenty times slower than writing them was. Here only the numbers that change (places in the
whole) are rewritten.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.schema import EPISODE_KEY, PROVENANCE
from franka_wm.data.lerobot.shard import INFO_PATH, STATS_PATH, TASKS_PATH, lists, write_json
from franka_wm.data.lerobot.stats import aggregate
from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER
from franka_wm.errors import UserError
from franka_wm.untrusted import UntrustedFolder, linked_json

_SHIFTED_STATS = ("min", "max", "mean", "q01", "q10", "q50", "q90", "q99")


def merge(out: Path, roots: Sequence[Path], provenance: dict[str, Any]) -> None:
    """Merges datasets that this package wrote with one schema.

    Args:
        out: Must not exist.
        roots: The datasets, in order.
        provenance: Is written into it.

    Raises:
        UserError: The result does not hold the rows that went in.
    """
    infos = [linked_json(root / INFO_PATH) for root in roots]
    ours = infos[-1]
    for root, info in zip(roots, infos, strict=True):  # names of features become folders
        if _columns(info) != _columns(ours):
            raise UserError(f"{root}: its features are not those of {roots[-1]}; choose another out")
        UntrustedFolder(root).check_links()
    videos = [name for name, feature in ours["features"].items() if feature["dtype"] == "video"]
    (out / "meta").mkdir(parents=True)
    shutil.copyfile(roots[0] / TASKS_PATH, out / TASKS_PATH)
    data, meta = _places(ours["chunks_size"]), _places(ours["chunks_size"])
    video = {name: _places(ours["chunks_size"]) for name in videos}
    episodes = frames = 0
    for root, info in zip(roots, infos, strict=True):
        moved = {"data": _move_rows(root / "data", out / "data", data, episodes, frames)}
        for name in videos:
            moved[f"videos/{name}"] = _copy_files(root / "videos" / name, out / "videos" / name, video[name])
        _move_episodes(root, out, meta, moved, episodes, frames)
        episodes += info["total_episodes"]
        frames += info["total_frames"]
    info = ours | {
        "total_episodes": episodes,
        "total_frames": frames,
        "splits": {"train": f"0:{episodes}"},
    }
    write_json(out / INFO_PATH, info)
    stats = aggregate([linked_json(root / STATS_PATH) for root in roots])
    write_json(out / STATS_PATH, lists(stats))
    merge_terminals(out, roots)
    (out / PROVENANCE).write_text(json.dumps(provenance, indent=1), encoding="utf-8")
    check_merged(out, roots)


def _columns(info: dict[str, Any]) -> dict[str, tuple[Any, ...]]:
    """What the features of a dataset hold, by their names."""
    return {name: (one["dtype"], list(one["shape"])) for name, one in info["features"].items()}


type _Place = tuple[int, int]
"""Chunk and file number."""


def _places(chunk: int) -> Iterator[_Place]:
    """(0, 0), (0, 1), …, (0, chunk − 1), (1, 0), …"""
    number = 0
    while True:
        yield divmod(number, chunk)
        number += 1


def _file(folder: Path, place: _Place, suffix: str) -> Path:
    path = folder / f"chunk-{place[0]:03d}" / f"file-{place[1]:03d}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _files(folder: Path, suffix: str) -> list[tuple[_Place, Path]]:
    """The files of a folder with their places, in order."""
    found = [
        ((int(file.parent.name.split("-")[1]), int(file.stem.split("-")[1])), file)
        for file in folder.glob(f"chunk-*/file-*{suffix}")
    ]
    return sorted(found)


def _copy_files(source: Path, target: Path, places: Iterator[_Place]) -> dict[_Place, _Place]:
    moved = {}
    for old, file in _files(source, ".mp4"):
        moved[old] = next(places)
        shutil.copyfile(file, _file(target, moved[old], ".mp4"))
    return moved


def _move_rows(
    source: Path, target: Path, places: Iterator[_Place], episodes: int, frames: int
) -> dict[_Place, _Place]:
    """Copies data files; rows are renumbered to follow ``episodes`` and ``frames`` that are there already."""
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    moved = {}
    for old, file in _files(source, ".parquet"):
        moved[old] = next(places)
        path = _file(target, moved[old], ".parquet")
        if not frames:
            shutil.copyfile(file, path)
            continue
        reader = pq.ParquetFile(file)
        schema = reader.schema_arrow
        with pq.ParquetWriter(path, schema, compression="snappy", use_dictionary=True) as writer:
            for group in range(reader.num_row_groups):
                table = reader.read_row_group(group)
                for name, offset in (("episode_index", episodes), ("index", frames)):
                    column = schema.get_field_index(name)
                    table = table.set_column(column, schema.field(column), pc.add(table[name], offset))  # pyright: ignore[reportAttributeAccessIssue]
                writer.write_table(table)
    return moved


def _move_episodes(
    root: Path,
    out: Path,
    places: Iterator[_Place],
    moved: dict[str, dict[_Place, _Place]],
    episodes: int,
    frames: int,
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for _, file in _files(root / "meta" / "episodes", ".parquet"):
        place = next(places)
        table = pq.read_table(file)
        columns = {name: table[name].to_pylist() for name in table.column_names}
        for kind, places_of in moved.items():
            old = zip(columns[f"{kind}/chunk_index"], columns[f"{kind}/file_index"], strict=True)
            new = [places_of[one] for one in old]
            columns[f"{kind}/chunk_index"] = [chunk for chunk, _ in new]
            columns[f"{kind}/file_index"] = [number for _, number in new]
        columns["meta/episodes/chunk_index"] = [place[0]] * len(table)
        columns["meta/episodes/file_index"] = [place[1]] * len(table)
        for name, offset in (("episode_index", episodes), ("index", frames)):
            for stat in _SHIFTED_STATS:
                values = columns[f"stats/{name}/{stat}"]
                columns[f"stats/{name}/{stat}"] = [[one + offset for one in value] for value in values]
        for name, offset in (
            ("episode_index", episodes),
            ("dataset_from_index", frames),
            ("dataset_to_index", frames),
        ):
            columns[name] = [value + offset for value in columns[name]]
        pq.write_table(
            pa.Table.from_pydict(columns, schema=table.schema),
            _file(out / "meta" / "episodes", place, ".parquet"),
        )


def merge_terminals(out: Path, roots: Sequence[Path]) -> None:
    """Copies the terminal observations of ``roots`` into ``out``; for datasets that LeRobot's own tools merged."""
    folder = out / TERMINAL_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    files = [file for root in roots for file in sorted((root / TERMINAL_FOLDER).glob("*.parquet"))]
    for number, file in enumerate(files, len(list(folder.glob("*.parquet")))):
        shutil.copyfile(file, folder / f"file-{number:03d}.parquet")


def check_merged(out: Path, roots: Sequence[Path]) -> None:
    """Compares rows, their order and the number of images with the datasets that were merged.

    Raises:
        UserError: They differ.
    """
    info = linked_json(out / INFO_PATH)
    rows = _column(out, EPISODE_KEY)
    expected = np.concatenate([_column(root, EPISODE_KEY) for root in roots])
    if not np.array_equal(rows, expected) or info["total_frames"] != len(rows):
        raise UserError(
            f"merging gave {len(rows)} rows, {len(expected)} were to be merged, or in another order"
        )
    if not np.array_equal(_column(out, "index"), np.arange(len(rows))):
        raise UserError("merging gave rows that are not numbered one after the other")
    for name, feature in info["features"].items():
        if feature["dtype"] == "video":
            frames = sum(_frames(file) for _, file in _files(out / "videos" / name, ".mp4"))
            if frames != len(rows):
                raise UserError(f"merging gave {frames} images of {name} for {len(rows)} rows")


def _column(root: Path, name: str) -> np.ndarray:
    import pyarrow.parquet as pq

    files = [file for _, file in _files(root / "data", ".parquet")]
    return np.concatenate([pq.read_table(file, columns=[name])[name].to_numpy() for file in files])


def _frames(video: Path) -> int:
    import av

    container = av.open(str(video))
    try:
        return sum(packet.pts is not None for packet in container.demux(video=0))
    finally:
        container.close()
