"""SIGTERM after training ends a run as Ctrl-C does; who is ended by others is not concerned."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace

import pytest
from hydra.types import RunMode

from franka_wm.commands import ending, several
from franka_wm.commands.ending import as_by_ctrl_c


@pytest.fixture
def mode(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    told = SimpleNamespace(mode=RunMode.RUN)
    monkeypatch.setattr(ending, "HydraConfig", SimpleNamespace(get=lambda: told))
    monkeypatch.delenv(several.JOB, raising=False)
    return told


def test_a_process_ends_as_by_ctrl_c_and_its_forks_as_ever(mode: SimpleNamespace) -> None:
    """A fork that is ended by its parent has nothing to say."""
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), as_by_ctrl_c():
        fork = os.fork()
        if not fork:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            finally:
                os._exit(3)
        assert os.WTERMSIG(os.waitpid(fork, 0)[1]) == signal.SIGTERM
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(
                os.getpid(), signal.SIGTERM
            )  # one more, of its parent, does not end what is said and closed
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("one_of", ["a sweep", "a job"])
def test_one_of_many_is_left_as_it_is(one_of: str, mode: SimpleNamespace, monkeypatch) -> None:
    if one_of == "a sweep":
        mode.mode = RunMode.MULTIRUN
    else:
        monkeypatch.setenv(several.JOB, "there")
    before = signal.getsignal(signal.SIGTERM)
    with as_by_ctrl_c():
        assert signal.getsignal(signal.SIGTERM) is before
