"""``gpus=N``: one job of N processes, one for each GPU, which torchrun starts; and what each of them does first."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from omegaconf import DictConfig

from franka_wm import conf
from franka_wm.commands.overrides import compose
from franka_wm.console import quoted, resuming, say
from franka_wm.errors import UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.options import leaves
from franka_wm.source import snapshot
from franka_wm.untrusted import UntrustedFolder
from franka_wm.versions import PACKAGES, usable_cores, versions

SAVING = 1800
"""How long processes that were asked to stop may take to save [s]."""
LAUNCHER = "FRANKA_WM_LAUNCHER"
"""Process ID of the one that has started those of a job on this host by ``gpus=N``."""
TOLD = "FRANKA_WM_LOST"
"""The file where its processes say that they have lost another one: it knows better why."""
JOB = "FRANKA_WM_JOB"
"""In the environment of a process: it is one of several of a sweep's job, whose folder this is."""

MOST_ON_A_CORE = 8
"""Most processes with ``device=cpu`` for each core: they share cores and memory."""


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


def launch(flags: list[str], overrides: list[str], gpus: int, device: str) -> None:
    """Starts so many processes of a training on this host, and waits for them.

    Args:
        flags: Hydra's.
        overrides: Checked.
        gpus, device, and what is raised: As for :func:`launch_verb`.
    """
    folder = run_folder(overrides)
    fixed = [one for one in overrides if not one.startswith("hydra.run.dir=")]
    command = ["train", *flags, *fixed, f"hydra.run.dir={quoted(str(folder))}"]

    def advice() -> str:
        from franka_wm.training.checkpoint import latest_checkpoint

        try:
            latest_checkpoint(folder)
        except UserError:
            return "nothing was saved before; start it again"
        plugins = {"plugins": list(compose(overrides).plugins or [])}
        return f"go on from the last checkpoint: {resuming(folder, plugins)}"

    launch_verb(command, gpus, device, advice)


def launch_verb(command: list[str], gpus: int, device: str, advice: Callable[[], str]) -> None:
    """Starts so many processes of a command on this host, and waits for them.

    Args:
        command: The verb and its arguments, checked.
        gpus: How many.
        device: The configuration's.
        advice: Says what to do where a process was killed.

    Raises:
        UserError: This host has fewer GPUs, or a process was killed.
        SystemExit: With the status of the first process that said why it ended otherwise than well.
    """
    _require_gpus(gpus, device)
    from torch.distributed.elastic.multiprocessing.api import DefaultLogsSpecs, SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    for name in ("torch.distributed", "torch.distributed.elastic.agent.server.api"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # ours say what happened
    before = dict(os.environ)  # as the next job of a sweep finds it, too
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, usable_cores() // gpus)))
    places = [str(conf.FOLDER.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(places)
    # Python tells of the semaphores of a process that was killed, as if there were something to do.
    quiet = [*filter(None, [os.environ.get("PYTHONWARNINGS")]), "ignore:resource_tracker"]
    os.environ["PYTHONWARNINGS"] = ",".join(quiet)
    os.environ[LAUNCHER] = str(os.getpid())
    try:
        with tempfile.TemporaryDirectory(prefix="franka_wm-") as logs, patience() as stopped:
            os.environ[TOLD] = told = f"{logs}/lost"
            config = LaunchConfig(
                min_nodes=1,
                max_nodes=1,
                nproc_per_node=gpus,
                run_id=uuid.uuid4().hex,
                rdzv_backend="c10d",
                rdzv_endpoint="localhost:0",
                local_addr="localhost",
                max_restarts=0,
                logs_specs=DefaultLogsSpecs(log_dir=logs),
            )
            try:
                elastic_launch(config, sys.executable)("-m", "franka_wm", *command)
            except ChildFailedError as error:
                own = {rank: one for rank, one in error.failures.items() if rank not in stopped}
                _end(own or error.failures, Path(told), advice)
    except SignalException as stopped:  # the processes have saved, and said so
        sys.exit(INTERRUPTED if stopped.sigval == signal.SIGINT else 128 + stopped.sigval)
    finally:
        for name in ("OMP_NUM_THREADS", "PYTHONPATH", "PYTHONWARNINGS", LAUNCHER, TOLD):
            os.environ.pop(name, None)
            if name in before:
                os.environ[name] = before[name]


def _end(failures: Mapping[int, Any], told: Path, advice: Callable[[], str]) -> NoReturn:
    """Ends by processes that failed by themselves: that were killed, have said why, or have lost one another."""
    from franka_wm.processes import LOST

    by_time = sorted(failures.items(), key=lambda one: one[1].timestamp)
    for rank, one in by_time:
        if one.exitcode < 0:
            raise UserError(
                f"process {rank} of the run (pid {one.pid}) was ended by {one.signal_name()}, the others with it; "
                f"{advice()}"
            ) from None
    said = [one.exitcode for _, one in by_time if one.exitcode != LOST]
    if said:
        sys.exit(said[0])
    why = told.read_text(encoding="utf-8") if told.is_file() else "the processes have lost one another"
    raise UserError(f"{why}; {advice()}") from None


def refused_job(overrides: list[str]) -> str | None:
    """Why a job of a sweep cannot have the processes that it asks for, in one line; ``None`` if it can.

    Whether other hosts have the GPUs, only their jobs can say.
    """
    if not any(one.lstrip("+").startswith("gpus=") for one in overrides):
        return None
    gpus, device = wanted(overrides)
    launcher = next((one for one in overrides if one.startswith("hydra/launcher=")), None)
    if gpus > 1 and launcher == "hydra/launcher=joblib":
        return f"gpus={gpus} with {launcher}: jobs at once would take the same GPUs; leave the launcher out"
    try:
        if gpus > 1 and launcher is None:
            _require_gpus(gpus, device)
    except UserError as error:
        return str(error)
    return None


def launch_job(overrides: list[str], cfg: DictConfig, folder: Path) -> None:
    """Starts the processes of one job of a sweep on this host, and waits for them.

    Args:
        overrides: The job's; ``cfg`` may have more.
        cfg: Its configuration.
        folder: Where it writes.

    Raises:
        UserError: This host has fewer GPUs, or the job failed.
        SystemExit: It was asked to stop, and has saved.
    """
    # Without resume=, beside which no group may be named: the processes find what the job has saved, by JOB.
    command = ["train", *overrides, f"hydra.run.dir={quoted(str(folder))}"]
    os.environ[JOB] = str(folder)
    handlers = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    log = f"its lines above say why, or {folder / 'train.log'}"
    try:
        launch_verb(command, cfg.gpus, str(cfg.device), lambda: log)
    except SystemExit as ended:
        if ended.code in (INTERRUPTED, 128 + signal.SIGTERM):
            raise
        raise UserError(log) from None
    finally:
        del os.environ[JOB]
        for one, handler in handlers.items():  # torchrun leaves its own
            signal.signal(one, handler)


@contextmanager
def patience() -> Iterator[set[int]]:
    """Inside, processes that are asked to stop have half an hour to save, not torchrun's 30 s.

    Once: who asks again does not want to wait. Nor do those wait for long that have lost one of them.

    Yields those that were asked to stop, by rank: torchrun tells of how they ended as if they had failed.
    """
    from torch.distributed.elastic.multiprocessing.api import SubprocessContext

    before, asked = SubprocessContext._close, False
    stopped: set[int] = set()

    def close(self: SubprocessContext, death_sig: signal.Signals, timeout: int = 30) -> None:
        nonlocal asked
        live = {rank for rank, one in self.subprocess_handlers.items() if one.proc.poll() is None}
        first, asked = not asked, True
        stopped.update(live if first else ())
        before(self, death_sig, SAVING if first and len(live) == len(self.subprocess_handlers) else timeout)

    SubprocessContext._close = close
    try:
        yield stopped
    finally:
        SubprocessContext._close = before


def _require_gpus(gpus: int, device: str) -> None:
    if device == "cpu":
        cores = usable_cores()
        if gpus > MOST_ON_A_CORE * cores:
            raise UserError(
                f"gpus={gpus} with device=cpu: at most {MOST_ON_A_CORE * cores} processes on the {cores} cores of this "
                "machine"
            )
        return
    import torch

    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device not in ("auto", "cuda"):
        raise UserError(
            f"device={device} with gpus={gpus}: each process has a GPU of its own; use device=cuda"
        )
    if there < gpus:
        raise UserError(
            f"gpus={gpus}: this machine has {there} usable CUDA devices; use fewer, or so many processes on the CPU "
            "with device=cpu"
        )


def run_folder(overrides: list[str]) -> Path:
    """Where a run of this command line will write; with the present time in it, another one each time."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig

    before = HydraConfig.instance().cfg
    try:
        with hydra.initialize_config_dir(str(conf.FOLDER), version_base="1.3"):
            cfg = hydra.compose("config", overrides=overrides, return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)
            return Path(str(cfg.hydra.run.dir)).absolute()
    finally:
        HydraConfig.instance().cfg = before
        GlobalHydra.instance().clear()


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


def part(error: BaseException) -> None:
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


def spread(cfg: DictConfig, job: int = 0) -> None:
    """``device=spread``: jobs of a sweep take the GPUs of this host in turn.

    Raises:
        UserError: There is none.
    """
    if cfg.device != "spread":
        return
    import torch

    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not there:
        raise UserError("device=spread: this machine has 0 usable CUDA devices; use device=cpu")
    cfg.device = f"cuda:{job % there}"


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
