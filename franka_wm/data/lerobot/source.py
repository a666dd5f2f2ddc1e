"""A LeRobot dataset as it lies on disk: found, read as far as its metadata, and refused in one line."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

import numpy as np

from franka_wm.data.lerobot.hub import explained
from franka_wm.data.lerobot.shard import DATA_PATH, VIDEO_PATH
from franka_wm.errors import UserError
from franka_wm.options import is_real, is_whole
from franka_wm.untrusted import UntrustedFolder, linked_bytes, linked_json

VERSION_TAG = "v3.0"
"""LeRobot loads the revision of this name from the Hub."""
LONGEST_PATH = 255
"""Longest template of a path [characters]."""
MOST_EPISODES, MOST_ROWS, MOST_NUMBERS = 10**8, 10**10, 10**8
"""Largest dataset, and most numbers in one cell: whatever says more is no dataset, and sizes are taken from it."""


@dataclass(frozen=True, eq=False)
class Source:
    """A LeRobot v3 dataset: where its E episodes are, without a row or an image read.

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
        return self._path("data_path", DATA_PATH, chunk_index=chunk, file_index=file)

    def video_path(self, feature: str, chunk: int, file: int) -> Path:
        """The video file of these numbers."""
        return self._path("video_path", VIDEO_PATH, video_key=feature, chunk_index=chunk, file_index=file)

    def fingerprint(self) -> str:
        """A hash of ``meta/info.json`` and of the path, size and time of change of every file."""
        digest = hashlib.sha256(linked_bytes(self.root / "meta" / "info.json"))
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
        if not isinstance(template, str) or not _is_template(template):
            raise UserError(f"{self.root}: {name}={template!r} in meta/info.json makes no path")
        relative = PurePosixPath(template.format(**numbers))
        if relative.is_absolute() or ".." in relative.parts:
            raise UserError(f"{self.root}: {name}={template!r} in meta/info.json leaves the dataset")
        return self.root / relative


def _is_template(text: str) -> bool:
    """Whether it only asks for the numbers that there are, of a width that a path may have."""
    try:
        fields = [
            (name, spec, change) for _, name, spec, change in Formatter().parse(text) if name is not None
        ]
    except ValueError:
        return False
    known = all(
        change is None
        and (
            (name in ("chunk_index", "file_index") and re.fullmatch(r"(0?\d{1,2}d)?", spec or "") is not None)
            or (name == "video_key" and not spec)
        )
        for name, spec, change in fields
    )
    return known and "\0" not in text and len(text) <= LONGEST_PATH


def unique_files(numbers: np.ndarray) -> list[tuple[int, int]]:
    """The different rows of (E, 2), in order."""
    return [(int(chunk), int(file)) for chunk, file in np.unique(numbers, axis=0)]


def read_source(root: str | Path) -> Source:
    """Reads the metadata of the dataset in the folder ``root``.

    Raises:
        UserError: If there is none, it is of another version, holds no episodes, was not finished, or links to files
            elsewhere.
    """
    root = Path(root).expanduser()
    info_path = root / "meta" / "info.json"
    if not root.is_dir():
        if (unfinished := Path(f"{root}.writing")).is_dir():
            raise UserError(
                f"dataset.root={root}: {unfinished} holds one that is not finished; franka-wm collect out={root} … "
                "resume=true finishes it"
            )
        raise UserError(f"dataset.root={root}: no such folder; franka-wm collect out=FOLDER makes one")
    if not info_path.is_file():
        raise UserError(
            f"dataset.root={root}: no LeRobot dataset, meta/info.json is missing; give the folder that holds meta/"
        )
    # A snapshot in the Hub's cache is a folder of links to where the cache keeps the files of the repository.
    home = root.absolute().parents[1] if root.absolute().parent.name == "snapshots" else root.absolute()
    UntrustedFolder(home).check_links(root.absolute().relative_to(home))
    info = linked_json(info_path)
    for name in ("codebase_version", "features", "fps"):
        if name not in info:
            raise UserError(f"{info_path} cannot be read: {name} is missing")
    version, features, fps = str(info["codebase_version"]), info["features"], info["fps"]
    if not version.startswith("v3"):
        raise UserError(
            f"{root} is in LeRobot's format {version}; v3 is read. Convert it with "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=…"
        )
    if not isinstance(features, dict) or not is_real(fps) or not 0 < fps <= 1e6:
        raise UserError(f"{info_path}: features or fps={fps!r} make no sense")
    for name, feature in features.items():
        if not _is_feature(name, feature):
            raise UserError(f"{info_path}: the feature {name!r} makes no sense: {feature!r}")
    total = info.get("total_episodes")
    if not is_whole(total) or not 0 <= total <= MOST_EPISODES:
        raise UserError(f"{info_path}: total_episodes={total!r} makes no sense")
    if not total:
        raise UserError(f"{root} holds 0 episodes; record some first")
    videos = [name for name, feature in features.items() if feature.get("dtype") == "video"]
    table = _episodes(root, videos)
    order = np.argsort(table["episode_index"], kind="stable")
    if len(order) != total or not np.array_equal(table["episode_index"][order], np.arange(total)):
        raise UserError(
            f"{root}: meta/info.json tells of {info['total_episodes']} episodes, meta/episodes of {len(order)}; "
            "the program that wrote it was probably killed"
        )
    lengths = table["length"][order].astype(np.int64)
    if (lengths < 1).any() or (lengths > MOST_ROWS).any() or int(lengths.sum()) != info.get("total_frames"):
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


def _is_feature(name: str, feature: object) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str) or "\0" in name:
        return False
    shape = feature.get("shape")
    if not isinstance(shape, list) or not all(is_whole(n) and 1 <= n <= MOST_NUMBERS for n in shape):
        return False
    return math.prod(shape) <= MOST_NUMBERS


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
        found = {c: np.concatenate([t[c].to_numpy() for t in tables]) for c in columns}
    except (pa.ArrowException, OSError, KeyError) as error:
        raise UserError(
            f"{root}: meta/episodes cannot be read ({error}); the program that wrote it was probably killed"
        ) from error
    for name, column in found.items():
        wanted = "f" if name.endswith("from_timestamp") else "iu"
        if column.dtype.kind not in wanted or not np.isfinite(column).all() or (column < 0).any():
            raise UserError(f"{root}: meta/episodes holds {name} that are no numbers of at least 0")
    return found


def check_finite(root: Path) -> None:
    """Whether every number of every step can be trained on; images are not looked at.

    Raises:
        UserError: One is not finite, or a file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    for path in sorted((root / "data").glob("*/*.parquet")):
        try:
            file = pq.ParquetFile(path)
            kinds = {field.name: field.type for field in file.schema_arrow}
            for name, kind in kinds.items():
                while hasattr(kind, "value_type"):
                    kind = kind.value_type
                if not pa.types.is_floating(kind):
                    continue
                column = file.read(columns=[name])[name].combine_chunks()
                step = np.arange(len(column))  # of each number
                while hasattr(column.type, "value_type"):
                    step = step[pc.call_function("list_parent_indices", [column]).to_numpy()]
                    column = column.flatten()
                wrong = step[~np.isfinite(column.to_numpy(zero_copy_only=False))]
                if len(wrong):
                    episode = file.read(columns=["episode_index"])["episode_index"][int(wrong[0])]
                    raise UserError(
                        f"{path}: {name} holds a number that is not finite, in episode {episode}; delete the episode "
                        "(lerobot-edit-dataset)"
                    )
        except (pa.ArrowException, OSError) as error:
            raise UserError(f"{path} cannot be read: {error}; copy or download it again") from error


def find_dataset(repo_id: str, *, meta: bool = False) -> Path:
    """The folder of a dataset on the Hub: LeRobot's own copy if there is one, otherwise downloaded.

    Args:
        repo_id: ``user/name``.
        meta: Download what it says of itself alone, no rows.

    Raises:
        UserError: If it is neither here nor can be fetched.
    """
    from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE

    here = Path(HF_LEROBOT_HOME) / repo_id
    if (here / "meta" / "info.json").is_file():
        return here
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError, RevisionNotFoundError

    with explained(f"dataset.repo_id={repo_id}"):
        try:
            folder = snapshot_download(
                repo_id,
                repo_type="dataset",
                revision=VERSION_TAG,
                cache_dir=HF_LEROBOT_HUB_CACHE,
                allow_patterns=["meta/*"] if meta else None,
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
                f"dataset.repo_id={repo_id}: has no tag {VERSION_TAG} on the Hub; it is in an older format, or was "
                "published without its tag"
            ) from error
    return Path(folder)
