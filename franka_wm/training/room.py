"""Whether experience fits: into memory, before a run starts; onto the disk, where it must not cost the weights."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.data.memory import free_memory
from franka_wm.data.stacks import StackStorage, newest
from franka_wm.errors import UserError
from franka_wm.training.settings import RunSettings

BETWEEN = 2e9
"""Up to so much experience [bytes] goes into checkpoints while a run goes on: writing tens of GB takes minutes."""

KEPT = 8e9
"""Up to so much [bytes] goes into the last one unless all of it is asked for: a GPU gathers more of it in seconds."""

SPARE = 5e8
"""What must stay free on the disk [bytes], for the weights and for what else a run writes."""


def fill(
    replay: Any, batch: TensorDictBase, run: RunSettings, *, updates: int = 0, restored: bool = False
) -> None:
    """Extends an empty replay by its first ``batch``, if it has room for that and for what a run will add.

    On CUDA all of ``replay.capacity`` is taken at once; on the CPU memory is used as steps come.

    Args:
        updates: That were made already.
        restored: ``batch`` is a checkpoint's, beside what the run will gather.

    Raises:
        UserError: It has no room; says how many steps would fit.
    """
    storage: Any = replay.storage
    device = torch.device(storage.device)
    kept = newest(batch, storage.stacked, storage.frame_stack) if isinstance(storage, StackStorage) else batch
    per_step = kept.bytes() / kept.numel()
    steps = run.replay.capacity
    if device.type != "cuda":
        ahead = run.collector.num_envs * run.planned_steps(updates)
        steps = min(steps, ahead + (batch.numel() if restored else 0))
    free = free_memory(device)
    if free is not None and per_step * steps > free:
        raise UserError(
            f"replay.capacity={run.replay.capacity}: {per_step * steps / 1e9:.1f} GB of experience "
            f"({per_step / 1e3:.1f} kB a step) do not fit into the {free / 1e9:.1f} GB that are free on {device}; "
            f"at most replay.capacity={int(0.9 * free / per_step)} would, less what learning needs"
        )
    try:
        replay.extend(batch)
    except RuntimeError as error:  # some systems refuse what is larger than all memory, used or not
        if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in str(error):
            raise
        raise UserError(
            f"replay.capacity={run.replay.capacity}: {per_step * run.replay.capacity / 1e9:.1f} GB cannot be allocated "
            f"on {device}; use a smaller replay.capacity"
        ) from error


def held(replay: Any) -> int:
    """Bytes that the filled part of a replay of TorchRL's holds."""
    storage = replay.storage
    filled, slots = storage._len_along_dim0, storage._storage.shape[0]
    return storage._storage.bytes() * filled // slots


def left_out(size: int, folder: Path, *, last: bool, wanted: bool | None) -> str | None:
    """Why a checkpoint in ``folder`` is written without ``size`` bytes of experience, in a line; ``None``: it is not.

    Args:
        size: Of the experience [bytes].
        folder: Of the run; need not exist yet.
        last: Whether the run ends with this checkpoint.
        wanted: ``trainer.checkpoint_replay``; ``None``: unless there is much of it.
    """
    if wanted is None and size > KEPT:
        return (
            f"checkpoint without the experience ({size / 1e9:.1f} GB): a run that goes on from it gathers anew; "
            f"trainer.checkpoint_replay=true keeps more than {KEPT / 1e9:.0f} GB"
        )
    if not last and size > BETWEEN:
        return f"checkpoint without the experience ({size / 1e9:.1f} GB), which is written at the end"
    there = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size > free - SPARE:
        return (
            f"warning: checkpoint WITHOUT the experience: {size / 1e9:.2f} GB and {SPARE / 1e9} GB of reserve do not "
            f"fit into the {free / 1e9:.2f} GB that are free ({folder}); a run that goes on from it gathers anew. "
            "Choose a folder with more room (hydra.run.dir=…), or trainer.checkpoint_replay=false"
        )
    return None
