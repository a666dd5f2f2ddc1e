"""Ctrl-C and SIGTERM end a run when it can be saved whole."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from franka_wm.console import say

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells expect."""


def _tell(signum: int) -> None:
    again = "; press Ctrl-C again to stop at once" if signum == signal.SIGINT else ""
    say(f"\nasked to stop: finishing this step and saving{again}")


@contextmanager
def interruptible(first: Callable[[int], None] = _tell) -> Iterator[Any]:
    """Yields a function that tells whether the run shall end: after Ctrl-C, or the SIGTERM of a cluster's scheduler.

    Ctrl-C after that stops at once. Another SIGTERM does not: it may come from a scheduler and from our parent as well.

    Args:
        first: is called with the number of the first signal.
    """
    pressed = False

    def note(signum: int, frame: Any) -> None:
        nonlocal pressed
        if not pressed:
            pressed = True
            first(signum)
        elif signum == signal.SIGINT:
            raise KeyboardInterrupt

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
