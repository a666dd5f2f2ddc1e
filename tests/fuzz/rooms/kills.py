"""A command in a fork that is killed at a chosen file operation, or runs where the machine refuses something.

File operations are counted by Python's audit events: the product needs no hook for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from forks import spare

CHANGES = (
    "os.rename",
    "os.mkdir",
    "os.remove",
    "os.rmdir",
    "shutil.rmtree",
    "os.link",
    "os.symlink",
    "os.truncate",
)


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit status (negative: by a signal), what it printed, how many operations it made."""

    status: int
    said: str
    operations: int


def command(
    work: Callable[[], Any],
    folder: Path,
    *,
    kill_at: int | None = None,
    limits: dict[int, int] | None = None,
    ordinary: bool = False,
    seconds: float = 300.0,
) -> Ended:
    """Run a command line in a fork.

    Args:
        work: It; what it returns, or exits with, is the status.
        folder: Operations below it count.
        kill_at: Number of the operation at which it gets SIGKILL; `None`: none.
        limits: Of resources (`resource.RLIMIT_…`).
        ordinary: Without root's right to write into what is read-only.
    """
    said, counted = folder.parent / f"{folder.name}.said", folder.parent / f"{folder.name}.counted"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        status = 99
        with contextlib.suppress(BaseException):
            _redirect(said)
            faulthandler.dump_traceback_later(seconds - 5)  # where it hangs
            with counted.open("wb", buffering=0) as file:
                sys.addaudithook(_counter(str(folder), kill_at, file.fileno()))
                sys.dont_write_bytecode = True  # Python would leave it cut off where files may not grow
                if ordinary:
                    _without_overrides()
                for which, most in (limits or {}).items():
                    resource.setrlimit(which, (most, most))
                status = _status(work)
        os._exit(status)
    with contextlib.suppress(OSError):
        os.setpgid(child, child)
    ends, ended = time.monotonic() + seconds, 0
    while not ended and time.monotonic() < ends:
        ended, status = os.waitpid(child, os.WNOHANG)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    assert ended, f"more than {seconds:g} s\n{said.read_text()}"
    return Ended(os.waitstatus_to_exitcode(status), said.read_text(), counted.stat().st_size)


def _without_overrides() -> None:
    """Files' modes hold for root, too (capabilities(7): CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH)."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, sets = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, sets) == 0
    sets[0] &= ~0b110
    assert libc.capset(header, sets) == 0


def short_of_memory(work: Callable[[], Any], folder: Path) -> Ended:
    """Run a command line where 30 MB more of address space can be had, and Warp's library is still to be loaded.

    In a fork of a process that has run no test: what others allocated and gave back would be enough.
    """
    done = spare().fork(partial(_short_of_memory, work), folder.parent)
    return Ended(done.returncode, done.stdout + done.stderr, 0)


def _short_of_memory(work: Callable[[], Any]) -> None:
    load_commands()
    sys.dont_write_bytecode = True
    most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + 30 * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    sys.exit(_status(work))


def _redirect(said: Path) -> None:
    place = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(place, stream)
    sys.stdout, sys.stderr = (os.fdopen(k, "w", buffering=1, closefd=False) for k in (1, 2))


def _counter(folder: str, kill_at: int | None, file: int) -> Callable[[str, tuple[Any, ...]], None]:
    made = 0

    def hook(event: str, given: tuple[Any, ...]) -> None:
        nonlocal made
        if event == "open":
            _, mode, flags = given
            if not ((isinstance(mode, str) and set(mode) & set("wax+")) or flags & (os.O_WRONLY | os.O_RDWR)):
                return
        elif event not in CHANGES:
            return
        if not str(given[0]).startswith(folder):
            return
        made += 1
        os.write(file, b".")
        if made == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    return hook


def _status(work: Callable[[], Any]) -> int:
    import traceback

    try:
        found = work()
    except SystemExit as error:
        found = error.code
    except BaseException:
        traceback.print_exc()
        return 98
    sys.stdout.flush()
    return found if isinstance(found, int) else 0


def train(*words: str) -> Callable[[], Any]:
    """`python train.py WORDS`."""
    return partial(_train, words)


def _train(words: tuple[str, ...]) -> None:
    from franka_wm.commands.train import command as program

    program(list(words))


def verb(*words: str) -> Callable[[], Any]:
    """`franka-wm WORDS`."""
    return partial(_verb, words)


def _verb(words: tuple[str, ...]) -> int:
    from franka_wm.commands.main import main

    return main(list(words))


def collect(out: Path, *more: str, episodes: int = 6) -> Callable[[], Any]:
    """`franka-wm collect`, of short episodes into several shards."""
    words = [f"out={out}", f"episodes={episodes}", "num_envs=2", "workers=1", "shard_frames=12", *more]
    small = ["env.episode_length=6", "env.substeps=2", "env.image_size=16", "device=cpu", "scale=smoke"]
    return verb("collect", *words, "env=reach", *small)


def load_commands() -> None:
    """What the commands import, once, before the forks."""
    from hydra.core.plugins import Plugins

    import franka_wm.commands.collect
    import franka_wm.commands.export
    import franka_wm.commands.main
    import franka_wm.commands.publish
    import franka_wm.commands.report
    import franka_wm.commands.train
    import franka_wm.data.lerobot.opening
    import franka_wm.data.lerobot.publish
    import franka_wm.data.lerobot.writer
    import franka_wm.evaluation.protocol
    import franka_wm.report.end_of_run
    import franka_wm.report.page
    import franka_wm.training.trainer  # noqa: F401

    Plugins.instance()  # it looks into every package once


def load_worlds() -> None:
    """What building worlds loads and computes, once, before the forks of this process."""
    from franka_wm.envs import FrankaConfig, FrankaEnv

    FrankaEnv(FrankaConfig(substeps=2), num_envs=2, device="cpu", seed=0).close()


def places(what: str, operations: int, some: int = 3) -> list[int]:
    """At which operations of `what` to kill: at `some`, or at all of them (`FAULTS=all`), and says how many."""
    chosen = sorted({operations - k * operations // some for k in range(some)})
    if os.environ.get("FAULTS") == "all":
        chosen = list(range(1, operations + 1))
    print(f"{what}: {len(chosen)} kills")
    return chosen


def whole(ended: Ended) -> Ended:
    """It ended well."""
    assert ended.status == 0, ended.said
    assert "Traceback" not in ended.said
    return ended


def in_one_line(ended: Ended) -> str:
    """What it said was wrong; no traceback."""
    assert "Traceback" not in ended.said, ended.said
    assert ended.status == 1, ended
    (line,) = [line for line in ended.said.splitlines() if line.startswith("error: ")]
    return line
