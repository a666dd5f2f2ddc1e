"""Where a run will write: whether it can, what it finds there, and a lock so that no other run does the same."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from franka_wm import files
from franka_wm.errors import UserError
from franka_wm.options import leaves
from franka_wm.training.checkpoint import latest_checkpoint
from franka_wm.training.settings import plain
from franka_wm.untrusted import UntrustedFolder
from franka_wm.versions import FINISHED

SMALL_FILES = 65536
"""Room for a run's configuration and first lines, which are written before there is anything to lose [bytes]."""


OF_FILES = ("urdf_path", "file", "parts")
"""Fields of an environment, and of what stands in a scene, that name a file."""


def unwritable(folder: Path, option: str = "hydra.run.dir") -> str | None:
    """Why ``folder`` cannot be made or written, in one line; ``None`` if it can. Leaves nothing behind."""
    why = files.unwritable(folder, SMALL_FILES)
    return why and f"{option}={folder}: {why}; choose another place for the results"


def occupied(folder: Path, resume: str | None) -> str | None:
    """Why a run may not write into ``folder``: another one's weights are there, or a dataset; ``None`` if it may.

    A run that goes on from there may.
    """
    place = folder.resolve()
    if resume is not None and place in (Path(resume).resolve(), *Path(resume).resolve().parents):
        return None
    if (place / "meta" / "info.json").exists():
        return f"hydra.run.dir={folder}: a dataset is there; choose another folder"
    try:
        found = latest_checkpoint(place)
    except UserError:  # there is none
        return None
    return (
        f"hydra.run.dir={folder}: a run has left its weights there ({found}); go on with it by resume={folder}, or "
        "choose another folder"
    )


def left_by(folder: Path, cfg: DictConfig) -> str | None:
    """What a job of a sweep finds of itself: ``"finished"``, ``"begun"`` with weights to go on from, or ``None``.

    Args:
        folder: The job's.
        cfg: Its configuration as it was typed: with ``device=spread`` whichever GPU it had is right.

    Raises:
        UserError: The weights there are those of other settings.
    """
    try:
        latest_checkpoint(folder)
    except UserError:  # there is none
        return None
    there = leaves(UntrustedFolder(folder).yaml("config.yaml"))
    cfg = cfg.copy()
    make_absolute(cfg)  # as the run wrote it
    here = leaves(plain(cfg))
    if here.get("device") == "spread" and str(there.get("device")).startswith("cuda:"):
        here["device"] = there["device"]
    other = next((k for k in {**here, **there} if k != "resume" and here.get(k) != there.get(k)), None)
    if other is not None:
        raise UserError(
            f"{folder} holds a run of other settings: {other} is {there.get(other)} there and {here.get(other)} here; "
            "choose another folder with hydra.run.dir=…, or that of a sweep with hydra.sweep.dir=…"
        )
    return "finished" if (folder / FINISHED).is_file() else "begun"


def make_absolute(node: DictConfig | ListConfig) -> None:
    """Names the files of robots and meshes of the user's own as from any folder.

    Else another folder would have no such file, or another one by that name.
    """
    for key in list(node) if isinstance(node, DictConfig) else range(len(node)):
        value: Any = None if OmegaConf.is_interpolation(node, key) else node[key]
        if isinstance(value, DictConfig | ListConfig):
            make_absolute(value)
        elif key in OF_FILES and isinstance(value, str) and os.path.isfile(path := os.path.expanduser(value)):
            node[key] = os.path.abspath(path)  # pyright: ignore[reportArgumentType]


_LOCKS: list[IO[str]] = []  # open files: their locks last as long as the process


def lock_run_dir(folder: Path) -> None:
    """Locks a run's folder for as long as this process lives, so that no two runs write into one.

    Raises:
        UserError: Another run is writing there.
    """
    file = (folder / ".lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise UserError(
            f"another run is writing into {folder}; choose a folder with hydra.run.dir=…"
        ) from error
    _LOCKS.append(file)
