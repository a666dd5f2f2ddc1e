"""Ctrl-C and SIGTERM end a run when it can be saved whole."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from franka_wm.console import say

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells expect."""


@contextmanager
def interruptible() -> Iterator[Any]:
    """Yields a function that tells whether the run shall end: after Ctrl-C, or the SIGTERM of a cluster's scheduler.

    A second one stops at once.
    """
    pressed = False

    def note(signum: int, frame: Any) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True
        say("\ninterrupted: finishing this step and saving; press Ctrl-C again to stop at once")

    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        before = {number: signal.signal(number, note) for number in numbers}
    except ValueError:  # not in the main thread: the one who started us handles Ctrl-C
        yield lambda: False
        return
    try:
        yield lambda: pressed
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
