"""SIGTERM where training has saved, in the evaluation that follows: it ends a run as Ctrl-C does."""

from __future__ import annotations

import functools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from franka_wm.commands import several


def ended_by_sigterm(main: Callable[[DictConfig], object]) -> Callable[[DictConfig], object]:
    """A run in which SIGTERM does what Ctrl-C does; a plain function around it, which sweeps can send to processes."""

    @functools.wraps(main)
    def wrapped(cfg: DictConfig) -> object:
        with as_by_ctrl_c():
            return main(cfg)

    return wrapped


@contextmanager
def as_by_ctrl_c() -> Iterator[None]:
    """SIGTERM raises ``KeyboardInterrupt``, so that the run says what was saved and how to go on.

    Not in the jobs of a sweep, nor in one of several processes: what ends those says so. Forks end without a word.
    """
    own = os.getpid()

    def end(signum: int, frame: Any) -> None:
        if os.getpid() == own:
            signal.signal(signum, signal.SIG_IGN)  # a scheduler and a parent may both send one
            raise KeyboardInterrupt
        signal.signal(signum, signal.SIG_DFL)
        os.kill(os.getpid(), signum)

    one_of_many = several.JOB in os.environ or several.started_by_torchrun()
    if one_of_many or HydraConfig.get().mode == RunMode.MULTIRUN:
        yield
        return
    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
