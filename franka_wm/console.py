"""What a run says on the terminal while it works."""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


def say(text: str, stream: TextIO | None = None) -> None:
    """One line, at once."""
    print(text, file=sys.stdout if stream is None else stream, flush=True)


def program() -> str:
    """What to type for ``franka-wm`` here: its name where the shell finds it, else where it lies beside this Python."""
    beside = Path(sys.executable).with_name("franka-wm")
    if shutil.which("franka-wm") or not beside.is_file():
        return "franka-wm"
    here = Path.cwd()
    return shlex.quote(str(beside.relative_to(here) if beside.is_relative_to(here) else beside))


def quoted(value: str) -> str:
    """A text as the value of an override, so that Hydra reads it as it is: brackets, commas and spaces included."""
    if re.fullmatch(r"[\w/.+-]+", value, re.ASCII):
        return value
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", value)
    ending = re.search(r"\\*$", escaped)
    return f"'{escaped}{ending[0] if ending else ''}'"


def resuming(folder: Path, config: Mapping[str, object]) -> str:
    """The command that goes on with a run, as a shell takes it."""
    return f"{program()} train {shlex.quote(f'resume={quoted(str(folder))}')}{named_plugins(config)}"


def named_plugins(config: Mapping[str, object]) -> str:
    """`` 'plugins=[…]'`` as a command about a run needs it, since what a run names is never imported by itself."""
    names = config.get("plugins")
    if not isinstance(names, list | tuple) or not names:
        return ""
    return " " + shlex.quote(f"plugins=[{','.join(map(str, names))}]")


@contextmanager
def _until_nobody_reads(stream: TextIO) -> Iterator[None]:
    """A closed pipe (``… | head``) ends the command without a traceback.

    Raises:
        SystemExit: It was closed.
    """
    try:
        yield
    except BrokenPipeError:
        # What Python would still flush at exit goes nowhere instead of into a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        sys.exit(1)


class _Copied:
    """A stream whose text also goes into the log."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        global _log
        try:
            if _log is not None:
                _log.write(text)
        except OSError as error:  # a full disk: what a run says must not end it
            _log = None
            self._stream.write(f"warning: nothing more is copied into train.log: {error}\n")
        with _until_nobody_reads(self._stream):
            return self._stream.write(text)

    def flush(self) -> None:
        with _until_nobody_reads(self._stream):
            self._stream.flush()

    def __eq__(self, other: object) -> bool:
        """Equal to the stream itself: libraries ask whether theirs is ``sys.stderr`` before they close it."""
        return other is self or other is self._stream

    __hash__ = object.__hash__

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


_log: TextIO | None = None
"""Copy of what the terminal shows: in memory until there is a file for it."""


@contextmanager
def terminal_log() -> Iterator[None]:
    """Copies what Python prints meanwhile to stdout and stderr, for :func:`log_to`."""
    global _log
    streams = sys.stdout, sys.stderr
    _log = io.StringIO()
    sys.stdout, sys.stderr = (_Copied(stream) for stream in streams)  # type: ignore[assignment]
    try:
        try:
            yield
        finally:
            sys.stdout.flush()  # here, where a closed pipe is caught, and not at exit
    finally:
        sys.stdout, sys.stderr = streams
        if _log is not None:
            _log.close()
        _log = None


def log_to(path: Path) -> None:
    """Goes on with the copy in a file, at its end; what was printed before comes first."""
    global _log
    if _log is None:
        return
    text = _log.getvalue() if isinstance(_log, io.StringIO) else ""
    _log.close()
    _log = path.open("a", encoding="utf-8", buffering=1)
    _log.write(text)


def log_anew() -> None:
    """What is printed from now on belongs to another run, whose file is not known yet."""
    global _log
    if _log is not None:
        _log.close()
        _log = io.StringIO()


def duration(seconds: float) -> str:
    """``75`` → ``1:15``; ``4000`` → ``1:06:40``."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def count(number: float) -> str:
    """``12345`` → ``12.3k``."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:.1f}{suffix}"
    return f"{number:.0f}"


@contextmanager
def announced(what: str, *, every: float = 10.0) -> Iterator[Callable[[str], None]]:
    """Says what starts, that it is still going on every so many seconds, and how long it took.

    Gives a function that is told which part of it runs from now on. A thread does the talking, since compiling a
    kernel does not return to Python.
    """
    part = ""

    def runs(name: str) -> None:
        nonlocal part
        part = f": {name}"

    say(f"{what} …")
    started = time.perf_counter()
    finished = threading.Event()

    def talk() -> None:
        while not finished.wait(every):
            say(f"  still running, {duration(time.perf_counter() - started)}{part}")

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    try:
        yield runs
    finally:
        finished.set()
        thread.join()
    say(f"  done in {time.perf_counter() - started:.1f} s")


class Progress:
    """Prints a line at most every ``every`` seconds: done, rates, time left, and what the caller adds.

    Args:
        total: Updates in all.
        done: Updates already made (a resumed run).
        env_steps: Environment steps already made.
        every: Seconds between lines.
    """

    def __init__(self, total: int, *, done: int = 0, env_steps: int = 0, every: float = 10.0):
        self.total, self.every = total, every
        self.begin(done, env_steps)

    def begin(self, updates: int, env_steps: int) -> None:
        """Rates and time left count from here on: what came before happens once, as compiling does."""
        self._started = self._last = time.perf_counter()
        self._first = self._previous = (updates, env_steps)

    def due(self) -> bool:
        """Whether it is time for a line."""
        return time.perf_counter() - self._last >= self.every

    def line(self, updates: int, env_steps: int, extra: str = "") -> dict[str, float]:
        """Prints a line; returns the rates since the last one."""
        now = time.perf_counter()
        span = max(now - self._last, 1e-9)
        rates = {
            "updates_per_s": (updates - self._previous[0]) / span,
            "env_steps_per_s": (env_steps - self._previous[1]) / span,
        }
        done = updates - self._first[0]
        left = (now - self._started) * (self.total - updates) / done if done else float("nan")
        say(
            f"updates {count(updates)}/{count(self.total)} ({rates['updates_per_s']:.0f}/s)   "
            f"env steps {count(env_steps)} ({count(rates['env_steps_per_s'])}/s)   {extra}   "
            f"{'left ' + duration(left) if done else ''}"
        )
        self._last, self._previous = now, (updates, env_steps)
        return rates
