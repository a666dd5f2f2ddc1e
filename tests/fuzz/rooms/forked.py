"""Work in a fork of this process, with limits of time and memory: what is imported and built once serves every case."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

GOOD = ("done", "refused", "skipped")
LONGEST_LINE = 3000
"""Most characters of one line to a user; what they typed may be repeated in it."""


class NotApplicable(Exception):
    """A mutation of something that an earlier one has removed."""


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes:
        kind: `done`, `refused` (in one line), `skipped`; `traceback`, `long` (a refusal of several lines), `hang`,
            `crash`, `accepted` (what must be refused was not).
        text: The line, or the end of the traceback.
        where: For telling failures apart: the exception and the last place in this package.
    """

    kind: str
    text: str = ""
    where: str = ""

    @property
    def good(self) -> bool:
        """Whether it ended as it should."""
        return self.kind in GOOD


def forked(work: Callable[[], Any], *, seconds: float = 20.0, gigabytes: float = 3.0) -> Outcome:
    """Run `work` in a fork.

    Args:
        work: What it returns and prints is thrown away.
        seconds: Of wall-clock time, then it counts as a hang.
        gigabytes: Of address space beyond what this process has.
    """
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.setpgid(0, 0)
        with contextlib.suppress(BaseException):
            _limit(gigabytes)
            answer = json.dumps(asdict(_outcome(work))).encode()
            while answer:
                answer = answer[os.write(writing, answer) :]
        os._exit(0)
    os.close(writing)
    with contextlib.suppress(OSError):
        os.setpgid(child, child)
    answer, ends = b"", time.monotonic() + seconds
    while (left := ends - time.monotonic()) > 0:
        if not select.select([reading], [], [], left)[0]:
            break
        part = os.read(reading, 65536)
        if not part:
            break
        answer += part
    hung = time.monotonic() >= ends
    with contextlib.suppress(ProcessLookupError):  # and whatever it has started
        os.killpg(child, signal.SIGKILL)
    os.close(reading)
    _, status = os.waitpid(child, 0)
    if hung:
        return Outcome("hang", f"more than {seconds:g} s", f"hang {seconds:g} s")
    if not answer:
        return Outcome("crash", f"wait status {status}", f"crash {status}")
    return Outcome(**json.loads(answer))


def _limit(gigabytes: float) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(gigabytes * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


def _outcome(work: Callable[[], Any]) -> Outcome:
    from franka_wm.errors import FrankaError

    try:
        work()
    except NotApplicable as error:
        return Outcome("skipped", str(error))
    except FrankaError as error:
        line = str(error)
        if "\n" in line or len(line) > LONGEST_LINE:
            return Outcome("long", f"{len(line)} characters: {line[:300]}", f"long {line[:40]}")
        return Outcome("refused", line)
    except AcceptedError as error:
        return Outcome("accepted", str(error), f"accepted {error.where}")
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f for f in frames if "/franka_wm/" in f.filename]
        last = ours[-1] if ours else frames[-1]
        place = f"{Path(last.filename).name}:{last.name}"
        shown = "".join(traceback.format_exception(error)[-4:])
        text = f"{type(error).__name__}: {str(error)[:300]}\n{shown[-1500:]}"
        kind = re.sub(r"[^A-Za-z]", "", type(error).__name__)
        return Outcome("traceback", text, f"{kind} {place}")
    return Outcome("done")


class AcceptedError(Exception):
    """What can only be wrong was taken."""

    def __init__(self, message: str, where: str = "") -> None:
        super().__init__(message)
        self.where = where or message
