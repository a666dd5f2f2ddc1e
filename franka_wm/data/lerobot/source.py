"""A LeRobot dataset as it lies on disk: found, read as far as its metadata, and refused in one line."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from franka_wm.errors import UserError

DEFAULT_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DEFAULT_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


@dataclass(frozen=True, eq=False)
class Source:
    """A LeRobot v3 dataset: where its E episodes are, without a row or a picture read.

    Attributes:
        root: Its folder.
        info: ``meta/info.json``.
        lengths: (E,) int64, rows of each episode.
        data_files: (E, 2) int64, chunk and file of each episode's rows.
        video_files: Feature → (E, 2) int64, chunk and file of each episode's frames.
        video_starts: Feature → (E,) float64, when each episode starts in its file [s].
    """

    root: Path
    info: dict[str, Any]
    lengths: np.ndarray
    data_files: np.ndarray
    video_files: dict[str, np.ndarray]
    video_starts: dict[str, np.ndarray]

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """Every column: its ``dtype``, ``shape`` and ``names``."""
        return self.info["features"]

    def data_path(self, chunk: int, file: int) -> Path:
        """The parquet file of these numbers."""
        return self._path("data_path", DEFAULT_DATA_PATH, chunk_index=chunk, file_index=file)

    def video_path(self, feature: str, chunk: int, file: int) -> Path:
        """The video file of these numbers."""
        return self._path(
            "video_path", DEFAULT_VIDEO_PATH, video_key=feature, chunk_index=chunk, file_index=file
        )

    def fingerprint(self) -> str:
        """A hash of ``meta/info.json`` and of the path, size and time of change of every file."""
        digest = hashlib.sha256((self.root / "meta" / "info.json").read_bytes())
        for folder in ("meta", "data", "videos"):
            for path in sorted((self.root / folder).rglob("*")):
                if path.is_file():
                    facts = path.stat()
                    name = path.relative_to(self.root).as_posix()
                    digest.update(f"\n{name} {facts.st_size} {facts.st_mtime_ns}".encode())
        return digest.hexdigest()

    def check_files(self, videos: Sequence[str]) -> None:
        """Refuses the dataset if a file of rows, or of frames of ``videos``, is missing."""
        paths = [self.data_path(*numbers) for numbers in unique_files(self.data_files)]
        for feature in videos:
            paths += [self.video_path(feature, *n) for n in unique_files(self.video_files[feature])]
        missing = [path for path in paths if not path.is_file()]
        if missing:
            raise UserError(
                f"{self.root}: {len(missing)} of {len(paths)} files are missing, {missing[0].relative_to(self.root)} "
                "among them; copy or download the dataset again"
            )

    def _path(self, name: str, default: str, **numbers: int | str) -> Path:
        template = self.info.get(name) or default
        try:
            relative = PurePosixPath(template.format(**numbers))
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise UserError(f"{self.root}: {name}={template!r} in meta/info.json makes no path") from error
        if relative.is_absolute() or ".." in relative.parts:
            raise UserError(f"{self.root}: {name}={template!r} in meta/info.json leaves the dataset")
        return self.root / relative


def unique_files(numbers: np.ndarray) -> list[tuple[int, int]]:
    """The different rows of (E, 2), in order."""
    return [(int(chunk), int(file)) for chunk, file in np.unique(numbers, axis=0)]


def read_source(root: str | Path) -> Source:
    """Reads the metadata of the dataset in the folder ``root``.

    Raises:
        UserError: If there is none, it is of another version, holds no episodes, or was not finished.
    """
    root = Path(root).expanduser()
    info_path = root / "meta" / "info.json"
    if not root.is_dir():
        raise UserError(f"dataset.root={root}: no such folder")
    if not info_path.is_file():
        raise UserError(
            f"dataset.root={root}: no LeRobot dataset, meta/info.json is missing; give the folder that holds meta/"
        )
    try:
        info = json.loads(info_path.read_text())
        version, features, fps = str(info["codebase_version"]), info["features"], float(info["fps"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{info_path} cannot be read ({type(error).__name__}: {error})") from error
    if not version.startswith("v3"):
        raise UserError(
            f"{root} is in LeRobot's format {version}; v3 is read. Convert it with "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=…"
        )
    if not isinstance(features, dict) or not fps > 0:
        raise UserError(f"{info_path}: features or fps={fps} make no sense")
    if not info.get("total_episodes"):
        raise UserError(f"{root} holds 0 episodes; record some first")
    videos = [name for name, feature in features.items() if feature.get("dtype") == "video"]
    table = _episodes(root, videos)
    order = np.argsort(table["episode_index"], kind="stable")
    if not np.array_equal(table["episode_index"][order], np.arange(info["total_episodes"])):
        raise UserError(
            f"{root}: meta/info.json tells of {info['total_episodes']} episodes, meta/episodes of {len(order)}; "
            "the program that wrote it was probably killed"
        )
    lengths = table["length"][order].astype(np.int64)
    if (lengths < 1).any() or int(lengths.sum()) != info.get("total_frames"):
        raise UserError(
            f"{root}: meta/info.json tells of {info.get('total_frames')} frames, its episodes of {lengths.sum()}"
        )

    def files(name: str) -> np.ndarray:
        return np.stack([table[f"{name}/chunk_index"], table[f"{name}/file_index"]], 1)[order].astype(
            np.int64
        )

    return Source(
        root=root,
        info=info,
        lengths=lengths,
        data_files=files("data"),
        video_files={name: files(f"videos/{name}") for name in videos},
        video_starts={name: table[f"videos/{name}/from_timestamp"][order] for name in videos},
    )


def _episodes(root: Path, videos: Sequence[str]) -> dict[str, np.ndarray]:
    """The columns of ``meta/episodes`` that say where rows and frames are."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    for name in videos:
        columns += [f"videos/{name}/{c}" for c in ("chunk_index", "file_index", "from_timestamp")]
    paths = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    if not paths:
        raise UserError(f"{root}: meta/episodes is empty; the program that wrote it was probably killed")
    try:
        tables = [pq.ParquetFile(path).read(columns=columns) for path in paths]
        return {c: np.concatenate([t[c].to_numpy() for t in tables]) for c in columns}
    except (pa.ArrowException, OSError, KeyError) as error:
        raise UserError(
            f"{root}: meta/episodes cannot be read ({error}); the program that wrote it was probably killed"
        ) from error


def find_dataset(repo_id: str, revision: str | None = None) -> Path:
    """The folder of a dataset on the Hub: LeRobot's own copy if there is one, otherwise downloaded.

    Raises:
        UserError: If it is neither here nor can be fetched.
    """
    from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE

    here = Path(HF_LEROBOT_HOME) / repo_id
    if revision is None and (here / "meta" / "info.json").is_file():
        return here
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import (
        HfHubHTTPError,
        HFValidationError,
        LocalEntryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        folder = snapshot_download(
            repo_id, repo_type="dataset", revision=revision or "v3.0", cache_dir=HF_LEROBOT_HUB_CACHE
        )
    except HFValidationError as error:
        raise UserError(f"dataset.repo_id={repo_id!r}: must look like user/name") from error
    except LocalEntryNotFoundError as error:
        how = "HF_HUB_OFFLINE is set" if os.environ.get("HF_HUB_OFFLINE") else "the Hub cannot be reached"
        raise UserError(
            f"dataset.repo_id={repo_id}: not on this machine, and {how}; give dataset.root=FOLDER instead"
        ) from error
    except RevisionNotFoundError as error:
        raise UserError(
            f"dataset.repo_id={repo_id}: has no tag {revision or 'v3.0'} on the Hub; it is in an older format, or was "
            "published without its tag"
        ) from error
    except (HfHubHTTPError, OSError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else ""
        raise UserError(
            f"dataset.repo_id={repo_id}: cannot be fetched ({type(error).__name__}: {reason})"
        ) from error
    return Path(folder)
