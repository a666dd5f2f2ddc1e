"""Whether a checkpoint takes the experience along: what does not fit on the disk must not cost the weights."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

BETWEEN = 2e9
"""Up to so much experience [bytes] goes into checkpoints while a run goes on: writing tens of GB takes minutes."""

KEPT = 8e9
"""Up to so much [bytes] goes into the last one unless all of it is asked for: a GPU gathers more of it in seconds."""

SPARE = 5e8
"""What must stay free on the disk [bytes], for the weights and for what else a run writes."""


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
