"""A sweep of joblib that is stopped from outside: its jobs save, and one line says how to go on."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from forks import TRAIN, Fork, script
from franka_wm.training.checkpoint import latest_checkpoint

pytestmark = pytest.mark.slow

SMALL = (
    *(
        "env=reach",
        "scale=smoke",
        "device=cpu",
        "env.episode_length=12",
        "env.substeps=1",
        "logger.names=[csv]",
    ),
    *("evaluation.episodes=2", "evaluation.video_episodes=0"),
)
TWO_AT_ONCE = (
    *("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", *SMALL),
    *("trainer.updates=1000000", "trainer.log_every=0.2", "seed=0,1,2"),
)


@pytest.fixture
def two_at_once(tmp_path: Path) -> tuple[Fork, list[Path]]:
    """A sweep of joblib with two jobs that train, in processes of their own, and a third that waits; their logs."""
    pytest.importorskip(
        "hydra_plugins.hydra_joblib_launcher", reason="hydra/launcher=joblib is not installed"
    )
    train = script(TRAIN, "--multirun", *TWO_AT_ONCE, f"hydra.sweep.dir={tmp_path}/sweep")

    def apart() -> None:
        os.setsid()
        train()

    fork = Fork(apart, cwd=tmp_path, log=tmp_path / "log")
    logs = [tmp_path / "sweep" / f"{k}-reach" / "train.log" for k in range(2)]
    ends = time.monotonic() + 120
    while not all(log.is_file() and "\nupdates" in log.read_text() for log in logs):
        assert time.monotonic() < ends, fork.said()
        time.sleep(0.05)
    return fork, logs


def workers(parent: int) -> list[int]:
    """Processes that joblib has started for jobs."""
    children = (Path(one) for one in Path("/proc").glob("[0-9]*"))
    mine = [
        one
        for one in children
        if (one / "status").is_file() and f"PPid:\t{parent}\n" in (one / "status").read_text()
    ]
    return [int(one.name) for one in mine if b"popen_loky" in (one / "cmdline").read_bytes()]


def test_a_killed_job_of_a_sweep_is_one_line(two_at_once, tmp_path: Path) -> None:
    fork, _ = two_at_once
    os.kill(workers(fork.pid)[0], signal.SIGKILL)
    done = fork.wait(60)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    (line,) = [one for one in done.stderr.splitlines() if one.startswith("error: ")]
    assert "the process of a job was killed" in line and f"hydra.sweep.dir={tmp_path}/sweep" in line


def test_one_job_that_is_stopped_stops_the_sweep(two_at_once, tmp_path: Path) -> None:
    """It has saved, and those that never began have not failed."""
    fork, logs = two_at_once
    first, second = workers(fork.pid)
    os.kill(first, signal.SIGTERM)
    ends = time.monotonic() + 60
    while not any("stopped; go on" in log.read_text() for log in logs):
        assert time.monotonic() < ends, fork.said()
        time.sleep(0.05)
    os.kill(second, signal.SIGTERM)
    done = fork.wait(60)
    assert done.returncode == 130 and "failed" not in done.stderr, done.stdout + done.stderr
    assert f"the sweep is stopped; the same command with hydra.sweep.dir={tmp_path}/sweep" in done.stdout


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_all_jobs_of_a_sweep_save(stop: signal.Signals, two_at_once, tmp_path: Path) -> None:
    """Each is asked by Ctrl-C itself; the SIGTERM of a scheduler may be for the first process alone."""
    fork, logs = two_at_once
    (os.killpg if stop == signal.SIGINT else os.kill)(fork.pid, stop)
    done = fork.wait(60)
    assert done.returncode == 130 and "Traceback" not in done.stderr, done.stdout + done.stderr
    assert f"hydra.sweep.dir={tmp_path}/sweep runs what is missing" in done.stdout
    for log in logs:
        assert latest_checkpoint(log.parent)
    assert not (tmp_path / "sweep" / "2-reach" / "config.yaml").exists()


def test_ctrl_c_ends_a_job_that_joblib_runs_in_the_first_process(tmp_path: Path) -> None:
    """Before anything could be saved: as it begins, or while it builds; the second job does not begin."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=1", *SMALL, "seed=0,1")
    train = script(TRAIN, "--multirun", *words, f"hydra.sweep.dir={tmp_path}/sweep")
    fork = Fork(train, cwd=tmp_path, log=tmp_path / "log")
    ends = time.monotonic() + 120
    while not (tmp_path / "sweep" / "0-reach" / "train.log").is_file():
        assert time.monotonic() < ends, fork.said()
        time.sleep(0.01)
    os.kill(fork.pid, signal.SIGINT)
    done = fork.wait(60)
    assert done.returncode == 130 and done.stdout.count("the sweep is stopped") == 1, (
        done.stdout + done.stderr
    )
    assert not list((tmp_path / "sweep").glob("*/finished.json")) and "Traceback" not in done.stderr
    assert not (tmp_path / "sweep" / "1-reach" / "config.yaml").exists()


def test_a_signal_does_not_kill_a_process_without_a_job(tmp_path: Path) -> None:
    """One has finished its job and waits: joblib would end the other one, amid its save, with it."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", *SMALL, "trainer.updates=4,1000000")
    fork = Fork(
        script(TRAIN, "--multirun", *words, f"hydra.sweep.dir={tmp_path}/sweep"), tmp_path, tmp_path / "log"
    )
    ends = time.monotonic() + 120
    first, second = (tmp_path / "sweep" / f"{k}-reach" for k in range(2))
    while not (first / "finished.json").is_file() or "\nupdates" not in (second / "train.log").read_text():
        assert time.monotonic() < ends, fork.said()
        time.sleep(0.05)
    time.sleep(1)  # until it waits
    os.kill(fork.pid, signal.SIGTERM)
    done = fork.wait(60)
    assert done.returncode == 130 and latest_checkpoint(second), done.stdout + done.stderr
    assert f"hydra.sweep.dir={tmp_path}/sweep runs what is missing" in done.stdout
