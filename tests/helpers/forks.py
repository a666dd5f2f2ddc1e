"""Commands in a fork of the tests' process, in which torch and the simulator are loaded already.

A Python process of its own takes seconds of CPU time to load them, more than most of what is tested takes. A fork has
file descriptors, signals and an exit status of its own, too. Where what is imported is what is tested, use `light.py`.

Torch refuses to differentiate in forks of a process that did it before them, and Warp speaks only where it begins: what
trains is a fork of a `Spare`, which was forked before the first test.
"""

from __future__ import annotations

import functools
import gc
import os
import pickle
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra

TRAIN = Path(__file__).resolve().parents[2] / "train.py"


def script(path: Path, *arguments: str) -> Callable[[], Any]:
    """``python PATH ARGUMENT …``, as work for a fork."""
    return functools.partial(_script, path, arguments)


def _script(path: Path, arguments: tuple[str, ...]) -> None:
    sys.argv = [str(path), *arguments]
    sys.path.insert(0, str(path.parent))
    runpy.run_path(str(path), run_name="__main__")


def module(name: str, *arguments: str) -> Callable[[], Any]:
    """``python -m NAME ARGUMENT …`` with the working directory first in its path, as work for a fork."""
    return functools.partial(_module, name, arguments)


def _module(name: str, arguments: tuple[str, ...]) -> None:
    sys.argv = [name, *arguments]
    sys.path.insert(0, os.getcwd())
    runpy.run_module(name, run_name="__main__", alter_sys=True)


def _status(work: Callable[[], Any]) -> int:
    """The exit status that Python would end with after `work`."""
    try:
        work()
        return 0
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1


class Fork:
    """Work in a fork, in a folder of its own, which also holds its output.

    Args:
        work: Its end is exit status 0; ``SystemExit`` and exceptions are as they are in Python.
        cwd: The working directory.
        log: The stem of the files of standard output and standard error.
    """

    def __init__(self, work: Callable[[], Any], cwd: Path, log: Path) -> None:
        self._logs = [log.with_suffix(".stdout"), log.with_suffix(".stderr")]
        for path in self._logs:
            path.touch()
        sys.stdout.flush()
        sys.stderr.flush()
        with warnings.catch_warnings():  # that this process has threads: none that the fork needs
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if self.pid == 0:
            os._exit(self._run(work, cwd))

    def _run(self, work: Callable[[], Any], cwd: Path) -> int:
        def all_of_it() -> None:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for descriptor, path in zip((1, 2), self._logs, strict=True):
                os.dup2(os.open(path, os.O_WRONLY), descriptor)
            sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
            sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
            os.chdir(cwd)
            if "torch" in sys.modules:  # OpenMP's threads do not survive a fork
                sys.modules["torch"].set_num_threads(1)
            GlobalHydra.instance().clear()
            work()

        try:
            return _status(all_of_it)
        finally:
            loky = sys.modules.get("joblib.externals.loky.reusable_executor")
            if loky is not None and loky._executor is not None:  # its processes are waited for below
                loky._executor.shutdown(kill_workers=True)
            if "multiprocessing.util" in sys.modules:  # its exit handler, as in forks of its own
                sys.modules["multiprocessing.util"]._exit_function()
            sys.stdout.flush()
            sys.stderr.flush()

    def said(self) -> tuple[str, str]:
        """What is on standard output and standard error so far."""
        out, err = (path.read_text() for path in self._logs)
        return out, err

    def wait(self, seconds: float) -> subprocess.CompletedProcess[str]:
        """Its end; it is killed after so long, which fails the test."""
        ends = time.monotonic() + seconds
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        while not pid and time.monotonic() < ends:
            time.sleep(0.02)
            pid, status = os.waitpid(self.pid, os.WNOHANG)
        if not pid:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            raise AssertionError(f"more than {seconds:g} s: {self.said()}")
        return subprocess.CompletedProcess([], os.waitstatus_to_exitcode(status), *self.said())


def run_in_fork(
    work: Callable[[], Any], cwd: Path, *, seconds: float = 240.0
) -> subprocess.CompletedProcess[str]:
    """Run `work` in a fork to its end; its exit status and output."""
    with tempfile.TemporaryDirectory() as folder:
        return Fork(work, cwd, Path(folder, "log")).wait(seconds)


class Spare:
    """A fork of this process as it is now, which does nothing but fork when it is asked to. It ends with this process.

    Its forks have seen nothing of what this process did since.
    """

    def __init__(self) -> None:
        self._here, there = socket.socketpair()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if self.pid == 0:
            self._here.close()
            self._serve(there)
            os._exit(0)
        there.close()
        self._answers = self._here.makefile("rb")

    def _serve(self, requests: socket.socket) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with requests.makefile("rb") as asked:
            while True:
                try:
                    work, cwd, log, seconds = pickle.load(asked)
                except EOFError:
                    return
                fork = Fork(work, cwd, log)
                requests.sendall(pickle.dumps(fork.pid))
                try:
                    requests.sendall(pickle.dumps(fork.wait(seconds)))
                except AssertionError as error:
                    requests.sendall(pickle.dumps(error))

    def fork(
        self, work: Callable[[], Any], cwd: Path, seconds: float = 240.0
    ) -> subprocess.CompletedProcess[str]:
        """Run `work`, which can be pickled, in a fork of it to its end; its exit status and output."""
        with tempfile.TemporaryDirectory() as folder:
            self.begin(work, cwd, Path(folder, "log"), seconds)
            return self.end()

    def begin(self, work: Callable[[], Any], cwd: Path, log: Path, seconds: float = 240.0) -> int:
        """Begin such a fork; its process number. Nothing else can be asked for before `end`.

        Args:
            work, cwd, log: As for a `Fork`.
            seconds: It is killed after so long, and `end` fails.
        """
        self._here.sendall(pickle.dumps((work, cwd, log, seconds)))
        return pickle.load(self._answers)

    def end(self) -> subprocess.CompletedProcess[str]:
        """Wait for the fork that has begun; its exit status and output."""
        found = pickle.load(self._answers)
        if isinstance(found, AssertionError):
            raise found
        return found

    def close(self) -> None:
        """Ends it."""
        self._answers.close()
        self._here.close()
        os.waitpid(self.pid, 0)


@functools.cache
def spare() -> Spare:
    """The one of this process; the first call makes it."""
    gc.freeze()  # forks must not touch, and so copy, all that is loaded
    return Spare()


def job_in_fork(count: int, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The same by so many processes, as torchrun starts them on one host; exit status: the first that is not 0."""
    return ranks_in_forks([script(TRAIN, *arguments)] * count, cwd)


def ranks_in_forks(works: list[Callable[[], Any]], cwd: Path) -> subprocess.CompletedProcess[str]:
    """What each process of a job does, in the environment that torchrun would give it."""
    return spare().fork(functools.partial(_ranks, works), cwd)


def _ranks(works: list[Callable[[], Any]]) -> None:
    with socket.socket() as one:
        one.bind(("localhost", 0))
        port = one.getsockname()[1]
    common = {"WORLD_SIZE": len(works), "LOCAL_WORLD_SIZE": len(works), "TORCHELASTIC_RUN_ID": "forks"}
    common |= {"MASTER_ADDR": "localhost", "MASTER_PORT": port}
    forks = []
    for rank, work in enumerate(works):
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                own = {"RANK": rank, "LOCAL_RANK": rank}
                os.environ.update({name: str(value) for name, value in (common | own).items()})
                work()
            except BaseException:  # a job ends by os._exit
                traceback.print_exc()
            finally:
                os._exit(status)
        forks.append(pid)
    found = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in forks]
    sys.exit(next(filter(None, found), 0))


def torchrun_in_fork(work: Callable[[], Any]) -> Callable[[], Any]:
    """`work` for a fork; the processes that torchrun starts there are forks of it.

    Each leaves its number in `rankK.pid` in the working directory.
    """
    return functools.partial(_torchrun, work)


def _torchrun(work: Callable[[], Any]) -> None:
    from torch.distributed.elastic.multiprocessing.subprocess_handler import subprocess_handler

    subprocess_handler.Popen = _Rank  # pyright: ignore[reportAttributeAccessIssue]
    work()


def torchrun(*arguments: str, hosts: int = 1) -> Callable[[], Any]:
    """``torchrun ARGUMENT …`` as work for a fork, as are its processes; or the same at once on so many hosts.

    Exit status: the first that is not 0.
    """
    return functools.partial(_hosts, torchrun_in_fork(module("torch.distributed.run", *arguments)), hosts)


def _hosts(work: Callable[[], Any], count: int) -> None:
    os.environ["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"
    if count == 1:
        return work()
    forks = []
    for _ in range(count):
        pid = os.fork()
        if pid == 0:
            os._exit(_status(work))
        forks.append(pid)
    found = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in forks]
    sys.exit(next(filter(None, found), 0))


class _Rank(subprocess.Popen):
    """``PYTHON [-u] FILE …`` or ``PYTHON [-u] -m MODULE …`` in a session of its own, as a fork of this process."""

    def __init__(self, args: tuple[str, ...], env: dict[str, str], **options: Any) -> None:
        super().__init__(args, env=env, **options)
        Path(f"rank{env['RANK']}.pid").write_text(str(self.pid))

    def _execute_child(self, args: tuple[str, ...], *options: Any) -> None:
        environment = options[5]
        self.pid = os.fork()
        if self.pid == 0:
            words = args[2:] if args[1] == "-u" else args[1:]
            os._exit(self._run(words, environment))
        self._child_created = True

    @staticmethod
    def _run(words: tuple[str, ...], environment: dict[str, str]) -> int:
        def all_of_it() -> None:
            os.setsid()
            for one in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):  # torchrun has handlers
                signal.signal(one, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.environ.clear()
            os.environ.update(environment)
            GlobalHydra.instance().clear()
            own = f"{os.getcwd()}/"  # plugins, which torchrun's process has loaded to look at
            for name, module in list(sys.modules.items()):
                if str(getattr(module, "__file__", "")).startswith(own):
                    del sys.modules[name]
            if words[0] == "-m":
                sys.argv = list(words[1:])
                runpy.run_module(words[1], run_name="__main__", alter_sys=True)
            else:
                _script(Path(words[0]), words[1:])

        status = _status(all_of_it)
        threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]  Python waits for threads at its end
        sys.stdout.flush()
        sys.stderr.flush()
        return status


def train_in_fork(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """``python train.py ARGUMENT …`` in a fork of a process that has run no test yet."""
    return spare().fork(script(TRAIN, *arguments), cwd)
