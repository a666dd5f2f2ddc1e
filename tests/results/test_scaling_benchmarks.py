"""What the benchmarks of several GPUs ask for, and what they make of the answers; nothing is trained."""

from __future__ import annotations

import math
import sys
from importlib import import_module
from io import StringIO
from itertools import count, pairwise
from pathlib import Path
from threading import Barrier, current_thread, main_thread
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from benchmarks.cost_model import HOST, NETWORKS, Link, all_reduce, speed_up

TOP = Path(__file__).resolve().parents[2]


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch):
    """A benchmark by name, whose table is kept in ``rows`` in the place of being printed."""

    def load(name: str) -> tuple[ModuleType, list[dict[str, Any]]]:
        monkeypatch.syspath_prepend(str(TOP / "benchmarks"))
        module, rows = import_module(name), []
        monkeypatch.setattr(module, "publish", lambda title, found, out, **kwargs: rows.extend(found))
        return module, rows

    return load


def test_beyond_what_there_is_speaks_the_cost_model(benchmark) -> None:
    scale, _ = benchmark("scale")
    inside = Link(latency=1e-4, bandwidth=1e11)
    rows = scale.beyond("LeWorldModel", 0.01, 20.0, inside)
    assert [(row["GPUs"], row["network"]) for row in rows] == [
        (HOST, "one host"),
        *((gpus, network) for network in ("InfiniBand", "Ethernet") for gpus in (16, 64, 512)),
    ]
    for row in rows:
        between = NETWORKS.get(row["network"])
        large, small = (all_reduce(size, row["GPUs"], inside, between) for size in (20e6, 0.0))
        assert row["gradients [ms]"] == pytest.approx(1e3 * large)
        assert row["messages [ms]"] == pytest.approx(1e3 * (large + 7 * small))  # eight messages
        assert row["predicted"] == pytest.approx(speed_up(row["GPUs"], 0.01, large + 7 * small))
        assert tuple(row) == scale.COLUMNS


def test_worlds_that_are_timed_move_at_random(benchmark, monkeypatch) -> None:
    """One action for ever would drive every joint to its limit, where worlds do little."""
    scale, _ = benchmark("scale")
    seen: list[torch.Tensor] = []

    class Still:
        device, action_dim = torch.device("cpu"), 7

        def __init__(self, *_: Any, **__: Any):
            pass

        def reset(self) -> TensorDict:
            return TensorDict({}, batch_size=[4])

        def step_and_maybe_reset(self, step: TensorDict) -> tuple[TensorDict, TensorDict]:
            seen.append(step["action"].clone())
            return step, TensorDict({"next": step}, batch_size=[4])

    clock = count()
    monkeypatch.setattr("franka_wm.envs.FrankaEnv", Still)
    monkeypatch.setattr(scale, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(sys, "stdin", StringIO("go\n"))
    scale.worker("cpu", 4, 3)
    assert len(seen) == 60
    assert not any(torch.equal(one, following) for one, following in pairwise(seen))
    actions = torch.stack(seen)
    assert actions.shape == (60, 4, 7) and actions.abs().max() <= 1
    assert actions.min() < -0.9 and actions.max() > 0.9


def test_reading_leaves_the_threads_to_torch(benchmark, monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    reading, _ = benchmark("lerobot_reading")
    told: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", told.append)
    monkeypatch.setattr(reading, "reading", lambda **_: [])
    monkeypatch.setattr(sys, "argv", ["lerobot_reading.py"])
    for variable in ("4", None):
        monkeypatch.setenv("OMP_NUM_THREADS", variable) if variable else monkeypatch.delenv("OMP_NUM_THREADS")
        reading.main()
    assert not told


def test_the_first_evaluation_that_is_good_enough_counts(benchmark) -> None:
    sooner, _ = benchmark("sooner")
    shares = [0.2, 0.96, 0.9, 1.0]
    rows = [{"loss": 1.0, "time_s": 0.5, "updates": 1.0, "env_steps": 1.0}]
    rows += [{sooner.SUCCESS: x, "time_s": 10.0 * k, "updates": 1.0} for k, x in enumerate(shares, 1)]
    assert sooner.first(rows, 0.95)["time_s"] == 20.0
    never = sooner.first(rows[:2], 0.95)
    assert math.isnan(never["time_s"]) and never[sooner.SUCCESS] == 0.2
    with pytest.raises(SystemExit, match="needs a planner"):
        sooner.first(rows[:1], 0.95)


def test_each_gpu_has_the_work_of_one_and_the_learning_rate_grows(benchmark, monkeypatch) -> None:
    sooner, rows = benchmark("sooner")
    asked = []

    def learned(arguments: list[str], folder: Path, share: float, gpus: list[str]) -> list[dict[str, float]]:
        said = dict(word.split("=", 1) for word in arguments)  # of several the last counts
        asked.append(said)
        assert share == 0.95 and gpus == ["0", "1", "2", "3"][: int(said["gpus"])]
        seconds = 60.0 / int(said["gpus"])
        return [{sooner.SUCCESS: 1.0, "time_s": seconds, "updates": 10.0, "env_steps": 20.0}]

    monkeypatch.setattr(sooner, "learned", learned)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    words = ["env=lift", "replay.batch_size=100", "trainer.lr=1e-3", "--gpus", "1", "4"]
    monkeypatch.setattr(sys, "argv", ["sooner.py", *words, "--scale", "laptop"])
    sooner.main()
    one, four = asked
    assert (one["gpus"], four["gpus"]) == ("1", "4")
    for name in ("replay.batch_size", "collector.num_envs", "replay.capacity"):
        assert int(four[name]) == 4 * int(one[name])
    assert float(one["trainer.lr"]) == pytest.approx(1e-3)
    assert float(four["trainer.lr"]) == pytest.approx(2e-3)
    assert [row["times sooner"] for row in rows] == [1.0, 4.0]
    assert [row["batch"] for row in rows] == [100, 400]


def test_jobs_of_fewer_gpus_than_there_are_run_side_by_side(benchmark, monkeypatch) -> None:
    sooner, rows = benchmark("sooner")
    together, places, grown = Barrier(2), [], sooner.grown

    def composed(*arguments: Any) -> list[str]:
        assert current_thread() is main_thread(), "Hydra composes in one thread alone"
        return grown(*arguments)

    monkeypatch.setattr(sooner, "grown", composed)

    def learned(arguments: list[str], folder: Path, share: float, gpus: list[str]) -> list[dict[str, float]]:
        places.append(gpus)
        together.wait(timeout=20)  # for another job
        assert not {*places[-1]} & {*places[-2]}
        together.wait(timeout=20)
        return [{sooner.SUCCESS: 1.0, "time_s": 6.0, "updates": 10.0, "env_steps": 20.0}]

    monkeypatch.setattr(sooner, "learned", learned)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 5)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "9,8,7,6,5")
    monkeypatch.setattr(sys, "argv", ["sooner.py", "env=lift", "--gpus", "2", "--seeds", "3", "1", "2", "4"])
    sooner.main()
    assert sorted(places) == [["7", "6"], ["7", "6"], ["9", "8"], ["9", "8"]]
    assert {row["jobs at once"] for row in rows} == {2}
    assert [row["seed"] for row in rows] == [3, 1, 2, 4]
    monkeypatch.setattr(sys, "argv", ["sooner.py", "env=lift", "--gpus", "8"])
    with pytest.raises(SystemExit):
        sooner.main()


JOB = """
import os, signal, sys, time
from pathlib import Path
folder = Path(next(word for word in sys.argv if word.startswith("hydra.run.dir=")).partition("=")[2])
folder.mkdir()
(folder / "gpus").write_text(os.environ["CUDA_VISIBLE_DEVICES"])
signal.signal(signal.SIGTERM, lambda *_: sys.exit(STATUS))
table = folder / "csv/scalars/eval/planner/success.csv"
table.parent.mkdir(parents=True)
table.write_text("10,0.5\\n20,0.96\\n30,1")
time.sleep(SECONDS)
sys.exit(END)
"""


def test_a_job_is_stopped_where_it_has_learned_and_says_why_it_failed(
    benchmark, monkeypatch, tmp_path: Path
) -> None:
    sooner, _ = benchmark("sooner")
    monkeypatch.setattr(sooner, "ROOT", tmp_path)
    for name in ("latest_checkpoint", "load_checkpoint", "read_rows"):
        monkeypatch.setattr(sooner, name, lambda folder: folder)

    def job(name: str, share: float, *, seconds: int, status: int = 143, end: int | str = 0) -> Path:
        text = JOB.replace("SECONDS", str(seconds)).replace("STATUS", str(status)).replace("END", repr(end))
        (tmp_path / "train.py").write_text(text)
        return sooner.learned(["env=lift"], tmp_path / name, share, ["2", "3"])

    assert job("run", 0.9, seconds=60) == tmp_path / "run"
    assert (tmp_path / "run" / "gpus").read_text() == "2,3"
    assert sooner.evaluated(tmp_path / "run") == [0.5, 0.96]  # the last line is not whole yet
    with pytest.raises(SystemExit, match=r"env=lift (?s:.*)no such task"):
        job("failed", 1.1, seconds=0, end="error: no such task")
    with pytest.raises(SystemExit, match="env=lift"):  # by somebody else
        job("ended", 1.1, seconds=0, end=143)
    with pytest.raises(SystemExit, match="env=lift"):  # while it saved
        job("lost", 0.9, seconds=60, status=1)


@pytest.mark.parametrize("mps", [False, True])
def test_a_sweep_is_timed_alone_at_once_and_on_every_gpu(benchmark, monkeypatch, mps: bool) -> None:
    sweep, rows = benchmark("sweep")
    asked, calls = [], []

    def timed(arguments: list[str], runs: int, at_once: int, environment: dict[str, str]) -> float:
        asked.append(
            (runs, at_once, environment.get("CUDA_VISIBLE_DEVICES"), "CUDA_MPS_PIPE_DIRECTORY" in environment)
        )
        assert "device=spread" in arguments
        return 60.0 * runs / at_once

    monkeypatch.setattr(sweep, "sweep", timed)
    monkeypatch.setattr(sweep.subprocess, "run", lambda command, **kwargs: calls.append(command))
    monkeypatch.setattr(sweep.shutil, "which", lambda name: name if mps else None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(sys, "argv", ["sweep.py"])
    sweep.main()
    shared = [(3, 3, "0", True)] if mps else []
    assert asked[1:] == [(3, 1, "0", False), (3, 3, "0", False), *shared, (6, 6, None, mps)]
    assert [row["times one after the other"] for row in rows] == [1.0, 3.0, *([3.0] if mps else []), 6.0]
    begun, ended = [sweep.SERVICE, "-d"], [sweep.SERVICE]
    assert calls == ([begun, ended] * 2 if mps else [])


def test_a_sweep_runs_train_py_and_counts_what_finished(benchmark, monkeypatch) -> None:
    sweep, _ = benchmark("sweep")
    asked, lost = [], []

    def run(command: list[str], **kwargs: Any) -> SimpleNamespace:
        asked.append((command, kwargs["env"]["MINE"]))
        folder = Path(command[-1 if at_once == 1 else -3].removeprefix("hydra.sweep.dir="))
        for k in range(3 - len(lost)):
            (folder / str(k)).mkdir()
            (folder / str(k) / "finished.json").touch()
        return SimpleNamespace(returncode=0, stdout="said", stderr="")

    monkeypatch.setattr(sweep.subprocess, "run", run)
    for at_once in (1, 3):
        assert sweep.sweep(["env=lift"], 3, at_once, {"MINE": "1"}) > 0
        command, mine = asked.pop()
        assert command[1:4] == [str(TOP / "train.py"), "--multirun", "env=lift"] and mine == "1"
        assert "seed=range(0,3)" in command and set(sweep.QUIET) <= set(command)
        launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=3"] if at_once == 3 else []
        assert [word for word in command if "launcher" in word] == launcher
    lost.append("a run")
    with pytest.raises(SystemExit, match="said"):
        sweep.sweep(["env=lift"], 3, at_once, {"MINE": "1"})
