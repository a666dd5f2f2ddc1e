"""A trained agent from a checkpoint alone: its model, and an environment and policies to judge it with."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict.nn import TensorDictModuleBase

from franka_wm import conf
from franka_wm.device import resolve_device
from franka_wm.envs import Environment, FrankaConfig
from franka_wm.errors import UserError
from franka_wm.options import did_you_mean, preset_of_ones_own
from franka_wm.training import build
from franka_wm.training.check import idle_objective_options, sketch
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces
from franka_wm.training.tree import damaged

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

HUB = "hf:"


@dataclass
class Agent:
    """What a checkpoint holds, ready to act.

    Attributes:
        folder: Folder of the checkpoint.
        settings: Those it was trained with; ``device`` is the one in use now.
        env: Evaluation worlds.
        model: In evaluation mode.
        policies: By name, as :func:`franka_wm.training.build.make_policies` makes them.
        counters: ``updates``, ``env_steps``, ``seconds``.
    """

    folder: Path
    settings: RunSettings
    env: Environment
    model: WorldModel
    policies: dict[str, TensorDictModuleBase]
    counters: dict[str, float]


def load_agent(
    folder: str | Path | Checkpoint,
    *,
    num_envs: int | None = None,
    device: torch.device | str = "auto",
    env_changes: Mapping[str, Any] | None = None,
    seed: int | None = None,
    planned_by: str | None = None,
    searchpath: Sequence[str] = (),
    planning: Mapping[str, Mapping[str, Any]] | None = None,
) -> Agent:
    """Rebuilds environment, model, planner and policies from a checkpoint.

    Args:
        folder: A run's folder, a checkpoint in it, ``hf:user/name``, or what ``find_checkpoint`` found.
        num_envs: Evaluation worlds; the configuration's ``evaluation.episodes`` if not given.
        device: ``auto``, ``cpu``, ``cuda``, ``cuda:K``.
        env_changes: Fields of the environment's configuration to change.
        seed: Seed of the environment and of random policies; the run's if not given. Planners, and a policy where
            it explores, draw from torch's generator: ``torch.manual_seed``.
        planned_by: Another planner, by its name in ``conf/planner``, as the run's scale has it; the run's if not given.
        searchpath: ``hydra.searchpath=[file://FOLDER]`` with ``planner/NAME.yaml``, for a planner of one's own.
        planning: Options of ``planner`` and ``objective`` that are other than the run's, such as
            ``{"planner": {"num_samples": 64}}``.

    Raises:
        UserError: One line: no checkpoint, a damaged one, or one whose environment cannot be built here.
    """
    checkpoint = folder if isinstance(folder, Checkpoint) else find_checkpoint(folder)
    settings = RunSettings.of(checkpoint.config, saved=True).changed(device=str(device))
    if seed is not None:
        settings = settings.changed(seed=seed)
    if planned_by is not None:
        settings = RunSettings.of(
            {**settings.values, "planner": preset_of(planned_by, settings, *searchpath)}, saved=True
        )
    if planning:
        settings = _planning_otherwise(settings, planning)
    if settings.env.kind == "none":
        raise UserError(
            f"{checkpoint.folder}: was trained on recorded data without an environment; there is nothing to act in"
        )
    if settings.is_arm and settings.is_discrete:
        require_same_actions(checkpoint, settings.env.arm)
    changes = dict(env_changes or {})
    if changes and settings.is_arm:
        _require_fit(settings, _saved_spaces(checkpoint), changes)
    model = _model(checkpoint, settings, resolve_device(settings.device))
    env = build.make_evaluation_env(settings, num_envs=num_envs, **changes)
    spaces = Spaces.of_env(env)
    policies = build.make_agent_policies(settings, model, env, spaces)
    return Agent(checkpoint.folder, settings, env, model, policies, dict(checkpoint.counters))


def preset_of(planner: str, settings: RunSettings, *searchpath: str) -> dict[str, Any]:
    """What ``planner=NAME`` would have been in this run; ``searchpath``: see :func:`load_agent`."""
    if not re.fullmatch(r"\w[\w-]*", planner):
        raise UserError(f"planner={planner}: must be the name of a planner, as franka-wm list has them")
    try:
        composed = conf.compose_or_raise(
            f"planner={planner}", f"scale={settings.values['scale']}", *searchpath
        )
    except MissingConfigException as error:
        group, name = (error.missing_cfg_file or f"planner/{planner}").rsplit("/", 1)
        there = sorted(error.options or ())
        near = did_you_mean(name, there) or preset_of_ones_own(group, name)
        raise UserError(f"{group}={name}: must be one of {', '.join(there)}{near}") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        given = " ".join((f"planner={planner}", *searchpath))
        raise UserError(f"{given}: {str(error).strip().splitlines()[0]}") from error
    found: Any = OmegaConf.to_container(composed.planner, resolve=True)
    return found


def _planning_otherwise(settings: RunSettings, planning: Mapping[str, Mapping[str, Any]]) -> RunSettings:
    """Refuses options that the run's planner and objective do not have; these would be left out like outdated ones."""
    if planning.get("objective") and settings.is_discrete:
        raise UserError(
            f"objective.{next(iter(planning['objective']))}: a tree search has no objective; leave it out"
        )
    idle = {"objective": idle_objective_options(settings)}
    for group, changes in planning.items():
        if group not in ("planner", "objective") or not isinstance(changes, Mapping):
            raise UserError(
                f"planning: {group}={changes!r}: must be options of planner or objective, such as "
                '{"planner": {"num_samples": 64}}'
            )
        unread = idle.get(group, {})
        there = [key for key in settings.values.get(group, {}) if key != "name" and key not in unread]
        for key in changes:
            if key in unread:
                raise UserError(
                    f"objective.{key}: {unread[key]}, this run has objective={settings.objective_name}; leave it out"
                )
            if key not in there:
                near = did_you_mean(key, there)
                raise UserError(
                    f"{group}.{key}: no such option of this run's {group}; there are {', '.join(there)}{near}"
                )
    return settings.changed(**planning)


def load_model(folder: str | Path, *, device: torch.device | str = "cpu") -> WorldModel:
    """The model alone, in evaluation mode.

    Args and errors: as for :func:`load_agent`.
    """
    checkpoint = find_checkpoint(folder)
    return _model(checkpoint, RunSettings.of(checkpoint.config, saved=True), resolve_device(device))


def find_checkpoint(folder: str | Path) -> Checkpoint:
    """The newest checkpoint of a folder, or of a repository on the Hub."""
    if str(folder).startswith(HUB):
        from franka_wm.data.lerobot.hub import download_model

        folder = download_model(str(folder).removeprefix(HUB))
    return load_checkpoint(latest_checkpoint(folder))


def own_episodes(checkpoint: Checkpoint) -> int:
    """By how many its run is judged at the end."""
    with damaged(checkpoint.folder, "config.yaml"):
        return int(checkpoint.config["evaluation"]["episodes"])


def require_same_actions(checkpoint: Checkpoint, config: FrankaConfig) -> None:
    """Refuses discrete actions of an earlier version, where every move of the arm let go of what the fingers held.

    Raises:
        UserError: The arm of ``config`` has another number of them than the checkpoint.
    """
    if not config.has_gripper:
        return
    saved = _saved_spaces(checkpoint).num_actions
    here = Spaces.of_config(config, discrete=True).num_actions
    if saved != here:
        raise UserError(
            f"{checkpoint.folder}: has {saved} discrete actions, of an earlier version; with a gripper there are "
            f"{here} now, each move with open and with closed fingers; train anew"
        )


def _require_fit(settings: RunSettings, saved: Spaces, changes: dict[str, Any]) -> None:
    """Refuses changes of the arm that leave it without what the model reads, or in another size."""
    changed = settings.env.changed(**build.evaluation_changes(settings, changes))
    here = Spaces.of_config(changed.arm, discrete=settings.is_discrete)
    name = f"model={settings.model.name}"
    read = saved.only(settings.model.observations, name)
    wanted = {**read.observation_sizes, **read.image_sizes, "action": saved.action_dim or saved.num_actions}
    there = {**here.observation_sizes, **here.image_sizes, "action": here.action_dim or here.num_actions}
    for key, size in wanted.items():
        if there.get(key) != size:
            raise UserError(
                f"{name} needs {key} of size {size}, with {', '.join(f'env.{one}' for one in changes)} as given it is "
                f"{there.get(key, 'not there')}; leave that out, or train an agent with it"
            )


def _saved_spaces(checkpoint: Checkpoint) -> Spaces:
    extra = checkpoint.extra()
    saved = extra.get("spaces") if isinstance(extra, dict) else None
    if saved is None:
        raise UserError(
            f"{checkpoint.folder}: does not say what sizes its model has; it was written by an older version"
        )
    with damaged(checkpoint.folder, "extra.json"):
        return Spaces.from_dict(saved)


def _model(checkpoint: Checkpoint, settings: RunSettings, device: torch.device) -> WorldModel:
    spaces = _saved_spaces(checkpoint)
    with damaged(checkpoint.folder, "extra.json"):
        shapes = sketch(settings, spaces)
        if shapes is not None:  # before anything of the sizes that config.yaml names is allocated
            try:
                checkpoint.check_model(shapes)
            except UserError as error:
                if "does not fit this" not in str(error):  # damaged, or replaced meanwhile
                    raise
                raise UserError(
                    f"{error} That was done here: so it is of an earlier version, whose models were others; train anew"
                ) from error
        model = build.make_model(settings, spaces, device)
    checkpoint.load_model(model)
    return model.eval()
