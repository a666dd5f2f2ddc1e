"""Checkpoints of several processes: each writes its experience, and where its worlds and generators stand."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm import processes
from franka_wm.errors import UserError
from franka_wm.seeding import random_state
from franka_wm.training.checkpoint import (
    WRITING,
    Checkpoint,
    explained,
    replay_tree,
    save_checkpoint,
    sibling,
)
from franka_wm.training.tree import tree_files, write_tree


def save_together(
    folder: Path, *, replay: TensorDictBase | None, moment: Mapping[str, object], **common: Any
) -> None:
    """One checkpoint of all processes, whole or not at all; every one of them calls this.

    Args:
        folder: Where it will be.
        replay, moment: This process's own.
        common: What is the same in all of them, and what the first one alone knows: as for
            :func:`~franka_wm.training.checkpoint.save_checkpoint`.

    Raises:
        UserError: The folder cannot be written, or the first process does not see all parts.
    """

    def others() -> int:
        processes.wait()  # the folder is there
        processes.wait()  # their parts are
        _require_parts(folder, replay is not None)
        return processes.count()

    if processes.is_first():
        extra = {**common.pop("extra"), "moment": moment}
        save_checkpoint(folder, replay=replay, extra=extra, others=others, **common)
    else:
        processes.wait()
        add_part(folder, processes.rank(), replay=replay, moment=moment)
        processes.wait()
    processes.wait()  # it is whole


def _require_parts(folder: Path, with_replay: bool) -> None:
    """Waits until the first process sees all parts: what others wrote to a disk of the network may come later."""
    writing = sibling(folder.resolve(), WRITING)
    kinds = ("rng", "moment", *(["replay"] if with_replay else []))
    wanted = [(k, f) for k in range(1, processes.count()) for kind in kinds for f in tree_files(f"{kind}{k}")]
    until = time.monotonic() + processes.SOON
    while missing := [one for one in wanted if not (writing / one[1]).is_file()]:
        if time.monotonic() > until:
            k, file = missing[0]
            raise UserError(
                f"checkpoint {folder}: process 0 does not see {file}, which process {k} has written; the checkpoint "
                "before is whole: give hydra.run.dir on a disk that all hosts see"
            )
        time.sleep(0.1)


def add_part(folder: Path, rank: int, *, replay: TensorDictBase | None, moment: Mapping[str, object]) -> None:
    """Adds what process ``rank`` > 0 has of its own to the checkpoint that the first one is writing.

    Raises:
        UserError: The folder cannot be written.
    """
    writing = sibling(folder.resolve(), WRITING)
    with explained(folder.resolve()):
        write_tree(writing, f"rng{rank}", random_state())
        write_tree(writing, f"moment{rank}", moment)
        if replay is not None:
            write_tree(writing, f"replay{rank}", replay_tree(replay))


def own_experience(checkpoint: Checkpoint, device: torch.device) -> TensorDictBase | None:
    """This process's worlds of a checkpoint's experience, (worlds, time), whatever number of processes has saved it."""
    if checkpoint.processes == processes.count():
        return checkpoint.replay(device, processes.rank())
    saved, count, rank = checkpoint.processes, processes.count(), processes.rank()
    # Who has its worlds: no others are read.
    read = range(rank * saved // count, -(-(rank + 1) * saved // count))
    some = checkpoint.replay("cpu", read)
    if some is None:
        return None
    each = len(some) // len(read)
    own, before = each * saved // count, each * read[0]
    return some[rank * own - before : (rank + 1) * own - before].to(device)


def own_moment(checkpoint: Checkpoint) -> dict[str, Any]:
    """Where this process's worlds and policies stood; of another number of processes its worlds alone."""
    if checkpoint.processes == processes.count():
        return checkpoint.moment(processes.rank())
    moments = [checkpoint.moment(k) for k in range(checkpoint.processes)]
    worlds = [one.get("worlds") for one in moments]
    if any(one is None for one in worlds):  # recorded data: all processes draw from one sequence
        return {name: value for name, value in moments[0].items() if name in ("windows", "validation")}
    return {"worlds": _own(_joined(worlds))}


def _joined(trees: list[Any]) -> Any:
    """Nested values of all processes, their worlds one behind the other."""
    first = trees[0]
    if isinstance(first, Tensor):
        return torch.cat(trees)
    return {name: _joined([one[name] for one in trees]) for name in first}


def _own(tree: Any) -> Any:
    if isinstance(tree, Tensor):
        return tree.chunk(processes.count())[processes.rank()]
    return {name: _own(value) for name, value in tree.items()}
