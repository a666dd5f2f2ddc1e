"""``train.py --multirun``: its jobs are checked before the first begins, go on where they stopped, and fail alone."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from franka_wm import conf
from franka_wm.commands import launching
from franka_wm.console import log_anew, say
from franka_wm.errors import REFUSALS, FrankaError, UserError, machine_refused
from franka_wm.interrupt import INTERRUPTED, interruptible
from franka_wm.versions import FINISHED

JOB_FILE, STOPPED_FILE, FOLDER_FILE = "job-", "stopped", "folder"
"""Names of files in `Sweep.place`."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep: its overrides, those for Hydra too, and its folder."""

    overrides: list[str]
    folder: Path


def jobs(overrides: list[str]) -> list[Job]:
    """The runs that Hydra will make of a command line, by its own rules; none where another sweeper decides.

    Raises:
        UserError: Two of them would write into one folder.
    """
    import hydra
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    if any(one.startswith("hydra/sweeper=") for one in overrides):
        return []
    found: list[Job] = []
    with conf.hydra_session() as loader:
        parser = OverridesParser.create(config_loader=loader)
        for own in BasicSweeper.split_arguments(parser.parse_overrides(overrides), None)[0]:
            number = [f"hydra.job.num={len(found)}", f"hydra.job.id={len(found)}"]
            cfg = hydra.compose("config", overrides=[*own, *number], return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)
            found.append(Job(own, Path(str(cfg.hydra.sweep.dir), str(cfg.hydra.sweep.subdir))))
    folders = [job.folder for job in found]
    for k, folder in enumerate(folders):
        if folder in folders[:k]:
            raise UserError(
                f"jobs {folders.index(folder)} and {k} would both write into {folder}; "
                "put ${hydra.job.num} into hydra.sweep.subdir"
            )
    return found


def names(found: list[Job]) -> list[str]:
    """What jobs are called: by their number, and by that in which they differ."""
    common = set.intersection(*(set(job.overrides) for job in found)) if found else set()
    own = [" ".join(one for one in job.overrides if one not in common) for job in found]
    return [f"job {k} ({one})" if one else f"job {k}" for k, one in enumerate(own)]


@dataclass
class Sweep:
    """What becomes of the jobs of a sweep: of those that this process runs, and of those that others run for it.

    Attributes:
        names, folders: Names and folders of the jobs that are known beforehand.
        process: Number of the process that checked them; others may run them.
        folder: Folder of the sweep.
        place: A folder of this machine, while it waits for jobs in other processes: which run, and that it is stopped.
        failed: By number, the jobs that failed in this process, and why.
        inside: Whether one runs in the process that checked them.
        stopped: Whether that process was asked to stop, perhaps between two of them.
    """

    names: list[str] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    process: int = field(default_factory=os.getpid)
    folder: str = ""
    place: str = ""
    ran: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    inside: bool = False
    stopped: bool = False

    def run(self, main: Callable[[DictConfig], object], cfg: DictConfig) -> object:
        """One job: skipped if it is done, gone on with if it was begun; if it fails, the others go on all the same.

        Returns:
            What ``main`` does, for sweepers that search; None of a job that failed.

        Raises:
            KeyboardInterrupt, SystemExit: Ctrl-C, which ends the sweep.
        """
        from franka_wm.training.place import left_by

        told = HydraConfig.get()
        number, folder = int(told.job.num), Path(told.runtime.output_dir)
        name = self.names[number] if number < len(self.names) else f"job {number}"
        self.folder = str(told.sweep.dir)
        self.ran += 1
        # Of joblib's: an exception there kills the jobs beside it, before they have saved.
        beside_others = bool(self.place) and self.process != os.getpid()
        mark = Path(self.place, STOPPED_FILE)
        if beside_others and mark.exists():
            return None
        self.inside = self.process == os.getpid()
        try:
            if beside_others:
                self._register()
            if self.stopped:
                raise KeyboardInterrupt
            left = None if cfg.resume is not None else left_by(folder, cfg)
            if left == "finished":
                say(f"{name} was finished before: {folder}")
                return _score(folder)
            if left is not None:
                say(f"{name} goes on where it stopped")
                cfg.resume = str(folder)
            spread(cfg, number)
            if cfg.gpus == 1:
                return main(cfg)
            paths = [one for one in told.overrides.hydra if one.startswith("hydra.searchpath=")]
            launching.launch_job([*told.overrides.task, *paths], cfg, folder)
            return _score(folder)
        except (KeyboardInterrupt, SystemExit):  # the latter is how a run ends that has saved after Ctrl-C
            if beside_others:
                mark.touch()
                return None
            say(f"the sweep is stopped; {self.advice}")
            raise
        except Exception as error:
            self.failed[number] = f"{name}: {_in_words(error)}"
            print(f"error: {self.failed[number]}", file=sys.stderr, flush=True)
            return None
        finally:
            self.inside = False
            if beside_others:
                # Until the next one: this process would die, and joblib kill the jobs beside it.
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                Path(self.place, f"{JOB_FILE}{os.getpid()}").unlink(missing_ok=True)
            log_anew()
            gc.collect()  # the next one needs the memory

    def _register(self) -> None:
        """From here on SIGTERM to this process is for the job in it, which saves where it trains."""

        def stop(signum: int, frame: object) -> None:
            raise KeyboardInterrupt

        signal.signal(signal.SIGTERM, stop)
        Path(self.place, f"{JOB_FILE}{os.getpid()}").write_text(self.folder)
        Path(self.place, FOLDER_FILE).write_text(self.folder)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Jobs in processes of their own save when the sweep is stopped, and this process waits for them.

        Ctrl-C reaches them by itself; a SIGTERM to this process alone is passed on.

        Raises:
            SystemExit: After that.
            KeyboardInterrupt: Ctrl-C once more.
            FrankaError: A job's process was killed, and joblib has killed the others.
        """

        def pass_on(signum: int) -> None:
            self.stopped = True
            if self.inside:  # joblib runs a single job at a time in this process
                raise KeyboardInterrupt
            for job in Path(self.place).glob(f"{JOB_FILE}*") if signum == signal.SIGTERM else ():
                with suppress(ProcessLookupError):
                    os.kill(int(job.name.removeprefix(JOB_FILE)), signal.SIGTERM)

        killed = False
        with tempfile.TemporaryDirectory(prefix="franka_wm-") as self.place:
            with interruptible(pass_on), _hydra_raises():
                try:
                    yield
                except SystemExit:
                    if not self.stopped or self.ran:  # the job that ran in this process has said it
                        raise
                except BrokenProcessPool:
                    killed = True
            stopped = self.stopped or Path(self.place, STOPPED_FILE).exists()  # or a job was, alone
            if (told := Path(self.place, FOLDER_FILE)).exists():
                self.folder = told.read_text()
        if not self.folder and self.folders:
            self.folder = str(self.folders[0].parent)
        if stopped:
            say(f"the sweep is stopped; {self.advice}")
            sys.exit(INTERRUPTED)
        if killed:
            raise FrankaError(
                f"the process of a job was killed, and joblib ended the others before they had saved; {self.advice}"
            )
        if not self.folders and self.folder and not self.ran:  # a search by joblib: they are known now
            self.folders = sorted(one.parent for one in Path(self.folder).glob("*/.hydra"))
            self.names = [f"job {one.name}" for one in self.folders]

    @property
    def advice(self) -> str:
        """How to go on."""
        return f"the same command with hydra.sweep.dir={self.folder} runs what is missing"

    def outcome(self) -> str | None:
        """In one line, which jobs failed, and why; ``None`` if none did."""
        if not self.ran and self.folders:  # another launcher's processes ran them: what they left tells
            self.folder, self.ran = str(self.folders[0].parent), len(self.folders)
            ends = [(folder / FINISHED).is_file() for folder in self.folders]
            self.failed = {
                k: f"{self.names[k]}: see {self.folders[k] / 'train.log'}"
                for k, well in enumerate(ends)
                if not well
            }
        if not self.failed:
            return None
        reasons = "; ".join(self.failed.values())
        return str(FrankaError(f"{len(self.failed)} of {self.ran} jobs failed: {reasons}; {self.advice}"))


@contextmanager
def _hydra_raises() -> Iterator[None]:
    """Hydra hands exceptions on; else it prints them and ends the process."""
    name = "HYDRA_FULL_ERROR"
    given = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if given is None:
            del os.environ[name]
        else:
            os.environ[name] = given


def _score(folder: Path) -> float | None:
    """What the run in this folder has returned."""
    from franka_wm.evaluation.results import FILE, read_result, score

    return score(read_result(folder / FILE).policies) if (folder / FILE).is_file() else None


def _in_words(error: Exception) -> str:
    if isinstance(error, FrankaError):
        return str(error)
    refused = machine_refused(error) if isinstance(error, REFUSALS) else None
    if refused is None:  # a mistake of ours, or of a plugin
        traceback.print_exc()
    return refused or str(FrankaError(f"{type(error).__name__}: {error}"))


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
