"""A run: its folder, its configuration, the checkpoint that it goes on from, its loggers and its worlds."""

from __future__ import annotations

import gc
import importlib
import logging
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.record.loggers import Logger

from franka_wm import processes
from franka_wm.console import announced, log_to, resuming, say
from franka_wm.data.demonstrations import Demonstrations
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.lerobot.export import check_export_place, export_run
from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.data.replay import WindowReplay
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.envs import Environment
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.errors import UserError, trying
from franka_wm.interrupt import INTERRUPTED
from franka_wm.seeding import derive_seed, seeded
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.demos import open_demonstrations, start_along
from franka_wm.training.load import require_same_actions
from franka_wm.training.loggers import close_loggers, log_config, log_video, make_loggers
from franka_wm.training.place import lock_run_dir, make_absolute, occupied
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces
from franka_wm.training.trainer import DERIVED
from franka_wm.training.tree import damaged
from franka_wm.versions import FINISHED, write_finished, write_versions

STOPPED = "stopped.txt"
"""Says in the folder of a run that it was asked to stop; while it is there, torchrun does not begin the run again."""


def import_plugins(names: object) -> None:
    """Imports modules, those of ``plugins``; they register tasks, models and planners of the user's.

    Raises:
        UserError: These are no names, there is no such module, or it fails.
    """
    if not isinstance(names, Sequence) or isinstance(names, str) or not all(map(_names_module, names)):
        raise UserError(
            f"plugins={names}: must be a list of modules, named as in `import`: plugins=[my_tasks]"
        )
    for name in names:
        if str(Path.cwd()) not in sys.path:
            sys.path.insert(0, str(Path.cwd()))  # as for python -m: modules beside the one who starts the run
        try:
            with trying(f"plugins: {name}", ModuleNotFoundError):
                importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):  # one that it imports
                raise UserError(f"plugins: {name} fails: {error}; install it, or mend {name}") from error
            raise UserError(
                f"plugins: no module {error.name!r}, looked for in {Path.cwd()}, too; name modules as in `import`"
            ) from error


def _names_module(name: object) -> bool:
    return isinstance(name, str) and all(part.isidentifier() for part in name.split("."))


@dataclass
class Run:
    """One run's settings, folder, loggers, and the checkpoint that it goes on from."""

    settings: RunSettings
    folder: Path
    checkpoint: Checkpoint | None = None
    loggers: list[Logger] = field(default_factory=list)
    validation: RecordedWindows | None = None
    """Windows of recorded episodes that training never sees."""
    _recorded: RecordedWindows | None = None
    _shown: Demonstrations | None = None

    def build_environments(self) -> tuple[Environment | None, Environment | None]:
        """The training worlds and the evaluation worlds, compiled and ready; ``None`` where there are none.

        A run on recorded data trains in no world; without an environment (``env=none``) none evaluates it either. Of
        several processes each has as many evaluation worlds as one may have to play.
        """
        gathers = not self.settings.is_offline
        # What is wrong with the data is said before minutes go into building worlds.
        if not gathers:
            self.recorded()
        elif self.settings.is_arm:
            self.demonstrations(Spaces.of_config(self.settings.env.arm, discrete=self.settings.is_discrete))
        if self.settings.env.kind == "none":
            return None, None
        worlds = f"{self.settings.evaluation.episodes} evaluation worlds"
        if gathers:
            worlds = f"{self.settings.values['collector']['num_envs']} training and {worlds}"
        compiling = "on a machine's first start this compiles kernels for a minute or two"
        with announced(f"building {worlds}" + (f"; {compiling}" if self.settings.is_arm else "")):
            eval_env = build.make_evaluation_env(self.settings, num_envs=self._evaluation_worlds())
            own = processes.rank() * self.settings.collector.num_envs
            c = self.settings.collector
            shared: Any = {"first_world": own, "workers": c.workers, "ray": c.ray}
            env = build.make_env(self.settings, **shared) if gathers else None
            apart = () if self.settings.env.kind in ("franka", "multitask") else processes.parts()
            for one in (env, eval_env):
                if one is not None:
                    with seeded(0):  # how many worlds there are must not decide what a run draws later
                        one.step_and_maybe_reset(one.rand_action(one.reset()))
                    one.statistics()
                    of = "training" if one is env else "evaluation"
                    one.set_seed(derive_seed(of, self.settings.seed, *(apart if one is env else ())))
        return env, eval_env

    def _evaluation_worlds(self) -> int:
        """This process's; as many of several tasks, or it could not play those that follow another one's."""
        config, episodes = self.settings.env.config, self.settings.evaluation.episodes
        tasks = len(config.tasks) if isinstance(config, MultiTaskConfig) else 1
        return min(episodes, tasks * -(-episodes // (tasks * processes.count())))

    def build_experience(self, env: Environment | None) -> tuple[WindowReplay | RecordedWindows, Spaces]:
        """Where batches come from, and what a model must know of it: ``sample()`` and its :class:`Spaces`."""
        if env is not None:
            spaces = Spaces.of_env(env)
            shown = self.demonstrations(spaces)
            if self.settings.replay.demo_resets:
                assert shown is not None
                start_along(env, shown, self.settings.replay.demo_resets)
            replay = build.make_replay_buffer(self.settings, env.device, self.hindsight, shown)
            return replay, self.as_saved(spaces)
        windows = self.recorded()
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

    @cached_property
    def hindsight(self) -> Hindsight | None:
        """What gives windows other goals."""
        return build.make_hindsight(self.settings)

    def demonstrations(self, spaces: Spaces) -> Demonstrations | None:
        """The episodes that ``replay.demos`` names, for an environment of these sizes; opened once."""
        if self._shown is None:
            self._shown = open_demonstrations(self.settings, spaces, self.hindsight)
        return self._shown

    def recorded(self) -> RecordedWindows:
        """Windows to train on of the datasets that ``dataset`` names; opened once."""
        if self._recorded is None:
            self._recorded, self.validation = build.open_recorded(self.settings, self.device)
        return self._recorded

    def as_saved(self, spaces: Spaces) -> Spaces:
        """``spaces`` with what decides on a model's parts as it was when the run that this one goes on from began."""
        saved = None if self.checkpoint is None else (self.checkpoint.extra() or {}).get("spaces")
        if self.checkpoint is None or saved is None:
            return spaces
        with damaged(self.checkpoint.folder, "extra.json"):
            kept, other = spaces.as_built(Spaces.from_dict(saved))
        if other:
            say(
                f"  the model keeps what it was built for, from which discount, values and distances follow: {other}"
            )
        return kept

    @property
    def device(self) -> torch.device:
        """Where the run computes."""
        return resolve_device(self.settings.device)

    def log_video(self, name: str, frames: torch.Tensor, fps: int) -> None:
        """A film (T, H, W, 3) uint8 to every logger that takes films."""
        log_video(self.loggers, name, frames, fps=fps, step=self.settings.trainer.updates)

    def stop(self) -> NoReturn:
        """The last line of a run that was interrupted and has saved; exits with 130."""
        close_loggers(self.loggers)
        line = f"stopped; go on with: {resuming(self.folder, self.settings.values)}"
        if processes.is_first() and (processes.count() > 1 or processes.by_torchrun()):
            (self.folder / STOPPED).write_text(f"{line}\n")
        say(line)
        with suppress(UserError):  # nobody leaves before the mark is there: torchrun would end who writes it
            processes.wait()
        processes.leave(INTERRUPTED)
        sys.exit(INTERRUPTED)

    def close(self) -> None:
        """Closes the loggers."""
        close_loggers(self.loggers)

    def keep(self) -> None:
        """Keeps the folder from now on, whatever comes: training begins."""
        global _begun
        _begun = None

    def finish(self, experience: Callable[[], TensorDictBase | None]) -> None:
        """What ``export`` in the configuration asks for: the replay's whole episodes as a LeRobot dataset.

        The run's folder says then that it has ended, and what it took: a sweep leaves it alone. Each process of a job
        calls this.

        Args:
            experience: Gives the replay, oldest step first; called only if something is exported.
        """
        if self.settings.export.kind != "none":
            export_run(self.settings.values, experience(), folder=self.folder, actor=self.settings.actor)
        if processes.is_first():
            write_finished(self.folder)


def start(cfg: DictConfig) -> Run:
    """Checks the configuration, takes over a checkpoint's where the run goes on from one, opens the loggers.

    Raises:
        UserError: One line, before anything is built or written.
    """
    if not gc.isenabled():  # since the command began
        gc.freeze()  # what was imported stays
        gc.enable()
    global _begun
    told = HydraConfig.get()
    folder = Path(told.runtime.output_dir)
    # With more than Hydra's, another run has begun here at the same time.
    hydras = {".hydra", f"{told.job.name}.log"}
    _begun = (folder, _files(folder), []) if {one.name for one in folder.iterdir()} <= hydras else None
    processes.require_seen(folder, "hydra.run.dir")
    checkpoint, again = None, False
    import_plugins(cfg.plugins)  # those of the command line: what a checkpoint names is never imported
    if cfg.resume is not None:
        typed = list(told.overrides.task)
        # A job that found its own beginning in its folder goes on with the options of then.
        again = cfg.resume == str(folder) and not any(one.lstrip("+").startswith("resume=") for one in typed)
        # On the device of now: another GPU may be its turn, or there are fewer.
        checkpoint, cfg = resumed(cfg, [f"device={cfg.device}"] if again else typed)
        _require_same(checkpoint)
    make_absolute(cfg)
    settings = RunSettings.of(cfg, saved=checkpoint is not None)
    if checkpoint is not None and settings.is_arm and settings.is_discrete:
        require_same_actions(checkpoint, settings.env.arm)
    if settings != _checked:
        check(settings)
    device = resolve_device(settings.device)
    if settings.trainer.capture and device.type != "cuda":
        raise UserError("trainer.capture=true: needs device=cuda; null captures where it is possible")
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(derive_seed("weights", settings.seed))
    prefer_speed(device, onednn=settings.trainer.onednn)
    if not processes.is_first():
        return Run(settings, folder, checkpoint)  # the first one writes
    lock_run_dir(folder)
    problem = occupied(folder, settings.resume)  # also of a sweep, whose folders only Hydra knows
    if problem is not None:
        raise UserError(problem)
    if settings.export.kind != "none":  # asked now, and not after hours of training
        check_export_place(settings.values, Path(settings.export.out or folder / "dataset"))
    for mark in (FINISHED, STOPPED):
        (folder / mark).unlink(missing_ok=True)
    log_to(folder / "train.log")
    if not again:
        OmegaConf.save(OmegaConf.create(dict(settings.values)), folder / "config.yaml")
    write_versions(folder, device)
    say(f"device {device}   seed {settings.seed}   results in {folder}")
    if told := settings.told_beside_image:
        say(f"warning: not the goal's image alone tells where the goal is, but also {' and '.join(told)}")
    if checkpoint is not None:
        done = int(checkpoint.counters.get("updates", 0))
        all_made = (
            done >= settings.trainer.updates and "whole_run" not in checkpoint.config
        )  # else the second stage comes
        nothing = (
            f"; trainer.updates={done} are made: only the run's end is done again, a larger number trains on"
        )
        say(f"going on from update {done} of {checkpoint.folder}{nothing if all_made else ''}")
    run = Run(settings, folder, checkpoint, open_loggers(settings, folder, checkpoint))
    if _begun is not None:
        _begun = (folder, _files(folder), run.loggers)
    return run


_begun: tuple[Path, set[Path], list[Logger]] | None = None
"""The folder of this process's run, what :func:`start` wrote there, the loggers; ``None`` if it held more before."""


def discard(there: Collection[Path]) -> bool:
    """Removes the folder of a run that has ended with nothing but what :func:`start` wrote; whether it did.

    Args:
        there: Folders that stood before the command, resolved. Those stay, and so does all that was written into one.
    """
    if _begun is None:
        return False
    folder, (_, written, loggers) = _begun[0].resolve(), _begun
    if folder in there or _files(folder) != written:
        return False
    close_loggers(loggers)
    for file in written:
        (folder / file).unlink(missing_ok=True)
    empty = sorted((one for one in folder.rglob("*") if one.is_dir()), reverse=True)
    for one in (*empty, folder, *folder.parents):
        if one in there:
            break
        with suppress(OSError):  # not empty: not ours
            one.rmdir()
    return not folder.exists()


def _files(folder: Path) -> set[Path]:
    return {one.relative_to(folder) for one in folder.rglob("*") if one.is_symlink() or not one.is_dir()}


def _require_same(checkpoint: Checkpoint) -> None:
    found = processes.objects(checkpoint.counters)
    other = next((rank for rank, one in enumerate(found) if one != found[0]), None)
    if other is not None:
        updates = [one.get("updates") for one in (found[other], found[0])]
        raise UserError(
            f"rank {other} sees another checkpoint in {checkpoint.folder} than rank 0 ({updates[0]} and {updates[1]} "
            "updates): start again in a minute"
        )


_checked: RunSettings | None = None


def check_once(settings: RunSettings) -> None:
    """Checks what :func:`start` will be given, so that it need not do so again."""
    global _checked
    check(settings)
    _checked = settings


def resumed(cfg: DictConfig, overrides: list[str]) -> tuple[Checkpoint, DictConfig]:
    """The checkpoint, and its configuration with the values (not the groups) given on the command line.

    Raises:
        UserError: The command line asks for another group than the checkpoint was made with.
    """
    checkpoint = load_checkpoint(latest_checkpoint(str(cfg.resume)))
    saved = checkpoint.config
    saved = saved.get("whole_run") or saved  # of a first stage's checkpoint
    changes, parser = (
        OmegaConf.create(),
        OverridesParser.create(),
    )  # a value means what it means without resume=
    for override in overrides:
        name = override.split("=", 1)[0].lstrip("+")
        if name in ("resume", "plugins") or name.startswith(("hydra.", "hydra/")):
            continue
        if name.startswith("~"):
            raise UserError(
                f"{override}: a run that resumes keeps all its options; change their values (GROUP.key=…)"
            )
        same = name in ("scale", "size", "seed") and str(cfg[name]) == str(saved.get(name))
        if "." not in name and not same and name not in ("device", "gpus"):
            group = isinstance(saved.get(name), Mapping)
            single = f", or change single values ({name}.key=…)" if group else ""
            raise UserError(f"{override}: a run that resumes keeps its {name}; leave it out{single}")
        # Of device=spread the GPU that was chosen, which the configuration has.
        value = cfg.device if name == "device" else parser.parse_override(override).value()
        OmegaConf.update(changes, name, value)
    merged = OmegaConf.merge(OmegaConf.create(saved), changes)
    assert isinstance(merged, DictConfig)
    merged.resume = str(cfg.resume)
    wanted = OmegaConf.select(merged, "trainer.updates")
    if (
        isinstance(wanted, int) and "whole_run" not in checkpoint.config
    ):  # what is written is what the weights have had
        merged.trainer.updates = max(wanted, int(checkpoint.counters.get("updates", 0)))
    if (derived := saved.get(DERIVED)) is not None:
        if not isinstance(derived, list) or not all(isinstance(name, str) for name in derived):
            raise UserError(
                f"{checkpoint.folder}: {DERIVED}={derived!r} in its configuration is no list of names"
            )
        merged[DERIVED] = [name for name in derived if name not in changes.get("model", {})]
    return checkpoint, merged


def open_loggers(settings: RunSettings, folder: Path, checkpoint: Checkpoint | None) -> list[Logger]:
    """The loggers that ``logger`` names; each is told the configuration, and where the run goes on."""
    updates = None
    if checkpoint is not None:  # a first stage logs nothing
        updates = 0 if "whole_run" in checkpoint.config else int(checkpoint.counters.get("updates", 0))
    loggers = make_loggers(settings.logger.names, folder, updates=updates, **settings.logger.options)
    log_config(loggers, settings.values)
    return loggers
