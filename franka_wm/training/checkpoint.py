"""Checkpoints: one folder, written whole or not at all, read without pickle.

    manifest.json           format version, model name, size and SHA-256 of every other file; written last
    config.yaml             the resolved configuration
    counters.json           environment steps, updates, ...
    model.safetensors       weights and buffers
    optimizer.json          structure of the optimizers' state; its tensors are in optimizer.safetensors
    rng.json                likewise: torch (CPU, CUDA), NumPy, Python
    replay.json             likewise: the filled part of the replay buffer
    extra.json              likewise: whatever else the caller wants back
    replay1.json, …         of a run of several processes: the parts of process 1 and those that follow

**Replacing a checkpoint.** A folder cannot replace a non-empty folder in one system call, so it takes three steps:
write and sync `NAME.writing`; rename `NAME` to `NAME.old`; rename `NAME.writing` to `NAME`. A kill between the renames
leaves no `NAME`, but a whole `NAME.old`, which `load_checkpoint(NAME)` then reads. It is removed once there is `NAME`.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors import SafetensorError
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from franka_wm.conf import use_present_names
from franka_wm.errors import UserError
from franka_wm.files import sync
from franka_wm.options import is_real
from franka_wm.seeding import random_state, restore_random_state
from franka_wm.training.manifest import MANIFEST, Manifest, read_manifest, saved_at, write_manifest
from franka_wm.training.optimizer_state import load_optimizer_state, optimizer_state
from franka_wm.training.tree import (
    damaged,
    first_difference,
    nested,
    only_tensors,
    read_tensors,
    read_tree,
    save_tensors,
    tree_files,
    write_json,
    write_tree,
)
from franka_wm.untrusted import UntrustedFolder

FIRST_STAGE = "pretrained"
"""Folder of the first stage, in that of its run."""

WRITING = ".writing"
"""What the name of a checkpoint ends in until it is whole."""
_OLD = ".old"


# -- saving ----------------------------------------------------------------------------------------------


def save_checkpoint(
    folder: str | Path,
    *,
    model: nn.Module,
    config: Mapping[str, object],
    counters: Mapping[str, int | float],
    optimizer: Optimizer | None = None,
    replay: TensorDictBase | None = None,
    extra: Mapping[str, object] | None = None,
    others: Callable[[], int | None] = lambda: 1,
) -> Path:
    """Write a checkpoint; an existing one at the same place is replaced, and is whole until it is.

    The state of the random number generators (torch, NumPy, Python) is always saved along.

    Args:
        folder: where the checkpoint will be. Missing parents are made.
        model: on any device.
        config: plain values, nested.
        counters: numbers by name, such as `env_steps` and `updates`.
        optimizer: whose state goes along.
        replay: the filled part of the buffer, tensors only, any batch dimensions.
        extra: nested dicts, lists and tuples of numbers, strings, None and tensors (a `torch.Generator`'s
            state, say).
        others: called when only the parts of other processes are missing, see :mod:`franka_wm.training.shards`;
            returns how many processes there are.

    Returns:
        The folder, absolute.

    Raises:
        UserError: the folder cannot be written, or something there is not a checkpoint. Nothing
            half-written stays behind.
        TypeError: a value that cannot be stored without pickle.
    """
    target = Path(folder).resolve()
    writing = sibling(target, WRITING)
    with explained(target):
        # Renaming would fail only after everything has been written; this is the place to say it.
        if (target.exists() and not target.is_dir()) or (
            target.is_dir() and not (target / MANIFEST).exists() and any(target.iterdir())
        ):
            raise UserError(f"{target} exists and is not a checkpoint; choose another folder or remove it.")
        target.parent.mkdir(parents=True, exist_ok=True)
        if writing.exists():  # an earlier process was killed while it wrote
            shutil.rmtree(writing)
        writing.mkdir()
        try:
            _write_contents(writing, model, optimizer, config, counters, replay, extra)
            write_manifest(writing, type(model).__name__, processes=others())
            _swap_in(writing, target)
        except Exception:
            shutil.rmtree(writing, ignore_errors=True)
            raise
    return target


def _write_contents(
    folder: Path,
    model: nn.Module,
    optimizer: Optimizer | None,
    config: Mapping[str, object],
    counters: Mapping[str, int | float],
    replay: TensorDictBase | None,
    extra: Mapping[str, object] | None,
) -> None:
    save_tensors(_tensor_state(model), folder / "model.safetensors")
    if optimizer is not None:
        write_tree(folder, "optimizer", optimizer_state(optimizer))
    write_tree(folder, "rng", random_state())
    if replay is not None:
        write_tree(folder, "replay", replay_tree(replay))
    if extra is not None:
        write_tree(folder, "extra", extra)
    OmegaConf.save(OmegaConf.create(dict(config)), folder / "config.yaml")
    write_json(folder / "counters.json", {name: _plain_number(name, n) for name, n in counters.items()})


def _swap_in(writing: Path, target: Path) -> None:
    """Put the whole folder `writing` at `target`. See the module's docstring for what a kill leaves."""
    old = sibling(target, _OLD)
    if target.exists():
        if old.exists():
            shutil.rmtree(old)
        os.rename(target, old)
    try:
        os.rename(writing, target)
    except OSError:
        if old.exists() and not target.exists():
            os.rename(old, target)
        raise
    sync(target.parent)
    # What matters is in place; a leftover here is removed by the next save.
    shutil.rmtree(old, ignore_errors=True)


# -- loading ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on disk that has been found whole. Tensors are read when they are asked for.

    Attributes:
        folder: where it was read from.
        config: the resolved configuration, plain.
        counters: the numbers that were saved.
    """

    folder: Path
    config: dict[str, Any]
    counters: dict[str, int | float]
    _manifest: Manifest

    @property
    def model_name(self) -> str:
        """Class name of the model that was saved."""
        return self._manifest.model

    def load_model(self, model: nn.Module) -> None:
        """Copy the saved weights and buffers into `model`, in place, whatever device it is on.

        Raises:
            UserError: the model is another one. Its weights are then untouched.
        """
        saved = self.check_model(model)
        broken = next((name for name, x in saved.items() if not bool(x.isfinite().all())), None)
        if broken is not None:
            raise UserError(
                f"checkpoint {self.folder}: its weights {broken} are not finite; use another checkpoint."
            )
        # Entries that are no tensors (TensorDictParams keeps its batch size there) are the model's own.
        model.load_state_dict({**model.state_dict(), **saved})

    def check_model(self, model: nn.Module) -> dict[str, Tensor]:
        """The saved weights, if they fit into `model`, of which only shapes matter.

        Raises:
            UserError: the model is another one.
        """
        saved = read_tensors(self.folder, "model")
        self._manifest.check_same(self.folder)
        difference = first_difference(saved, _tensor_state(model))
        if difference is not None:
            raise UserError(
                f"checkpoint {self.folder} holds a {self.model_name} that does not fit this "
                f"{type(model).__name__}: {difference}; build the model from the checkpoint's config.yaml, "
                "or leave out the options that change it."
            )
        return saved

    def load_optimizer(self, optimizer: Optimizer) -> None:
        """Give `optimizer` the saved state; it goes on exactly where the saved one stopped.

        How the optimizer runs (`fused`, `capturable`, `foreach`), and its options but for the learning rate, stay
        as it was built. State tensors are new objects afterwards: load before a CUDA graph is captured, not after.

        Raises:
            UserError: another optimizer, or for other parameters. It is then not changed.
        """
        saved = self._tree("optimizer")
        if saved is None:
            raise UserError(
                f"checkpoint {self.folder} was saved without an optimizer; start a new run from its weights."
            )
        with damaged(self.folder, "optimizer.json"):
            load_optimizer_state(saved, optimizer, f"checkpoint {self.folder}")

    @property
    def processes(self) -> int:
        """How many processes have saved it."""
        return self._manifest.processes

    def restore_rng(self, rank: int = 0) -> None:
        """Set torch's (CPU and CUDA), NumPy's and Python's global generators to their saved states.

        CUDA states are restored for the devices that are there; of several processes, each has one.
        """
        state = self._tree(_part("rng", rank))
        with damaged(self.folder, "rng.json"):
            restore_random_state(state)

    def replay(
        self, device: torch.device | str | None = None, rank: int | Sequence[int] | None = None
    ) -> TensorDict | None:
        """The saved replay, with its batch dimensions, on `device` (the CPU if None); None if none was saved.

        Args:
            rank: only what this process had, or these; None: all of them, one behind the other.

        Raises:
            UserError: its file is damaged.
        """
        some = [rank] if isinstance(rank, int) else range(self.processes) if rank is None else rank
        found = [self._replay(k) for k in some]
        if len(whole := [one for one in found if one is not None]) < len(found):
            return None
        with damaged(self.folder, "one of its replays"):
            joined: Any = whole[0] if len(whole) == 1 else torch.cat(whole)  # pyright: ignore[reportArgumentType]
        return joined.to(device or "cpu")

    def _replay(self, rank: int) -> TensorDict | None:
        # By far the largest file, and evaluation never opens it: its checksum waits until here.
        name = _part("replay", rank)
        for file in tree_files(name):
            self._manifest.check_sum(self.folder, file)
        saved = self._tree(name)
        if saved is None:
            return None
        with damaged(self.folder, f"{name}.json"):
            return only_tensors(saved["entries"], saved["batch_size"], "cpu")

    def moment(self, rank: int = 0) -> dict[str, Any]:
        """Where worlds, policies and samplers of a process stood; empty if that was not saved."""
        saved = (self.extra() or {}).get("moment") if rank == 0 else self._tree(f"moment{rank}")
        return saved or {}

    def extra(self) -> dict[str, Any] | None:
        """What was saved as `extra`, tensors on the CPU; None if nothing was."""
        return self._tree("extra")

    def _tree(self, name: str) -> Any:
        if f"{name}.json" not in self._manifest.files:
            return None
        tree = read_tree(self.folder, name)
        self._manifest.check_same(self.folder)
        return tree


def load_checkpoint(folder: str | Path) -> Checkpoint:
    """Open a checkpoint folder and check that it is whole.

    If saving was killed between its two renames, the previous checkpoint is opened.

    Raises:
        UserError: no checkpoint, a damaged or truncated one, or one from a newer version of this package.
    """
    path = _find(Path(folder).resolve())
    if path is None:
        raise UserError(
            f"no checkpoint at {folder}: a checkpoint is a folder with a {MANIFEST}; "
            "give the folder that a training run wrote."
        )
    manifest = read_manifest(path)
    for name in manifest.files:
        manifest.check_size(path, name)
    for name in manifest.files:
        if not name.startswith("replay"):
            manifest.check_sum(path, name)
    return Checkpoint(path, _read_config(path), _read_counters(path), manifest)


def _read_config(path: Path) -> dict[str, Any]:
    written = UntrustedFolder(path).yaml("config.yaml")  # of a size that can be, and without aliases
    if not isinstance(written, dict):
        raise UserError(
            f"checkpoint {path} is damaged: config.yaml holds no configuration; use another checkpoint."
        )
    with damaged(path, "config.yaml"):
        # Saved configurations are resolved; reading one `${oc.env:…}` would take secrets from this machine.
        if "${" in json.dumps(written, default=str):
            raise UserError(
                f"checkpoint {path}: its config.yaml holds an interpolation (${{…}}), which no run writes; "
                "use another checkpoint."
            )
        try:
            config = OmegaConf.load(path / "config.yaml")
            assert isinstance(config, DictConfig)
            use_present_names(config)
            plain: Any = OmegaConf.to_container(config, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise ValueError(str(error)) from error
    return plain


def _read_counters(path: Path) -> dict[str, int | float]:
    found = UntrustedFolder(path).json("counters.json") or {}
    for name, number in found.items():
        if not is_real(number) or not 0 <= number < 2**63:
            raise UserError(
                f"checkpoint {path} is damaged: {name}={number!r} in counters.json; use another checkpoint."
            )
    return found


def latest_checkpoint(folder: str | Path) -> Path:
    """The checkpoint that was written last in a run's folder, or `folder` itself if it is one.

    Looks at `folder`, at the folders in it, and at those in its `checkpoints/`; if there is none, at those of the run's
    first stage.

    Raises:
        UserError: there is none.
    """
    run = Path(folder).resolve()
    if _find(run) is not None:
        return run
    places = [run, run / "checkpoints"]
    # A run that ended in its first stage has a checkpoint of that one alone.
    found = _found(places) or _found([run / FIRST_STAGE / "checkpoints"])
    if not found:
        raise UserError(
            f"no checkpoint in {folder}: expected a checkpoint (a folder with a {MANIFEST}) or a run's "
            "folder that holds one; give a folder that a training run wrote."
        )
    return max(found)[1]


def _found(places: Sequence[Path]) -> list[tuple[int, Path]]:
    """Time of saving and name of every checkpoint in some folders."""
    inside = [entry for place in places if place.is_dir() for entry in place.iterdir() if entry.is_dir()]
    # A NAME.old that lost its NAME to a kill stands for NAME.
    names = {p.with_name(p.name.removesuffix(_OLD)) for p in inside if not p.name.endswith(WRITING)}
    return [(saved_at(whole), name) for name in names if (whole := _find(name)) is not None]


# -- parts of the state ------------------------------------------------------------------------------------


def _tensor_state(model: nn.Module) -> dict[str, Tensor]:
    return {name: value for name, value in model.state_dict().items() if isinstance(value, Tensor)}


def _part(name: str, rank: int) -> str:
    return name if rank == 0 else f"{name}{rank}"


def replay_tree(replay: TensorDictBase) -> dict[str, object]:
    """Experience as nested values."""
    return {"batch_size": list(replay.batch_size), "entries": nested(replay)}


def _plain_number(name: str, value: int | float) -> int | float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    raise TypeError(f"counter {name} is a {type(value).__name__}; counters are int or float")


# -- files -------------------------------------------------------------------------------------------------


def sibling(folder: Path, suffix: str) -> Path:
    """What stands beside a checkpoint while it is written, or replaced."""
    return folder.with_name(folder.name + suffix)


def _find(folder: Path) -> Path | None:
    """`folder` if it is a checkpoint, else its predecessor that a killed save has moved aside, else None."""
    candidates: Sequence[Path] = (folder, sibling(folder, _OLD))
    return next((path for path in candidates if (path / MANIFEST).is_file()), None)


@contextmanager
def explained(target: Path) -> Iterator[None]:
    """Turn what the file system refuses into one line for the user."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise UserError(
            f"cannot write checkpoint {target}: {error}; choose a folder that you may write to, "
            "on a disk with room."
        ) from error
