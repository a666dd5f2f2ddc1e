"""Whether experience fits: into memory, before a run starts; onto the disk, where it must not cost the weights."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.data.memory import free_memory
from franka_wm.data.replay import WindowReplay
from franka_wm.device import resolve_device
from franka_wm.errors import UserError
from franka_wm.keys import CONTEXT
from franka_wm.models import WorldModel
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces

BETWEEN = 2e9
"""Up to so much experience [bytes] goes into checkpoints while a run goes on: writing tens of GB takes minutes."""

KEPT = 8e9
"""Up to so much [bytes] goes into the last one unless all of it is asked for: a GPU gathers more of it in seconds."""

SPARE = 5e8
"""What must stay free on the disk [bytes], for the weights and for what else a run writes."""


PER_WORLD = 1e4
"""Memory of a simulated world at the very least [bytes]."""


def check_worlds(option: str, worlds: int, device: torch.device | str) -> None:
    """Refuse worlds that cannot fit into the memory that is free, before the first is built.

    Raises:
        UserError: It names the option.
    """
    device = resolve_device(device)
    free = free_memory(device)
    if free is not None and worlds * PER_WORLD > free:
        raise UserError(
            f"{option}={worlds}: at least {worlds * PER_WORLD / 1e9:.1f} GB do not fit into the {free / 1e9:.1f} GB "
            f"that are free on {device}; lower it"
        )


def check_memory(run: RunSettings, model: WorldModel, spaces: Spaces) -> None:
    """Refuse what cannot fit into the memory that is free, before anything of it is built.

    Only what is known beforehand is counted, and little of that: a run that passes may still not fit.

    Args:
        model: Only its shapes matter, and what it reads: experience is that alone, each image once.
        spaces: Sizes of observations and actions.

    Raises:
        UserError: It names the options of the largest part.
    """
    device = resolve_device(run.device)
    free = free_memory(device)
    if free is None:
        return
    c, e, r = run.collector, run.evaluation, run.replay
    seen = _bytes(spaces)
    kept = model if run.export.kind == "none" else spaces  # a dataset is for other models, too
    step = _bytes(kept, stack=run.env.frame_stack)
    step += 4 * getattr(model, "latent_dim", 0) if CONTEXT in model.replay_keys else 0
    planned = math.prod(run.planner.options.get(name, 1) for name in ("num_samples", "horizon"))
    steps = c.num_envs * run.planned_steps() if device.type != "cuda" else r.capacity
    if device.type == "cpu":
        try:  # memory is used as steps come, but some systems refuse what is larger than all of it
            torch.empty(step * r.capacity, dtype=torch.uint8)
        except (RuntimeError, TypeError) as error:  # the latter beyond 64 bits
            raise UserError(_not_allocated(run, step, device)) from error
    played = -(-e.episodes // run.parts)
    film = min(e.video_episodes, e.episodes) * run.env.episode_length * 3 * e.video_size**2
    parts = {
        "the model and its optimiser (model, size)": 16 * sum(x.numel() for x in model.parameters()),
        f"experience ({_capacity(run)})": step * min(r.capacity, steps),
        f"a batch (replay.batch_size={r.batch_size * run.parts})": _bytes(model)
        * r.batch_size
        * (run.burn_in + run.window),
        f"worlds (collector.num_envs={c.num_envs * run.parts})": c.num_envs
        * (PER_WORLD + seen * c.steps_per_batch),
        f"worlds (evaluation.episodes={e.episodes})": played * (PER_WORLD + seen),
        "plans (planner.num_samples, planner.horizon)": 4 * played * planned * max(spaces.action_dim, 1),
        f"a video (evaluation.video_size={e.video_size})": film,
    }
    needed = sum(parts.values())
    if needed > free:
        name, most = max(parts.items(), key=lambda part: part[1])
        raise UserError(
            f"{name}: at least {most / 1e9:.1f} GB{run.on_each}, of {needed / 1e9:.1f} GB in all, do not fit into the "
            f"{free / 1e9:.1f} GB that are free on {device}; lower it"
        )


def _bytes(of: Spaces | WorldModel, stack: int = 1) -> int:
    """Observations of one step; of stacked images one, if ``stack`` are."""
    images = ((math.prod(size), key.startswith("pixels")) for key, size in of.image_sizes.items())
    return 4 * sum(of.observation_sizes.values()) + sum(n // stack if stacked else n for n, stacked in images)


def fill(
    replay: WindowReplay, batch: TensorDictBase, run: RunSettings, *, updates: int = 0, restored: bool = False
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
    per_step = storage.bytes_per_step(batch)
    steps = run.replay.capacity
    if device.type != "cuda":
        ahead = run.collector.num_envs * run.planned_steps(updates)
        steps = min(steps, ahead + (batch.numel() if restored else 0))
    free = free_memory(device)
    if free is not None and per_step * steps > free:
        raise UserError(
            f"{_capacity(run)}: {per_step * steps / 1e9:.1f} GB of experience{run.on_each} "
            f"({per_step / 1e3:.1f} kB a step) do not fit into the {free / 1e9:.1f} GB that are free on {device}; "
            f"at most replay.capacity={int(0.9 * free / per_step) * run.parts} would, less what learning needs"
        )
    try:
        replay.extend(batch)
        if restored:  # worlds are put back, and may look a little different on another device
            replay.following.forget()
    except RuntimeError as error:  # some systems refuse what is larger than all memory, used or not
        if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in str(error):
            raise
        raise UserError(_not_allocated(run, per_step, device)) from error


def _capacity(run: RunSettings) -> str:
    """That of all processes, as it was typed."""
    return f"replay.capacity={run.values['replay']['capacity']}"


def _not_allocated(run: RunSettings, per_step: float, device: torch.device) -> str:
    return (
        f"{_capacity(run)}: {per_step * run.replay.capacity / 1e9:.1f} GB{run.on_each} cannot be allocated on "
        f"{device}; use a smaller replay.capacity"
    )


def filled_bytes(replay: WindowReplay) -> int:
    """Bytes of the filled part of a replay as a checkpoint holds it: with both images of each step."""
    storage: Any = replay.storage
    filled, data = storage._len_along_dim0, storage._storage
    whole = data.bytes() + sum(data.get(key).nbytes for key in storage.images)
    return whole * filled // data.shape[0]


def reason_to_leave_out(size: int, folder: Path, *, last: bool, wanted: bool | None) -> str | None:
    """Why a checkpoint in ``folder`` is written without ``size`` bytes of experience, in a line; ``None``: it is not.

    Args:
        size: Size of the experience [bytes].
        folder: Folder of the run; need not exist yet.
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
