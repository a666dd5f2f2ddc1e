"""What a process does that is one of several of a job: it meets the others, goes on from what was saved, ends."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig

from franka_wm import conf
from franka_wm.commands.overrides import compose
from franka_wm.console import quoted, say
from franka_wm.errors import UserError
from franka_wm.options import leaves
from franka_wm.source import snapshot
from franka_wm.untrusted import UntrustedFolder
from franka_wm.versions import PACKAGES, versions

LAUNCHER = "FRANKA_WM_LAUNCHER"
"""Process ID of the one that has started those of a job on this host by ``gpus=N``."""
TOLD = "FRANKA_WM_LOST"
"""The file where its processes say that they have lost another one: it knows better why."""
JOB = "FRANKA_WM_JOB"
"""In the environment of a process: it is one of several of a sweep's job, whose folder this is."""


def started_by_torchrun() -> bool:
    """Whether this process is one of several that torchrun has started; asked before torch is imported."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def wanted(overrides: list[str]) -> tuple[int, str]:
    """How many processes a checked command line asks for, and on which device; a run that resumes keeps its own."""
    from franka_wm.training.run import resumed

    cfg = compose(overrides)
    if cfg.resume is not None:
        _, cfg = resumed(cfg, overrides)
    return int(cfg.get("gpus", 1)), str(cfg.device)


def run_folder(overrides: list[str]) -> Path:
    """Where a run of this command line will write; with the present time in it, another one each time."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    with conf.hydra_session():
        cfg = hydra.compose("config", overrides=overrides, return_hydra_config=True)
        HydraConfig.instance().set_config(cfg)
        return Path(str(cfg.hydra.run.dir)).absolute()


def enter(overrides: list[str]) -> list[str]:
    """Meets the other processes of the job; the overrides of this one. All write into one folder, the first one's.

    Raises:
        UserError: The others cannot be met; versions, options, configurations or code differ; or a host has too few
            GPUs.
    """
    from franka_wm import processes
    from franka_wm.training.settings import plain

    own = [one for one in overrides if not one.startswith(("hydra.run.dir=", "gpus="))]
    meet(own, wanted(overrides)[1], leaves(plain(compose([one for one in own if one != "scale=auto"]))))
    folder = processes.objects(str(run_folder(overrides)))[0]
    own += [f"gpus={processes.count()}", f"hydra.run.dir={quoted(folder)}"]
    return own if processes.is_first() else [*own, "hydra.output_subdir=null"]


def meet(options: list[str], device: str, configuration: Mapping[str, object] | None = None) -> None:
    """Meets the other processes of the job. All but the first one are silent, unless they end first.

    Args:
        options: As they were typed.
        device: The configuration's.
        configuration: What they compose to, ``{"env.fps": 20, …}``: files of one's own are the same everywhere, too.

    Raises:
        UserError: As for :func:`enter`.
    """
    from franka_wm import processes

    if LAUNCHER in os.environ:
        end_with(int(os.environ[LAUNCHER]))
    if os.environ["RANK"] != "0":
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  # as long as the process
    processes.join(cuda=device != "cpu")
    decisive = ("franka_wm", "python", "commit", *PACKAGES)
    _require_same({"options": " ".join(options)} | {k: v for k, v in versions().items() if k in decisive})
    code = {name: _hash(content) for name, content in snapshot().items() if name.startswith("franka_wm/")}
    for some in (configuration or {}, code):
        if len({*processes.objects(_hash(repr(sorted(some.items())).encode()))}) > 1:
            _require_same(some)


def end_with(launcher: int, *, every: float = 2.0) -> None:
    """Asks this process to stop once the one that started it is gone, as after ``kill -9``.

    Else it would train on, holding its GPU and the run's folder, and nobody would know.

    Args:
        launcher: Process ID of that one.
        every: How often it is looked for [s].
    """

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(every)
        os.kill(os.getpid(), signal.SIGTERM)  # what it is at is saved

    threading.Thread(target=watch, name="launcher", daemon=True).start()


def _require_same(mine: Mapping[str, object]) -> None:
    """Checks that all processes say the same of the same names.

    Raises:
        UserError: It names the first in which another one differs from this one.
    """
    from franka_wm import processes

    for rank, theirs in enumerate(processes.objects(mine)):
        name = next((one for one in {**theirs, **mine} if theirs.get(one) != mine.get(one)), None)
        if name is not None:
            raise UserError(
                f"process {processes.rank()} has {name} {mine.get(name)}, process {rank} {theirs.get(name)}; start all "
                "of a job with the same command in the same environment"
            )


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def goes_on(cfg: DictConfig) -> bool:
    """Whether this process looks for what its job has saved: the job was started anew, or is one of a sweep."""
    from franka_wm import processes

    return processes.restarted() or (JOB in os.environ and cfg.resume is None)


def go_on(cfg: DictConfig, folder: Path) -> None:
    """Goes on from what a job has saved, if anything, where it :func:`goes_on`.

    The first process looks: others may see later what is on a disk of the network.

    Raises:
        UserError: The job was asked to stop; or what was saved is a run's of other settings.
    """
    from franka_wm import processes

    stopped, left = processes.objects(_left(cfg, folder) if processes.is_first() else None)[0]
    if stopped:
        raise UserError(stopped)
    if left:
        if JOB not in os.environ:  # else who started it has said so
            say(f"started anew: going on from {folder}")
        cfg.resume = str(folder)


def _left(cfg: DictConfig, folder: Path) -> tuple[str, bool]:
    """Why a job that was started anew ends, and whether it has saved in its folder."""
    from franka_wm import processes
    from franka_wm.training.checkpoint import latest_checkpoint
    from franka_wm.training.place import left_by
    from franka_wm.training.run import STOPPED

    mark = folder / STOPPED
    if processes.begun_again() and mark.is_file():
        return mark.read_text().strip(), False
    mark.unlink(missing_ok=True)
    if cfg.resume is None:
        return "", left_by(folder, cfg) is not None
    try:
        latest_checkpoint(folder)
    except UserError:
        return "", False
    # Of another run than this one, which is refused later.
    return "", (UntrustedFolder(folder).yaml("config.yaml") or {}).get("resume") == cfg.resume


def end_process(error: BaseException) -> None:
    """Ends this process, where it is one of several, by what ended its run; alone it does nothing.

    To leave as Python does would wait for threads that wait for the other processes.
    """
    if not started_by_torchrun():
        return
    from franka_wm import processes

    if isinstance(error, SystemExit):
        processes.leave(error.code if isinstance(error.code, int) else int(error.code is not None))
    elif processes.count() > 1:
        traceback.print_exception(error)
        processes.leave(1)


def speaks() -> bool:
    """Whether this process may say why it ends: alone, or as the first one of several to end."""
    if not started_by_torchrun():
        return True
    from franka_wm import processes

    return processes.speaks_first()


def named(message: str) -> str:
    """A line of an error, with the process that says it."""
    rank = os.environ.get("RANK", "0") if started_by_torchrun() else "0"
    return message if rank == "0" else f"process {rank}: {message}"
