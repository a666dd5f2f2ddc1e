"""Going on from a checkpoint as if there had been no interruption."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from franka_wm import processes
from franka_wm.console import say
from franka_wm.data.image_storage import CHANNELS, OVERFLOW
from franka_wm.data.lerobot.provenance import (
    DYNAMICS,
    LOOKS,
    MEANING,
    VIEWS,
    as_typed,
    other_options,
    other_scene,
)
from franka_wm.errors import UserError
from franka_wm.options import leaves
from franka_wm.seeding import derive_seed
from franka_wm.training.checkpoint import Checkpoint
from franka_wm.training.history import read_rows
from franka_wm.training.moment import draw_anew, go_on_drawing, put_back, restorable, same_worlds
from franka_wm.training.settings import RunSettings
from franka_wm.training.shards import own_experience, own_moment
from franka_wm.training.storage_budget import fill
from franka_wm.training.trainer import GATHERED_WITH, Trainer
from franka_wm.training.tree import damaged

OTHER_DEVICE = (
    "the checkpoint is of another kind of device: random numbers start anew; this run will not be the same"
)

CUT_SHORT = ("next", "truncated")
"""Kept by runs that export, not by older ones."""


def restore(trainer: Trainer, checkpoint: Checkpoint) -> None:
    """Goes on from a checkpoint as if there had been no interruption, on the CPU to the bit.

    Weights, optimiser, counters, history, experience, worlds, plans, policies, recorded windows and all random
    numbers are put back. What cannot be is said in a line: experience that the checkpoint was too large for, and
    worlds of other libraries or of a changed configuration, which start new episodes.

    Of another number of processes worlds and experience are divided anew; random numbers of policies and losses start
    anew. Of another number of worlds (``collector.num_envs``) neither is taken over.
    """
    env, learner, settings = trainer.env, trainer.learner, trainer.settings
    with damaged(checkpoint.folder):
        checkpoint.load_model(trainer.model)
        checkpoint.load_optimizer(learner.optimizer)
        learner.use_rates()
        learner.updates = int(checkpoint.counters["updates"])
        trainer.env_steps = int(checkpoint.counters["env_steps"])
        trainer.seconds = checkpoint.counters["seconds"]
        trainer.rows = read_rows(checkpoint)
        there, here = (one["collector"]["num_envs"] for one in (checkpoint.config, settings.values))
        fits = env is None or there == here
        experience = own_experience(checkpoint, env.device) if env is not None and fits else None
        if experience is not None:
            _tell_other_environment(trainer, checkpoint)
            fill(
                trainer.replay,
                _fitting(trainer, experience),
                settings,
                updates=learner.updates,
                restored=True,
            )
        elif env is not None and learner.updates < settings.trainer.updates:
            why = "holds no experience" if fits else f"is of collector.num_envs={there}, this run has {here}"
            say(f"  the checkpoint {why}: this run gathers anew and will not be the same")
        if (
            trainer.acting is not None
        ):  # what is not put back below must not draw the run's first numbers again
            again = derive_seed("policies", settings.seed, "resumed", learner.updates, *processes.parts())
            draw_anew(trainer.acting.policies, again)
        if fits:
            _restore_moment(trainer, checkpoint, own_moment(checkpoint))
        else:
            _begin_new_episodes(trainer)
        if checkpoint.processes == processes.count():
            checkpoint.restore_rng(processes.rank())  # the last: whatever is built draws
        else:
            say(
                f"  the checkpoint is of {checkpoint.processes} processes, here are {processes.count()}: random "
                "numbers start anew; this run will not be the same"
            )
            torch.manual_seed(derive_seed("process", settings.seed, processes.rank(), learner.updates))


def _tell_other_environment(trainer: Trainer, checkpoint: Checkpoint) -> None:
    """Says what the environment was while the checkpoint's experience was gathered, where it is another now.

    Raises:
        UserError: The run exports: a dataset is of one environment.
    """
    changed = _changed(checkpoint.config["env"], trainer.settings)
    trainer.gathered_with = list(dict.fromkeys([*gathered_with(checkpoint), *changed]))
    if not trainer.gathered_with:
        return
    gathered = f"the checkpoint's experience was gathered with {', '.join(trainer.gathered_with)}"
    if trainer.settings.export.kind != "none":
        leave = "leave env as it was, or add export.kind=none" if changed else "add export.kind=none"
        raise UserError(
            f"export={trainer.settings.export.kind}: {gathered}, and a dataset is of one environment; {leave}"
        )
    say(f"  {gathered}; it stays in the replay beside what is gathered now, as earlier points in curves")


def gathered_with(checkpoint: Checkpoint) -> list[str]:
    """What was other, as one types it, in environments in which experience was gathered that the run went on from.

    Raises:
        UserError: Something else stands in its place.
    """
    with damaged(checkpoint.folder, "extra.json"):
        return [str(one) for one in (checkpoint.extra() or {}).get(GATHERED_WITH) or []]


def _changed(before: Mapping[str, Any], settings: RunSettings) -> list[str]:
    """What of the environment gives transitions another meaning than they had with ``before``, as one types it."""
    if not settings.is_arm:
        there, here = (leaves(one, "env") for one in (before, settings.values["env"]))
        names = sorted(name for name in {*there, *here} if there.get(name) != here.get(name))
        return [f"{name}={as_typed(there.get(name))}" for name in names]
    arm = settings.env.arm
    env = {**vars(arm), "urdf_path": settings.env.urdf_path}
    names = (*MEANING, *DYNAMICS, *((*VIEWS, *LOOKS) if arm.images else ()), "episode_length")
    session = {"config": {"env": before}}
    changed = [f"env.{name}={value}" for name, value in other_options([session], env, names).items()]
    return changed + ["another env.scene"] * other_scene([session], env, images=bool(arm.images), moves=True)


def _fitting(trainer: Trainer, experience: TensorDictBase) -> TensorDictBase:
    """What of saved experience (worlds, time) this run gathers, too.

    Raises:
        ValueError, KeyError: An entry is missing, or of another type or size; it would be noticed much later.
    """
    assert trainer.env is not None
    gathered = trainer.env.fake_tensordict()
    if CUT_SHORT in trainer.kept and CUT_SHORT not in experience.keys(True):  # of an older run
        experience = experience.clone(recurse=False)
        experience.set(CUT_SHORT, torch.zeros_like(experience.get(("next", "terminated"))))
        say(
            "export: of the steps before this resume nothing says which episodes were cut short; those will be missing"
        )
    if OVERFLOW in trainer.kept and OVERFLOW not in experience.keys(True):  # of an earlier version
        experience = experience.clone(recurse=False)
        experience.set(OVERFLOW, torch.zeros_like(experience.get(("next", "terminated"))))
    for key in trainer.kept:
        if key not in experience.keys(True):
            name = key if isinstance(key, str) else ".".join(map(str, key))
            options = "the model's options" if key in trainer.model.replay_keys else "the options of export"
            raise UserError(
                f"the checkpoint's experience has no {name}, which this run keeps; leave {options} as they were then"
            )
    experience = experience.select(*trainer.kept)
    for key in trainer.kept:
        saved, like = (
            experience.get(key),
            gathered.get(key, None),
        )  # a model's own entries come from its policy
        if not isinstance(saved, Tensor) or (like is not None and saved.dtype != like.dtype):
            raise ValueError(f"experience of {key} is {saved.dtype}")
        if like is None:
            continue
        sizes = [like.shape[1:]]
        if like.ndim == 4 and trainer.settings.env.frame_stack > 1:  # of stacked images the newest is kept
            sizes.append(torch.Size((*like.shape[1:-1], CHANNELS)))
        if saved.shape[2:] not in sizes:
            raise ValueError(f"experience of {key} is of shape {tuple(saved.shape)}")
    return experience


def _restore_moment(trainer: Trainer, checkpoint: Checkpoint, moment: Mapping[str, Any]) -> None:
    env = trainer.env
    if env is None:
        for name, part in {"windows": trainer.replay, "validation": trainer.validation}.items():
            if part is not None and name in moment and not part.set_state(moment[name]):
                say(f"  {OTHER_DEVICE}")
        return
    assert trainer.acting is not None
    worlds = moment.get("worlds")
    if worlds is not None and same_worlds(checkpoint.config, trainer.settings.values):
        put_back(env, trainer.collect(), worlds)
    else:
        if restorable(env) is None:
            why = "the simulators of other libraries cannot be put back"
        else:
            why = "of another configuration" if worlds is not None else "the checkpoint holds none"
        say(f"  worlds: {why}; they start new episodes, and this run will not be the same")
        _begin_new_episodes(trainer)
    if not go_on_drawing(trainer.acting.policies, moment.get("policies", {}), env.device):
        say(f"  {OTHER_DEVICE}")


def _begin_new_episodes(trainer: Trainer) -> None:
    """Seeds worlds for episodes that the run has not seen before."""
    assert trainer.env is not None
    # Worlds of the arm are told apart by their numbers, those of other libraries by the seed alone.
    apart = processes.parts() if restorable(trainer.env) is None else ()
    trainer.env.set_seed(derive_seed("training", trainer.settings.seed, "resumed", trainer.env_steps, *apart))
