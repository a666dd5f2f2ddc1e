"""The checkpoint's manifest: what was written, by name, size and SHA-256, so that damage is found before it is read."""

import hashlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from franka_wm.errors import UserError
from franka_wm.files import sync
from franka_wm.training.tree import write_json
from franka_wm.untrusted import UntrustedFolder
from franka_wm.version import __version__

FORMAT_VERSION = 1
MANIFEST = "manifest.json"
ALWAYS = {"config.yaml", "counters.json", "model.safetensors"}
"""Files of every checkpoint; the trees of published ones are fewer."""


class Manifest(NamedTuple):
    """What a checkpoint's manifest says.

    Attributes:
        model: class name of the model that was saved.
        files: name of every other file → `bytes` and `sha256`.
        written_by: version of the package that saved the model.
        processes: how many have saved it, each its part.
    """

    model: str
    files: Mapping[str, Mapping[str, Any]]
    written_by: str | None
    processes: int = 1

    def check_size(self, folder: Path, name: str) -> None:
        """Raise a `UserError` unless the file is there and as long as it was written."""
        expected = self.files[name]["bytes"]
        path = UntrustedFolder(folder).path(name)
        if path is None:
            raise UserError(f"checkpoint {folder} is damaged: {name} is missing; use another checkpoint.")
        actual = path.stat().st_size
        if actual != expected:
            raise UserError(
                f"checkpoint {folder} is damaged: {name} has {actual} bytes, {expected} were written; "
                "copy it again or use another checkpoint."
            )

    def check_sum(self, folder: Path, name: str) -> None:
        """Raise a `UserError` if the manifest has the file, with other content than there is."""
        if name in self.files and _sha256(folder / name) != self.files[name]["sha256"]:
            raise UserError(
                f"checkpoint {folder} is damaged: {name} has the right size but other content than was written; "
                "copy it again or use another checkpoint."
            )

    def check_same(self, folder: Path) -> None:
        """Raise a `UserError` if the run has saved another checkpoint in its place since."""
        try:
            there = read_manifest(folder)
        except UserError:  # just now one takes the place of the other
            there = None
        if there != self:
            raise UserError(
                f"checkpoint {folder}: its run has saved a newer one in its place meanwhile; start again, or copy the "
                "folder first"
            )


def write_manifest(
    folder: Path,
    model: str,
    *,
    written_by: str | None = __version__,
    saved_at_ns: int | None = None,
    processes: int | None = None,
) -> None:
    """Write the manifest of all files of `folder`, and make sure that they have reached the disk.

    Args:
        model: class name of the model.
        written_by: version of the package that saved it.
        saved_at_ns: when that was [ns]; now if None.
        processes: how many have saved it; not said if None.
    """
    files = sorted(folder.iterdir())
    for path in files:
        sync(path)
    manifest = {
        "format_version": FORMAT_VERSION,
        "franka_wm": written_by,
        "model": model,
        "saved_at_ns": time.time_ns() if saved_at_ns is None else saved_at_ns,
        "files": {p.name: {"bytes": p.stat().st_size, "sha256": _sha256(p)} for p in files},
    }
    if processes is not None:
        manifest["processes"] = processes
    write_json(folder / MANIFEST, manifest)
    sync(folder / MANIFEST)
    sync(folder)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a checkpoint.

    Raises:
        UserError: it cannot be read, or has another format.
    """
    try:
        manifest = UntrustedFolder(folder).json(MANIFEST) or {}
        version, model, files = manifest["format_version"], manifest["model"], dict(manifest["files"])
        if not all(
            isinstance(one["bytes"], int) and isinstance(one["sha256"], str) and Path(name).name == name
            for name, one in files.items()
        ):
            raise ValueError("files")
        if not files.keys() >= ALWAYS or not isinstance(model, str):
            raise ValueError("files")
        said = sum(name.startswith("rng") and name.endswith(".json") for name in files)
        processes = manifest.get("processes", max(1, said))  # earlier versions did not say it
        if type(processes) is not int or processes < 1 or processes > max(1, said):
            raise ValueError("processes")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"checkpoint {folder} is damaged: {MANIFEST} cannot be read ({type(error).__name__}); "
            "use another checkpoint."
        ) from error
    if version != FORMAT_VERSION:
        raise UserError(
            f"checkpoint {folder} has format version {version}, this franka_wm {__version__} reads "
            f"{FORMAT_VERSION}; use the franka_wm that wrote it ({manifest.get('franka_wm', 'unknown')})."
        )
    return Manifest(model, files, manifest.get("franka_wm"), processes)


def saved_at(folder: Path) -> int:
    """Time of saving [ns]; a damaged manifest counts as the oldest."""
    try:
        return int((UntrustedFolder(folder).json(MANIFEST) or {})["saved_at_ns"])
    except (ValueError, KeyError, TypeError, OverflowError):
        return -1


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
