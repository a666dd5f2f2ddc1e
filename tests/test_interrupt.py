"""Signals end a run when it can be saved whole."""

from __future__ import annotations

import os
import signal

import pytest

from franka_wm.interrupt import interruptible


def test_a_repeated_sigterm_does_not_end_a_save_and_ctrl_c_does() -> None:
    """A scheduler signals all processes of a job, and its launcher passes the signal on."""
    told = []
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interruptible(told.append) as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() and told == [signal.SIGTERM]
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before
