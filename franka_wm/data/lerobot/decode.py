"""Rows and frames of a LeRobot dataset into plain arrays, front to back.

Run in worker processes, ``python -m franka_wm.data.lerobot.decode``: neither torch nor LeRobot is imported here, and
unlike with ``multiprocessing`` the user's script is not either. A worker reads one job per line (JSON) from its
standard input, answers with one line, and ends with its input, so none outlives the program that started it.

Every job writes its own rows of arrays that lie in files, and counts how often each was written, so that a frame too
few or too many cannot go unnoticed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.data.lerobot.png import decode_image
from franka_wm.errors import UserError
from franka_wm.untrusted import MOST_PIXELS

ROWS_AT_A_TIME = 64


@dataclass(frozen=True)
class TableJob:
    """Some row groups of a parquet file.

    Attributes:
        path: The file.
        groups: Row groups to read.
        numbers: Feature → [(array's name, first column, size)]: where its values go.
        images: Feature → [(array's name, height, width)].
        folder: Where the arrays are; ``episodes.npy`` among them says which rows are whose.
    """

    path: str
    groups: list[int]
    numbers: dict[str, list[tuple[str, int, int]]]
    images: dict[str, list[tuple[str, int, int]]]
    folder: str

    def run(self) -> int:
        """Reads them; returns the number of rows."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        arrays = _Arrays(self.folder)
        starts, lengths = arrays["episodes"].T[:2]
        done = 0
        try:
            with pq.ParquetFile(self.path) as file:
                columns = ["episode_index", "frame_index", *self.numbers, *self.images]
                for batch in file.iter_batches(ROWS_AT_A_TIME, row_groups=self.groups, columns=columns):
                    rows = self._rows(batch, starts, lengths)
                    for feature, places in self.numbers.items():
                        values = self._values(batch, feature, places[0][2])
                        for name, first, size in places:
                            target = arrays[name]
                            if target.ndim == 1:
                                target[rows] = values[:, 0]
                            else:
                                target[rows, first : first + size] = values
                    for feature, places in self.images.items():
                        cells = batch.column(feature)
                        for row, cell in zip(rows, cells, strict=True):
                            image = self._image(cell.as_py(), feature)
                            for name, height, width in places:
                                arrays[name][row] = resized(image, height, width)
                    arrays.mark("table", rows)
                    done += len(rows)
        except (pa.ArrowException, OSError, KeyError) as error:
            raise UserError(f"{self.path} cannot be read: {error}; copy or download it again") from error
        arrays.flush()
        return done

    def _rows(self, batch: Any, starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        episode, frame = (
            batch.column(name).to_numpy(zero_copy_only=False) for name in ("episode_index", "frame_index")
        )
        if episode.dtype.kind not in "iu" or frame.dtype.kind not in "iu":
            raise UserError(f"{self.path}: episode_index or frame_index are no whole numbers in every row")
        inside = (episode >= 0) & (episode < len(starts))
        inside[inside] &= (frame[inside] >= 0) & (frame[inside] < lengths[episode[inside]])
        if not inside.all():
            at = int(np.argmin(inside))
            raise UserError(
                f"{self.path}: a row of episode {episode[at]}, frame {frame[at]} that meta/episodes does not know"
            )
        return starts[episode] + frame

    def _values(self, batch: Any, feature: str, size: int) -> np.ndarray:
        import pyarrow.compute as pc

        column = batch.column(feature)
        flat, even = column, True
        while hasattr(flat, "flatten") and hasattr(flat.type, "value_type"):
            even = even and len(pc.call_function("list_value_length", [flat]).unique()) <= 1
            flat = flat.flatten()
        values = flat.to_numpy(zero_copy_only=False)
        if (
            not even
            or column.null_count
            or values.dtype.kind not in "fiub"
            or values.size != len(column) * size
        ):
            raise UserError(f"{self.path}: {feature} should have {size} numbers in every row and has not")
        values = values.reshape(len(column), size)
        with np.errstate(over="ignore"):  # a number that float32 cannot hold is none either
            finite = np.isfinite(values.astype(np.float32)).all(1)
        if values.dtype.kind == "f" and not finite.all():
            episode = batch.column("episode_index")[int(np.argmin(finite))]
            raise UserError(
                f"{self.path}: {feature} holds a number that is not finite, in episode {episode}; delete the episode "
                "(lerobot-edit-dataset)"
            )
        return values

    def _image(self, cell: Any, feature: str) -> np.ndarray:
        data = cell.get("bytes") if isinstance(cell, dict) else cell
        if not isinstance(data, bytes):
            raise UserError(
                f"{self.path}: {feature} holds no image but a path; embed the images (LeRobot's own writer does)"
            )
        try:
            return decode_image(data)
        except ValueError as error:
            raise UserError(f"{self.path}: an image of {feature} cannot be decoded: {error}") from error


@dataclass(frozen=True)
class VideoJob:
    """One video file.

    Attributes:
        path: The file.
        feature: Its feature.
        fps: Frames per second of the dataset.
        episodes: Those in this file.
        begins: When each starts in the file [s].
        targets: [(array's name, height, width)].
        folder: Where the arrays are; ``episodes.npy`` among them says which rows are whose.
    """

    path: str
    feature: str
    fps: float
    episodes: list[int]
    begins: list[float]
    targets: list[tuple[str, int, int]]
    folder: str

    def run(self) -> int:
        """Decodes it; returns the number of frames."""
        from av.error import FFmpegError
        from av.video.reformatter import VideoReformatter

        arrays = _Arrays(self.folder)
        row_at = self._row_at(arrays["episodes"][self.episodes])
        total = len(row_at)
        # One for all frames: it keeps the conversion's tables.
        reformatter = VideoReformatter()
        seen: list[int] = []
        frames = 0
        try:
            for frame, time in video_frames(self.path):
                frames += 1
                row = row_at.get(round(time * self.fps))
                if row is None:
                    continue
                image = reformatter.reformat(frame, format="rgb24").to_ndarray()
                for name, height, width in self.targets:
                    arrays[name][row] = resized(image, height, width)
                seen.append(row)
        except (FFmpegError, OSError, IndexError) as error:
            raise UserError(
                f"{self.path} cannot be decoded ({error}); copy it again, or record it with frames of at most "
                f"{MOST_PIXELS:,} pixels"
            ) from error
        if frames != total:
            raise UserError(
                f"{self.path} has {frames} frames, its episodes have {total} rows: the encoder dropped or added "
                "frames, so images and rows no longer belong together; record it again"
            )
        if len(set(seen)) != total:
            raise UserError(
                f"{self.path}: {total - len(set(seen))} of {total} rows have no frame at their time; "
                f"is it really recorded at {self.fps:g} frames per second?"
            )
        arrays.mark(self.feature, np.asarray(seen))
        arrays.flush()
        return frames

    def _row_at(self, episodes: np.ndarray) -> dict[int, int]:
        """Number of a frame in the file → row in the arrays."""
        out: dict[int, int] = {}
        for (row, length), begin in zip(episodes[:, :2], self.begins, strict=True):
            first = round(begin * self.fps)
            for k in range(int(length)):
                if first + k in out:
                    raise UserError(
                        f"{self.path}: two episodes claim frame {first + k}; meta/episodes and the video disagree"
                    )
                out[first + k] = int(row) + k
        return out


def video_frames(path: str | Path) -> Iterator[tuple[Any, float]]:
    """The frames of a video with their times [s]. None has more than :data:`MOST_PIXELS` pixels.

    Raises:
        UserError: Frames are larger, or have no time.
        av.error.FFmpegError, OSError, IndexError: It cannot be decoded, or is no video.
    """
    import av

    def check(width: int, height: int) -> None:
        if width * height > MOST_PIXELS:
            raise UserError(
                f"{path} has frames of {width} × {height} pixels, the most is {MOST_PIXELS:,}; record it smaller"
            )

    # A frame of a few bytes may fill the memory as it is decoded. Decoders round sizes up before they compare.
    bound = {"max_pixels": str(2 * MOST_PIXELS)}
    with av.open(str(path), options=bound) as container:
        stream = container.streams.video[0]
        check(stream.width, stream.height)
        stream.thread_type = "AUTO"
        stream.codec_context.options = bound
        for frame in container.decode(stream):
            check(frame.width, frame.height)
            if frame.pts is None or stream.time_base is None:
                raise UserError(f"{path}: a frame without a time")
            yield frame, float(frame.pts * stream.time_base)


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8 at another size (bilinear, averaging when it shrinks), or as it is if that is its size."""
    if image.shape[:2] == (height, width):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))


class _Arrays:
    """The cache's arrays, opened when first written."""

    def __init__(self, folder: str):
        self.folder = Path(folder)
        self._open: dict[str, np.memmap] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._open:
            opened = np.lib.format.open_memmap(self.folder / f"{name}.npy", mode="r+")
            self._open[name] = opened
        return self._open[name]

    def mark(self, what: str, rows: np.ndarray) -> None:
        filled = self[filled_name(what)]
        np.add.at(filled, rows, 1)

    def flush(self) -> None:
        for array in self._open.values():
            array.flush()


def filled_name(what: str) -> str:
    """The array that counts how often each row was filled from a file of ``what``."""
    return "filled." + what.replace("/", "_")


def to_line(job: TableJob | VideoJob) -> str:
    """A job as one line for a worker."""
    return json.dumps({"kind": type(job).__name__, **asdict(job)}) + "\n"


def row_groups(path: Path, rows: int) -> Sequence[tuple[tuple[int, ...], int]]:
    """Row groups of a parquet file in portions of about ``rows`` rows, with the number of rows in each."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        facts = pq.read_metadata(path)
    except (pa.ArrowException, OSError) as error:
        raise UserError(f"{path} cannot be read: {error}; copy or download it again") from error
    out: list[tuple[tuple[int, ...], int]] = []
    groups: list[int] = []
    count = 0
    for group in range(facts.num_row_groups):
        groups.append(group)
        count += facts.row_group(group).num_rows
        if count >= rows:
            out.append((tuple(groups), count))
            groups, count = [], 0
    if groups:
        out.append((tuple(groups), count))
    return out


def work() -> None:
    """A worker's loop: a job per line in, ``{"done": rows}`` or ``{"error": text}`` per line out."""
    kinds = {"TableJob": TableJob, "VideoJob": VideoJob}
    for line in sys.stdin:
        values = json.loads(line)
        try:
            answer: dict[str, object] = {"done": kinds[values.pop("kind")](**values).run()}
        except UserError as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    work()
