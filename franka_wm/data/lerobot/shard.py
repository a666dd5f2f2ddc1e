"""One shard: some episodes in memory become one small LeRobot dataset on disk.

LeRobot's recorder takes one frame at a time, through a PNG file on disk for each, and rewrites its metadata and
video after every episode. Here all episodes are there at once, so each file is written once, by what LeRobot's own
classes would have put into it; the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.episodes import Episode
from franka_wm.data.lerobot.pictures import encode_png
from franka_wm.data.lerobot.schema import DONE, Schema
from franka_wm.data.lerobot.stats import episode_stats
from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER, write_terminals
from franka_wm.errors import UserError

FILES = {"chunk_index": 0, "file_index": 0}
"""A shard has one file of each kind."""


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
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata.create(
        repo_id=folder.name,
        fps=schema.fps,
        features=schema.features,
        robot_type=schema.robot_type,
        root=folder,
        use_videos=schema.format != "exact",
    )
    meta.save_episode_tasks([schema.task])
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
    if schema.format != "exact":
        for name in schema.images:
            video = folder / meta.info.video_path.format(video_key=name, **FILES)  # pyright: ignore[reportOptionalMemberAccess]
            encoder = encode_video(video, [one[name] for one in columns], schema)
            check_video(video, begin, schema.fps)
            meta.update_video_info(name, video_encoder=encoder)
    _write_rows(folder / meta.info.data_path.format(**FILES), meta.features, columns)
    _write_meta(meta, schema, episodes, stats)
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


def _write_rows(path: Path, features: dict[str, Any], columns: Sequence[dict[str, np.ndarray]]) -> None:
    """One row group for each episode, as LeRobot writes it: readers of single episodes skip the others."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    arrow = get_hf_features_from_features(features).arrow_schema
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, arrow, compression="snappy", use_dictionary=True) as writer:
        for one in columns:
            arrays = [_arrow(one[field.name], field.type) for field in arrow]
            writer.write_table(pa.Table.from_arrays(arrays, schema=arrow))


def _arrow(array: np.ndarray, kind: Any) -> Any:
    import pyarrow as pa

    if array.dtype == np.uint8 and array.ndim == 4:
        data = pa.array([encode_png(picture) for picture in array], pa.binary())
        names = pa.array([f"frame-{i:06d}.png" for i in range(len(array))], pa.string())
        return pa.StructArray.from_arrays([data, names], fields=list(kind))
    if array.ndim == 1:
        return pa.array(array, kind)
    flat = pa.array(np.ascontiguousarray(array).reshape(-1), kind.value_type)
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(flat, type=kind)
    offsets = np.arange(0, array.size + 1, array.shape[1], dtype=np.int32)
    return pa.ListArray.from_arrays(offsets, flat, type=kind)


def _write_meta(
    meta: Any, schema: Schema, episodes: Sequence[Episode], stats: Sequence[dict[str, dict[str, np.ndarray]]]
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq
    from lerobot.datasets.compute_stats import aggregate_stats
    from lerobot.datasets.io_utils import write_info, write_stats
    from lerobot.datasets.utils import DEFAULT_EPISODES_PATH

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
                row |= {f"videos/{name}/{index}": 0 for index in FILES}
                row[f"videos/{name}/from_timestamp"] = begin / schema.fps
                row[f"videos/{name}/to_timestamp"] = end / schema.fps
        for name, values in stats[number].items():
            row |= {f"stats/{name}/{stat}": value.tolist() for stat, value in values.items()}
        row |= {f"meta/episodes/{index}": 0 for index in FILES}
        for name, value in row.items():
            rows.setdefault(name, []).append(value)
        begin = end
    path = meta.root / DEFAULT_EPISODES_PATH.format(**FILES)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pydict(rows), path)
    meta.info.total_episodes = len(episodes)
    meta.info.total_frames = begin
    meta.info.total_tasks = 1
    meta.info.splits = {"train": f"0:{len(episodes)}"}
    write_info(meta.info, meta.root)
    write_stats(aggregate_stats(list(stats)), meta.root)


# -- pictures -----------------------------------------------------------------------------------------------


def encoder_config(schema: Schema) -> Any:
    """LeRobot's encoder settings for the schema's video format."""
    from lerobot.configs.video import RGBEncoderConfig

    if schema.format == "video":
        return RGBEncoderConfig()
    # B-frames would come out in another order than they were shown in; readers jump to single frames.
    return RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0, extra_options={"bf": 0})


def encode_video(path: Path, pictures: Sequence[np.ndarray], schema: Schema) -> Any:
    """Writes the episodes' pictures, one after the other, as one video; returns the encoder's settings.

    Args:
        path: The mp4 file.
        pictures: For each episode (T, H, W, 3) uint8.
        schema: Gives frame rate and format.
    """
    import av

    config = encoder_config(schema)
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pictures[0].shape[1:3]
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(
            config.vcodec, schema.fps, options=config.get_codec_options(1, as_strings=True)
        )
        stream.pix_fmt, stream.width, stream.height = config.pix_fmt, width, height
        stream.time_base = Fraction(1, schema.fps)
        time = 0
        for episode in pictures:
            for picture in episode:
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                frame.pts, frame.time_base = time, Fraction(1, schema.fps)
                container.mux(stream.encode(frame))
                time += 1
        container.mux(stream.encode())
    return config


def check_video(path: Path, frames: int, fps: int) -> None:
    """Decodes a video and compares the number of its frames and their times with what was written.

    Raises:
        UserError: They differ: the encoder lost frames.
    """
    import av

    with av.open(str(path)) as container:
        times = [frame.time for frame in container.decode(video=0)]
    if len(times) != frames:
        raise UserError(f"{path.name}: {frames} frames were written, {len(times)} can be read back")
    late = [i for i, time in enumerate(times) if time is None or abs(time - i / fps) > 0.1 / fps]
    if late:
        raise UserError(f"{path.name}: frame {late[0]} is at {times[late[0]]} s instead of {late[0] / fps} s")
