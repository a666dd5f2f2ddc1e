"""What is said on the terminal: commands to type, and its copy in a run's log."""

from __future__ import annotations

import io
import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from franka_wm.console import Progress, announced, log_to, program, terminal_log


def test_what_is_printed_before_and_after_there_is_a_file(tmp_path: Path, capsys) -> None:
    with terminal_log():
        print("before")
        log_to(tmp_path / "train.log")
        print("after", file=sys.stderr)
    print("outside")
    assert (tmp_path / "train.log").read_text() == "before\nafter\n"
    assert capsys.readouterr() == ("before\noutside\n", "after\n")


def test_a_library_that_asks_first_does_not_close_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """absl's log handler, when Hydra configures logging: it closes its stream unless that is ``sys.stderr``."""
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with terminal_log():
        assert sys.stderr is not stream and stream in (sys.stderr, sys.stdout)
        assert io.StringIO() not in (sys.stderr, sys.stdout)


@pytest.mark.parametrize("flushed", [True, False])
def test_a_closed_pipe_ends_a_command_quietly(flushed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """`… | head`; what is still to be flushed then goes nowhere."""
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with pytest.raises(SystemExit) as caught, terminal_log():
            print("nobody reads this", flush=flushed)
            assert not flushed
        assert caught.value.code == 1


def test_what_to_type_is_a_path_where_the_shell_does_not_find_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = tmp_path / "my env" / "bin" / "franka-wm"
    beside.parent.mkdir(parents=True)
    monkeypatch.setattr(sys, "executable", str(beside.with_name("python")))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program() == "franka-wm", "there is none beside this Python"
    beside.touch(mode=0o755)
    assert program() == f"'{beside}'"
    monkeypatch.chdir(tmp_path)
    assert program() == "'my env/bin/franka-wm'"
    monkeypatch.setenv("PATH", str(beside.parent))
    assert program() == "franka-wm"


def test_rates_and_time_left_count_from_the_last_beginning(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    now = 0.0
    monkeypatch.setattr("franka_wm.console.time", SimpleNamespace(perf_counter=lambda: now))
    progress = Progress(101, every=10.0)
    now = 200.0  # the first update, which compiles
    assert progress.due()
    progress.begin(1, 40)
    assert not progress.due()
    now = 210.0
    assert progress.due()
    assert progress.line(21, 240) == {"updates_per_s": 2.0, "env_steps_per_s": 20.0}
    assert "left 0:40" in capsys.readouterr().out  # 80 more, at 2 a second


def test_a_long_wait_says_what_part_of_it_runs(capsys) -> None:
    with announced("five policies", every=0.05) as runs:
        time.sleep(0.08)
        runs("4 episodes of noop")
        time.sleep(0.08)
    first, *_, last, _ = capsys.readouterr().out.splitlines()
    assert first == "five policies …"
    assert last == "  still running, 0:00: 4 episodes of noop"
