"""A run: its folder, its configuration, the checkpoint that it goes on from, its loggers and its worlds."""

from __future__ import annotations

import fcntl
import importlib
import logging
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from franka_wm.console import announced, say
from franka_wm.data.lerobot.export import export_run
from franka_wm.device import resolve_device
from franka_wm.errors import FrankaError, UserError
from franka_wm.seeding import derive_seed, seeded
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.loggers import close_loggers, log_config, log_video, make_loggers
from franka_wm.training.spaces import Spaces
from franka_wm.versions import write_finished, write_versions

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells expect."""


def import_plugins(cfg: DictConfig) -> None:
    """Imports the modules that ``cfg.plugins`` names; they register tasks, models and planners of the user's.

    Raises:
        UserError: There is no such module.
    """
    for name in cfg.plugins:
        if str(Path.cwd()) not in sys.path:
            sys.path.insert(0, str(Path.cwd()))  # as for python -m: modules beside the one who starts the run
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise UserError(
                f"plugins: no module {error.name!r}; name modules as in `import`, from {Path.cwd()}"
            ) from error


def unwritable(folder: Path) -> str | None:
    """Why ``folder`` cannot be made or written, in one line; ``None`` if it can. Leaves nothing behind."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        return f"hydra.run.dir={folder}: {place} is not a folder; choose another place for the results"
    try:
        tempfile.TemporaryDirectory(
            dir=place
        ).cleanup()  # asking for permission is not enough: root has it everywhere
    except OSError:
        return f"hydra.run.dir={folder}: {place} is not writable; choose another place for the results"
    return None


def occupied(folder: Path, resume: str | None) -> str | None:
    """Why a run may not write into ``folder``: another one's weights are there; ``None`` if it may.

    A run that goes on from there may.
    """
    place = folder.resolve()
    if resume is not None and place in (Path(resume).resolve(), *Path(resume).resolve().parents):
        return None
    try:
        found = latest_checkpoint(place)
    except UserError:  # there is none
        return None
    return (
        f"hydra.run.dir={folder}: a run has left its weights there ({found}); go on with it by resume={folder}, or "
        "choose another folder"
    )


@dataclass
class Run:
    """One run's configuration, folder, loggers, and the checkpoint that it goes on from."""

    cfg: DictConfig
    folder: Path
    checkpoint: Any = None
    loggers: list[Any] = field(default_factory=list)
    validation: Any = None
    """Windows of recorded episodes that training never sees."""

    def build_environments(self) -> tuple[Any, Any]:
        """The training worlds and the evaluation worlds, compiled and ready; ``None`` where there are none.

        A run on recorded data trains in no world; without an environment (``env=none``) none judges it either.
        """
        if self.cfg.env.kind == "none":
            return None, None
        gathers = not build.is_offline(self.cfg)
        worlds = f"{self.cfg.evaluation.episodes} evaluation worlds"
        if gathers:
            worlds = f"{self.cfg.collector.num_envs} training and {worlds}"
        compiling = "on a machine's first start this compiles kernels for a minute or two"
        with announced(f"building {worlds}" + (f"; {compiling}" if build.is_arm(self.cfg) else "")):
            judge = build.make_evaluation_env(self.cfg)
            env = build.make_env(self.cfg) if gathers else None
            for one in (env, judge):
                if one is not None:
                    with seeded(0):  # how many worlds there are must not decide what a run draws later
                        one.step_and_maybe_reset(one.rand_action(one.reset()))
                    one.statistics()
                    one.set_seed(derive_seed("training" if one is env else "evaluation", self.cfg.seed))
        return env, judge

    def build_experience(self, env: Any) -> tuple[Any, Any]:
        """Where batches come from, and what a model must know of it: ``sample()`` and its :class:`Spaces`."""
        if not build.is_offline(self.cfg):
            hindsight = build.make_hindsight(self.cfg, env)
            return build.make_replay_buffer(self.cfg, env.device, hindsight), self.as_saved(
                Spaces.of_env(env)
            )
        windows, self.validation = build.open_recorded(self.cfg, self.device)
        spaces = Spaces(
            observation_sizes=dict(windows.observation_sizes),
            image_sizes=dict(windows.image_sizes),
            action_dim=windows.action_dim,
            num_actions=windows.num_actions,
            episode_length=windows.episode_length,
            reward_bounds=windows.reward_bounds,
            terminates=windows.terminates,
        )
        return windows, self.as_saved(spaces)

    def as_saved(self, spaces: Any) -> Any:
        """``spaces`` with what decides on a model's parts as it was when the run that this one goes on from began."""
        saved = None if self.checkpoint is None else (self.checkpoint.extra() or {}).get("spaces")
        return spaces if saved is None else replace(spaces, terminates=saved.get("terminates", False))

    @property
    def device(self) -> Any:
        """Where the run computes."""
        return resolve_device(self.cfg.device)

    def learner_options(self, cfg: DictConfig | None = None) -> dict[str, Any]:
        """Arguments of the learner; ``cfg`` is another than the run's for a first stage."""
        cfg = self.cfg if cfg is None else cfg
        trainer = cfg.trainer
        names = ("grad_clip", "capture", "compile", "precision")
        kind, warmup = build.schedule(cfg)
        return {name: trainer[name] for name in names} | {
            "lr": build.learning_rate(cfg),
            "total_updates": trainer.updates,
            "schedule": kind,
            "warmup": warmup,
        }

    def log_video(self, name: str, frames: Any, fps: int) -> None:
        """A film (T, H, W, 3) uint8 to every logger that takes films."""
        log_video(self.loggers, name, frames, fps=fps, step=self.cfg.trainer.updates)

    def stop(self) -> NoReturn:
        """The last line of a run that was interrupted and has saved; exits with 130."""
        close_loggers(self.loggers)
        say(f"stopped; go on with: python train.py resume={self.folder}")
        sys.exit(INTERRUPTED)

    def close(self) -> None:
        """Closes the loggers, and says in the run's folder that it has ended, and what it took."""
        close_loggers(self.loggers)
        write_finished(self.folder)

    def export(self, experience: Callable[[], Any]) -> None:
        """What ``export`` in the configuration asks for: the replay's whole episodes as a LeRobot dataset.

        Args:
            experience: Gives the replay, oldest step first; called only if something is exported.
        """
        if self.cfg.export.kind == "none":
            return
        export_run(build.plain(self.cfg), experience(), folder=self.folder)

    @property
    def during(self) -> dict[str, Any]:
        """What is evaluated while training: names of policies, and episodes."""
        evaluation = self.cfg.evaluation
        return {
            "names": list(evaluation.during),
            "episodes": evaluation.get("during_episodes"),  # checkpoints of earlier versions have none
        }


def start(cfg: DictConfig) -> Run:
    """Checks the configuration, takes over a checkpoint's where the run goes on from one, opens the loggers.

    Raises:
        UserError: One line, before anything is built or written.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    checkpoint = None
    import_plugins(cfg)  # those of the command line: what a checkpoint names is never imported
    if cfg.resume is not None:
        checkpoint, cfg = resumed(cfg, list(HydraConfig.get().overrides.task))
    check(cfg)
    device = resolve_device(cfg.device)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(derive_seed("weights", cfg.seed))
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    claim(folder)
    problem = occupied(folder, cfg.resume)  # also of a sweep, whose folders only Hydra knows
    if problem is not None:
        raise UserError(problem)
    OmegaConf.save(cfg, folder / "config.yaml", resolve=True)
    write_versions(folder, device)
    say(f"device {device}   seed {cfg.seed}   results in {folder}")
    return Run(cfg=cfg, folder=folder, checkpoint=checkpoint, loggers=open_loggers(cfg, folder))


_CLAIMED: list[Any] = []  # open files: their locks last as long as the process


def claim(folder: Path) -> None:
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
    _CLAIMED.append(file)


def resumed(cfg: DictConfig, overrides: list[str]) -> tuple[Any, DictConfig]:
    """The checkpoint, and its configuration with the values (not the groups) given on the command line.

    Raises:
        UserError: The command line asks for another group than the checkpoint was made with.
    """
    checkpoint = load_checkpoint(latest_checkpoint(str(cfg.resume)))
    saved = checkpoint.config
    if "whole_run" in saved:  # the checkpoint is a first stage's
        saved = OmegaConf.create(OmegaConf.to_container(saved.whole_run))
    changes = []
    for override in overrides:
        name = override.split("=", 1)[0].lstrip("+~")
        if name in ("resume", "scale", "plugins"):
            continue
        if "." not in name and name not in ("seed", "device"):
            raise FrankaError(
                f"{override}: a run that resumes keeps its {name}; leave it out, or change single values ({name}.key=…)"
            )
        changes.append(override.lstrip("+"))
    merged = OmegaConf.merge(saved, OmegaConf.from_dotlist(changes))
    assert isinstance(merged, DictConfig)
    merged.resume = str(cfg.resume)
    return checkpoint, merged


def open_loggers(cfg: DictConfig, folder: Path) -> list[Any]:
    """The loggers that ``cfg.logger`` names; each is told the configuration."""
    options = build.plain(cfg.logger)
    loggers = make_loggers(options.pop("names"), folder, **options)
    log_config(loggers, build.plain(cfg))
    return loggers
