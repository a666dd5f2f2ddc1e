"""One shard: some episodes in memory become one small LeRobot dataset on disk.

LeRobot's recorder takes one frame at a time, through a PNG file on disk for each, and rewrites its metadata and
video after every episode. Here all episodes are there at once, so each file is written once. Nothing of LeRobot is
imported, which takes a process several seconds; the format (v3.0) is written out here, and the tests compare every
file with what LeRobot's recorder makes of the same episodes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.episodes import Episode
from franka_wm.data.lerobot.png import encode_png
from franka_wm.data.lerobot.schema import AUTOMATIC, DONE, Schema
from franka_wm.data.lerobot.stats import aggregate, episode_stats
from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER, write_terminals
from franka_wm.errors import UserError

_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
EPISODES_PATH = f"meta/episodes/{_FILE}.parquet"
TASKS_PATH, INFO_PATH, STATS_PATH = "meta/tasks.parquet", "meta/info.json", "meta/stats.json"

THREADS = Path("/proc/self/task")
"""Where Linux lists the threads of this process."""


def check_episode(schema: Schema, episode: Episode) -> None:
    """Refuses what would be written and only found out when it is read.

    Raises:
        UserError: No rows, a feature that is missing or unknown, a wrong shape or dtype, a number that is not
            finite, or an end (``next.done``) elsewhere than in the last row.
    """
    for place, values, wanted in (
        ("rows", episode.rows, list(schema.features)),
        ("terminal observation", episode.terminal, schema.observed),
    ):
        if missing := [name for name in wanted if name not in values]:
            raise UserError(f"episode: its {place} lacks {missing[0]!r}")
        if unknown := [name for name in values if name not in wanted]:
            raise UserError(f"episode: its {place} has {unknown[0]!r}, which the dataset's schema has not")
    length = episode.length
    if length == 0:
        raise UserError("episode: it has no steps; an episode needs at least one")
    for values, leading in ((episode.rows, (length,)), (episode.terminal, ())):
        for name, array in values.items():
            shape = (*leading, *schema.features[name]["shape"])
            if array.shape != shape or array.dtype != schema.numpy_dtype(name):
                raise UserError(
                    f"episode: {name} is {array.dtype} {tuple(array.shape)}; it must be "
                    f"{schema.numpy_dtype(name)} {shape}"
                )
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise UserError(f"episode: {name} holds NaN or infinity; nothing of this episode was written")
    done = episode.rows[DONE][:, 0]
    if done[:-1].any() or not done[-1]:
        raise UserError(f"episode: {DONE} must be true in the last of its {length} rows, and only there")


def write_shard(folder: Path, schema: Schema, episodes: Sequence[Episode]) -> None:
    """Writes a LeRobot dataset of these episodes, and checks that what is there is what was given.

    Args:
        folder: Must not exist.
        schema, episodes: Checked already (:func:`check_episode`).

    Raises:
        UserError: The files do not hold as many frames as were given.
    """
    folder.mkdir(parents=True)
    columns = [_columns(schema, episode) for episode in episodes]
    begin = 0
    for number, one in enumerate(columns):
        length = episodes[number].length
        one["timestamp"] = (np.arange(length) / schema.fps).astype(np.float32)
        one["frame_index"] = np.arange(length)
        one["episode_index"] = np.full(length, number)
        one["index"] = np.arange(begin, begin + length)
        one["task_index"] = np.zeros(length, np.int64)
        begin += length
    stats = [episode_stats(one) for one in columns]
    features = _features(schema)
    if schema.format != "exact":
        for name in schema.images:
            path = folder / VIDEO_PATH.format(video_key=name, chunk_index=0, file_index=0)
            encode_video(path, [one[name] for one in columns], schema)
            check_video(path, begin, schema.fps)
            features[name]["info"] = _video_info(path, schema)
    _write_rows(folder / DATA_PATH.format(chunk_index=0, file_index=0), features, columns)
    _write_meta(folder, schema, features, episodes, stats)
    write_terminals(
        folder / TERMINAL_FOLDER / "file-000.parquet",
        keys=[episode.key for episode in episodes],
        lengths=[episode.length for episode in episodes],
        values={name: np.stack([episode.terminal[name] for episode in episodes]) for name in schema.observed},
    )


def _columns(schema: Schema, episode: Episode) -> dict[str, np.ndarray]:
    """As LeRobot stores them: a feature of one number is a plain column."""
    return {
        name: array[:, 0] if array.shape[1:] == (1,) else array
        for name, array in ((name, episode.rows[name]) for name in schema.features)
    }


def _features(schema: Schema) -> dict[str, dict[str, Any]]:
    """As in ``info.json``: those of the schema and the automatic ones."""
    features = {
        name: feature | {"shape": list(feature["shape"])} for name, feature in schema.features.items()
    }
    for name in AUTOMATIC:
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return features


def _write_rows(path: Path, features: dict[str, Any], columns: Sequence[dict[str, np.ndarray]]) -> None:
    """One row group for each episode, as LeRobot writes it: readers of single episodes skip the others."""
    import pyarrow.parquet as pq

    arrow = arrow_schema(features)
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, arrow, compression="snappy", use_dictionary=True) as writer:
        for one in columns:
            writer.write_table(_table(one, arrow))


def arrow_schema(features: dict[str, Any]) -> Any:
    """Schema of the data files, with the note that tells ``datasets`` what is an image."""
    import pyarrow as pa

    fields, notes = [], {}
    for name, feature in features.items():
        if feature["dtype"] == "video":
            continue
        if feature["dtype"] == "image":
            fields.append((name, pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
            notes[name] = {"_type": "Image"}
            continue
        kind = pa.bool_() if feature["dtype"] == "bool" else pa.type_for_alias(feature["dtype"])
        note: dict[str, Any] = {"dtype": feature["dtype"], "_type": "Value"}
        (size,) = feature["shape"]
        fields.append((name, kind if size == 1 else pa.list_(kind, size)))
        notes[name] = note if size == 1 else {"feature": note, "length": size, "_type": "List"}
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": notes}})})


def _table(columns: dict[str, np.ndarray], arrow: Any) -> Any:
    import pyarrow as pa

    arrays = []
    for field in arrow:
        array = columns[field.name]
        if array.ndim == 4:
            data = pa.array([encode_png(image) for image in array], pa.binary())
            names = pa.array([f"frame-{i:06d}.png" for i in range(len(array))], pa.string())
            arrays.append(pa.StructArray.from_arrays([data, names], fields=list(field.type)))
        elif array.ndim == 2:
            flat = pa.array(np.ascontiguousarray(array).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        else:
            arrays.append(pa.array(array, field.type))
    return pa.Table.from_arrays(arrays, schema=arrow)


def _write_meta(
    folder: Path,
    schema: Schema,
    features: dict[str, dict[str, object]],
    episodes: Sequence[Episode],
    stats: Sequence[dict[str, dict[str, np.ndarray]]],
) -> None:
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: dict[str, list[Any]] = {}
    begin = 0
    for number, episode in enumerate(episodes):
        end = begin + episode.length
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [schema.task],
            "length": episode.length,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": begin,
            "dataset_to_index": end,
        }
        if schema.format != "exact":
            for name in schema.images:
                row[f"videos/{name}/chunk_index"] = 0
                row[f"videos/{name}/file_index"] = 0
                row[f"videos/{name}/from_timestamp"] = begin / schema.fps
                row[f"videos/{name}/to_timestamp"] = end / schema.fps
        for name, values in stats[number].items():
            row |= {f"stats/{name}/{stat}": value.tolist() for stat, value in values.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for name, value in row.items():
            rows.setdefault(name, []).append(value)
        begin = end
    path = folder / EPISODES_PATH.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pydict(rows), path)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([schema.task], name="task"))
    tasks.to_parquet(folder / TASKS_PATH)
    info = {
        "codebase_version": "v3.0",
        "fps": schema.fps,
        "features": features,
        "total_episodes": len(episodes),
        "total_frames": begin,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": DATA_PATH,
        "video_path": None if schema.format == "exact" else VIDEO_PATH,
        "robot_type": schema.robot_type,
        "splits": {"train": f"0:{len(episodes)}"},
    }
    write_json(folder / INFO_PATH, info)
    write_json(folder / STATS_PATH, lists(aggregate(list(stats))))


def write_json(path: Path, value: object) -> None:
    """As LeRobot writes its JSON files."""
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False), encoding="utf-8")


def lists(stats: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, object]]:
    """Statistics as JSON has them."""
    return {name: {stat: value.tolist() for stat, value in one.items()} for name, one in stats.items()}


# -- videos -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Encoder:
    """How a video is encoded: the fields of LeRobot's ``RGBEncoderConfig``, and what they mean to the codec."""

    codec: str
    pix_fmt: str
    options: dict[str, str]
    fields: dict[str, Any]


ENCODERS = {
    "video": Encoder(  # LeRobot's default
        "libsvtav1",
        "yuv420p",
        {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "fast-decode=0:lp=1"},
        {"g": 2, "crf": 30, "preset": 12, "fast_decode": 0, "video_backend": "pyav", "extra_options": {}},
    ),
    # B-frames would be stored in another order than they are shown in; readers jump to single frames.
    "video_near_lossless": Encoder(
        "h264",
        "yuv444p",
        {"g": "2", "crf": "0", "threads": "1", "bf": "0"},
        {
            "g": 2,
            "crf": 0,
            "preset": None,
            "fast_decode": 0,
            "video_backend": "pyav",
            "extra_options": {"bf": 0},
        },
    ),
}


def _video_info(path: Path, schema: Schema) -> dict[str, Any]:
    """What LeRobot keeps about a video in ``info.json``."""
    import av

    info: dict[str, Any] = {}
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        info |= {
            "video.height": stream.height,
            "video.width": stream.width,
            "video.codec": stream.codec.canonical_name,
            "video.pix_fmt": stream.pix_fmt,
            "video.fps": schema.fps,
            "video.channels": 3,
            "has_audio": False,
        }
    fields = ENCODERS[schema.format].fields
    return info | {f"video.{name}": value for name, value in fields.items()} | {"is_depth_map": False}


def encode_video(path: Path, images: Sequence[np.ndarray], schema: Schema) -> None:
    """Writes the episodes' images, one after the other, as one video.

    Args:
        path: The mp4 file.
        images: For each episode (T, H, W, 3) uint8.
        schema: Gives frame rate and format.
    """
    import av

    encoder = ENCODERS[schema.format]
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = images[0].shape[1:3]
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(encoder.codec, schema.fps, options=dict(encoder.options))
        stream.pix_fmt, stream.width, stream.height = encoder.pix_fmt, width, height
        stream.time_base = Fraction(1, schema.fps)
        before = _realtime_threads()
        stream.codec_context.open(strict=False)
        # SVT-AV1, run by root, makes its threads and the one that calls it realtime: all else would stand still.
        for thread in _realtime_threads() - before:
            with suppress(ProcessLookupError):  # it has ended
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        time = 0
        for episode in images:
            for image in episode:
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts, frame.time_base = time, Fraction(1, schema.fps)
                container.mux(stream.encode(frame))
                time += 1
        container.mux(stream.encode())


def _realtime_threads() -> set[int]:
    """Threads of this process that run before all others until they wait; none where that is not known."""
    if not hasattr(os, "sched_getscheduler") or not THREADS.is_dir():
        return set()
    found = set()
    for thread in (int(one.name) for one in THREADS.iterdir()):
        with suppress(ProcessLookupError):
            if os.sched_getscheduler(thread) == os.SCHED_FIFO:
                found.add(thread)
    return found


def check_video(path: Path, frames: int, fps: int) -> None:
    """Decodes a video and compares the number of its frames and their times with what was written.

    Raises:
        UserError: They differ: the encoder lost frames.
    """
    import av

    times: list[float | None] = []
    with av.open(str(path)) as container:
        times += [frame.time for frame in container.decode(video=0)]
    if len(times) != frames:
        raise UserError(f"{path.name}: {frames} frames were written, {len(times)} can be read back")
    late = [i for i, time in enumerate(times) if time is None or abs(time - i / fps) > 0.1 / fps]
    if late:
        raise UserError(f"{path.name}: frame {late[0]} is at {times[late[0]]} s instead of {late[0] / fps} s")
