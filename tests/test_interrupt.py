"""Signals end a run when it can be saved whole."""

from __future__ import annotations

import os
import signal

import pytest

from franka_wm.interrupt import ended_by_sigterm, interruptible


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


def test_sigterm_ends_a_process_as_ctrl_c_does_and_its_forks_as_ever() -> None:
    """A fork that is ended by its parent has nothing to say."""
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), ended_by_sigterm():
        fork = os.fork()
        if not fork:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            finally:
                os._exit(3)
        assert os.WTERMSIG(os.waitpid(fork, 0)[1]) == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
