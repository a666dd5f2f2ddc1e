"""``gpus=N``: starts one job of N processes, one for each GPU, through torchrun, and tells how it ended."""

from __future__ import annotations

import logging
import os
import signal
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from omegaconf import DictConfig

from franka_wm import conf
from franka_wm.commands.overrides import compose
from franka_wm.commands.several import JOB, LAUNCHER, TOLD, run_folder, wanted
from franka_wm.console import quoted, resuming
from franka_wm.errors import UserError
from franka_wm.interrupt import INTERRUPTED
from franka_wm.versions import usable_cores

SAVING = 1800
"""How long processes that were asked to stop may take to save [s]."""
MOST_ON_A_CORE = 8
"""Most processes with ``device=cpu`` for each core: they share cores and memory."""


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
    except SignalException as signalled:  # the processes have saved, and said so
        sys.exit(INTERRUPTED if signalled.sigval == signal.SIGINT else 128 + signalled.sigval)
    finally:
        for name in ("OMP_NUM_THREADS", "PYTHONPATH", "PYTHONWARNINGS", LAUNCHER, TOLD):
            os.environ.pop(name, None)
            if name in before:
                os.environ[name] = before[name]


def _end(failures: Mapping[int, Any], told: Path, advice: Callable[[], str]) -> NoReturn:
    """Ends by processes that failed by themselves: that were killed, have said why, or have lost one another."""
    from franka_wm.processes import LOST_STATUS

    by_time = sorted(failures.items(), key=lambda one: one[1].timestamp)
    for rank, one in by_time:
        if one.exitcode < 0:
            raise UserError(
                f"process {rank} of the run (pid {one.pid}) was ended by {one.signal_name()}, the others with it; "
                f"{advice()}"
            ) from None
    said = [one.exitcode for _, one in by_time if one.exitcode != LOST_STATUS]
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
