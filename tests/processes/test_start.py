"""How processes of one job meet, and what they find of it: one line where they cannot go on together."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from datetime import timedelta
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch.distributed.elastic.multiprocessing.api import SubprocessContext
from torch.utils._python_dispatch import TorchDispatchMode

from forks import Fork
from franka_wm import processes
from franka_wm.commands import entry, launching, several
from franka_wm.commands.overrides import compose, given
from franka_wm.console import quoted
from franka_wm.data.moments import moments
from franka_wm.errors import UserError
from franka_wm.processes import LOST_STATUS as LOST
from franka_wm.training import run
from franka_wm.versions import versions
from small_checkpoint import save


@pytest.fixture
def port() -> int:
    """One that nobody listens at."""
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


@pytest.fixture
def second(monkeypatch) -> None:
    """This process as the second of two."""
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "rank", lambda: 1)
    monkeypatch.setattr(processes, "wait", lambda: None)


def test_others_that_cannot_be_met_are_one_line(monkeypatch, port) -> None:
    place = {"RANK": 1, "LOCAL_RANK": 1, "WORLD_SIZE": 2, "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    for name, value in place.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(processes, "MEETING", timedelta(seconds=1))
    with pytest.raises(
        UserError, match=f"cannot meet.*localhost:{port}.*GLOO_SOCKET_IFNAME.*NCCL_SOCKET_IFNAME"
    ):
        processes.join(cuda=False)


def together(work: Callable[[], None], port: int, place: Path) -> list[subprocess.CompletedProcess[str]]:
    """How two processes of two hosts end that do the same."""

    def on_a_host(rank: int) -> None:
        common = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "1", "LOCAL_RANK": "0", "TORCHELASTIC_RUN_ID": "1"}
        common |= {"MASTER_ADDR": "localhost", "MASTER_PORT": str(port)}
        os.environ.update(common, RANK=str(rank))
        work()

    ranks = [Fork(partial(on_a_host, rank), place, place / str(rank)) for rank in range(2)]
    return [one.wait(120) for one in ranks]


def test_a_host_without_a_gpu_says_so_and_all_end(port, tmp_path) -> None:
    """The second is that host; the first has one."""

    def work() -> None:
        there = os.environ["RANK"] == "0"
        torch.cuda.is_available, torch.cuda.device_count = lambda: there, lambda: int(there)
        try:
            processes.join(cuda=True)
        except UserError as error:
            entry.fail(str(error))

    found = together(work, port, tmp_path)
    assert [one.returncode for one in found] == [1, 1]
    assert f"host {socket.gethostname()} has 0 usable CUDA devices for 1 processes" in found[1].stderr
    assert not any("Traceback" in one.stderr for one in found)


def test_who_has_met_is_waited_for_longer(port, tmp_path) -> None:
    def work() -> None:
        processes.MEETING = timedelta(seconds=5)
        processes.join(cuda=False)
        time.sleep(7 * processes.rank())
        processes.wait()
        processes.leave(7)

    found = together(work, port, tmp_path)
    assert [one.returncode for one in found] == [7, 7], found


@pytest.mark.parametrize(
    ("name", "there", "said"),
    [
        ("torch", "1.0", "has torch .*, process 0 1.0;"),
        ("commit", None, "has commit 0123456789ab, process 0 None;"),
        ("options", "env=reach", "has options env=lift, process 0 env=reach;"),
        ("env.fps", 30, "has env.fps 20, process 0 30;"),
        ("env.mine", 5, "has env.mine None, process 0 5;"),
        ("franka_wm/processes.py", "abc", "has franka_wm/processes.py [0-9a-f]{12}, process 0 abc;"),
        (None, None, None),
    ],
)
def test_what_differs_between_hosts_is_one_line(monkeypatch, second, name, there, said) -> None:
    """Of versions, the commit, options, what they compose to, and code."""

    def told(mine: Any) -> list[Any]:
        """What the first process, of another host, and this one say."""
        if isinstance(mine, str):  # a hash of many things
            return ["other" if name else mine, mine]
        has = name in mine or (name == "env.mine" and "env.fps" in mine)
        others = {**mine, name: there} if has else mine
        return [{k: v for k, v in others.items() if v is not None}, mine]

    monkeypatch.setenv("RANK", "0")  # which leaves the terminal as it is
    monkeypatch.setattr(processes, "join", lambda **_: None)
    monkeypatch.setattr(processes, "objects", told)
    monkeypatch.setattr(several, "versions", lambda: versions() | {"commit": "0123456789ab"})
    line = f"^process 1 {said} start all of a job"
    with nullcontext() if said is None else pytest.raises(UserError, match=line):
        several.meet(["env=lift"], "cpu", {"env.fps": 20, "env.task": "lift"})


def test_processes_compare_what_their_options_compose_to(monkeypatch, second, tmp_path) -> None:
    """A preset of one's own, whose name is the same on all hosts; not the folder, which the first process decides."""
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "mine.yaml").write_text("defaults: [reach, _self_]\nfps: 15\n")
    met = []
    monkeypatch.setattr(several, "meet", lambda options, *more: met.append(([*options], *more)))
    monkeypatch.setattr(several, "run_folder", lambda _: tmp_path)
    path = f"hydra.searchpath=[file://{tmp_path}]"
    monkeypatch.setattr(processes, "objects", lambda mine: [mine, mine])
    several.enter(["env=mine", path, "device=cpu", "gpus=2", "hydra.run.dir=here"])
    [(options, device, configuration)] = met
    assert options == ["env=mine", path, "device=cpu"] and device == "cpu"
    assert configuration["env.fps"] == 15 and not any("hydra" in key for key in configuration)


@pytest.mark.parametrize("restarts", ["", "0", "2"])
def test_a_job_that_slurm_requeued_was_started_anew(monkeypatch, restarts) -> None:
    monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
    assert processes.restarted() is (restarts == "2")


def config(resume: str | None = None):
    return OmegaConf.create({"resume": resume})


@pytest.fixture
def saved(tmp_path) -> Path:
    """A folder of a run that has saved."""
    latest = tmp_path / "own" / "checkpoints" / "latest"
    latest.mkdir(parents=True)
    (latest / "manifest.json").write_text("{}")
    (tmp_path / "own" / "config.yaml").write_text(f"resume: {tmp_path}/first\n")
    return tmp_path / "own"


def test_what_was_asked_to_stop_is_not_begun_again(monkeypatch, saved, tmp_path) -> None:
    (saved / run.STOPPED).write_text(f"stopped; go on with: franka-wm train resume={saved}\n")
    monkeypatch.setattr(processes, "begun_again", lambda: True)
    with pytest.raises(UserError, match=f"go on with: franka-wm train resume={saved}"):
        several.go_on(config(), saved)
    monkeypatch.setattr(processes, "begun_again", lambda: False)  # requeued: SLURM had asked it
    cfg = config(str(tmp_path / "first"))
    several.go_on(cfg, saved)
    assert cfg.resume == str(saved) and not (saved / run.STOPPED).exists()


def test_a_resumed_job_goes_on_from_its_own_folder_if_it_has_saved(saved, tmp_path) -> None:
    cfg = config(str(tmp_path / "first"))
    several.go_on(cfg, tmp_path / "nothing")
    assert cfg.resume == str(tmp_path / "first")
    several.go_on(cfg, saved)
    assert cfg.resume == str(saved)
    cfg = config("another")  # whose folder that is not
    several.go_on(cfg, saved)
    assert cfg.resume == "another"


def test_the_first_process_decides_whether_a_job_goes_on(monkeypatch, second, tmp_path) -> None:
    """The second does not see the folder yet."""
    monkeypatch.setattr(processes, "objects", lambda mine: [("", True), mine])
    cfg = config()
    several.go_on(cfg, tmp_path / "late")
    assert cfg.resume == str(tmp_path / "late")


def test_a_folder_that_another_process_does_not_see_is_one_line(monkeypatch, second, tmp_path) -> None:
    monkeypatch.setattr(processes, "SOON", 0.3)
    monkeypatch.setattr(
        processes, "objects", lambda mine: ["word", mine] if isinstance(mine, str) else [True, mine]
    )
    with pytest.raises(
        UserError, match=f"rank 1 does not see {tmp_path}: give hydra.run.dir on a disk that all"
    ):
        processes.require_seen(tmp_path, "hydra.run.dir")
    (tmp_path / processes.SEEN).write_text("word")
    processes.require_seen(tmp_path, "hydra.run.dir")


def test_processes_that_shall_stop_may_take_long_to_save(monkeypatch) -> None:
    given = []
    monkeypatch.setattr(SubprocessContext, "_close", lambda self, sig, timeout=30: given.append(timeout))

    def ended(*status: int | None) -> SimpleNamespace:
        proc = [SimpleNamespace(poll=lambda one=one: one) for one in status]
        return SimpleNamespace(subprocess_handlers=dict(enumerate(SimpleNamespace(proc=one) for one in proc)))

    for processes_of_job in ([ended(None, None)] * 2, [ended(None, -9)]):
        with launching.patience():
            for one in processes_of_job:
                SubprocessContext._close(one, 15)  # pyright: ignore[reportArgumentType]
    assert given == [launching.SAVING, 30, 30]  # who asks again, and who has lost a process, does not wait


@pytest.mark.parametrize("name", ["a b", "[1,2]", "it's", "{x:1}", "k=v", "end\\", "back\\'s", "ü#"])
def test_odd_names_arrive_unchanged(name) -> None:
    override = f"resume={quoted(f'/tmp/{name}')}"
    assert compose([override]).resume == f"/tmp/{name}" == given([override], "resume")


def test_statistics_of_unequal_parts(monkeypatch) -> None:
    """What the first process has beside its own experience counts once."""
    parts = [torch.randn(40, 3) + 2, torch.randn(10, 3)]
    moments = [(x.mean(0), x.std(0), len(x)) for x in parts]
    means, stds, counts = (list(one) for one in zip(*moments, strict=True))
    answers = iter([torch.stack(means), torch.stack(stds), torch.tensor(counts).view(2, 1).float()])
    monkeypatch.setattr(processes, "gather", lambda x: next(answers))
    mean, std = processes.pooled(*moments[0])
    torch.testing.assert_close(mean, torch.cat(parts).mean(0))
    torch.testing.assert_close(std, torch.cat(parts).std(0))


def test_one_row_deviates_by_nothing(monkeypatch) -> None:
    """One seeded step of one world, alone or beside a process that has more."""
    alone, more = torch.randn(1, 3), torch.randn(9, 3)
    mean, std = moments(alone)
    assert torch.equal(mean, alone[0]) and torch.equal(std, torch.zeros(3))
    parts = [(*moments(x), len(x)) for x in (alone, more)]
    means, stds, counts = (list(one) for one in zip(*parts, strict=True))
    answers = iter([torch.stack(means), torch.stack(stds), torch.tensor(counts).view(2, 1).float()])
    monkeypatch.setattr(processes, "gather", lambda x: next(answers))
    torch.testing.assert_close(processes.pooled(*parts[0])[1], torch.cat((alone, more)).std(0))


@pytest.mark.parametrize("mine", [None, "/mine"])
def test_the_next_job_of_a_sweep_finds_the_environment_as_it_was(mine, monkeypatch) -> None:
    from torch.distributed.launcher import api

    seen = []

    def elastic_launch(config, program):
        return lambda *words: seen.append({name: os.environ.get(name) for name in names})

    names = ("OMP_NUM_THREADS", "PYTHONPATH", "PYTHONWARNINGS", several.LAUNCHER)
    monkeypatch.setattr(api, "elastic_launch", elastic_launch)
    monkeypatch.setattr(launching, "usable_cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    if mine is not None:
        monkeypatch.setenv("PYTHONPATH", mine)
    before = dict(os.environ)
    for gpus in (2, 4):
        launching.launch_verb(["train"], gpus, "cpu", lambda: "")
        assert dict(os.environ) == before
    assert [one["OMP_NUM_THREADS"] for one in seen] == ["4", "2"]
    assert seen[0]["PYTHONPATH"] == seen[1]["PYTHONPATH"] and all(one[several.LAUNCHER] for one in seen)
    assert seen[0]["PYTHONWARNINGS"] == "default,ignore:resource_tracker"


@pytest.mark.parametrize(
    ("ended", "stopped", "says"),
    [
        ({0: LOST, 1: -9}, [], "process 1 of the run .* was ended by SIGKILL.*; go on"),
        ({0: -15, 1: -9}, [0], "process 1 of the run .* was ended by SIGKILL.*; go on"),
        ({0: LOST, 1: LOST}, [], "^process 1 has lost another one: a timeout; go on"),
        ({0: LOST, 1: -15}, [1], "^process 1 has lost another one: a timeout; go on"),
        ({0: LOST, 1: 1}, [], 1),  # it has said why
        ({0: -15, 1: 1}, [0], 1),  # the launcher has stopped the other one
        ({0: -15, 1: 130}, [0], 130),  # it has saved
    ],
)
def test_the_launcher_tells_of_what_nobody_could_say(ended, stopped, says, monkeypatch) -> None:
    from torch.distributed.elastic.multiprocessing import errors
    from torch.distributed.launcher import api

    def failure(rank: int, status: int) -> errors.ProcessFailure:
        return errors.ProcessFailure(local_rank=rank, pid=7, exitcode=status, error_file="none")

    def elastic_launch(config, program):
        def fails(*_: str) -> None:
            if LOST in ended.values():
                Path(os.environ[several.TOLD]).write_text("process 1 has lost another one: a timeout")
            raise errors.ChildFailedError("train", {rank: failure(rank, s) for rank, s in ended.items()})

        return fails

    monkeypatch.setattr(api, "elastic_launch", elastic_launch)
    monkeypatch.setattr(launching, "patience", lambda: nullcontext(set(stopped)))
    if isinstance(says, int):
        with pytest.raises(SystemExit) as ends:
            launching.launch_verb(["train"], 2, "cpu", lambda: "go on")
        assert ends.value.code == says
    else:
        with pytest.raises(UserError, match=says):
            launching.launch_verb(["train"], 2, "cpu", lambda: "go on")


def test_a_process_that_has_lost_another_leaves_the_word_to_its_launcher(
    monkeypatch, capsys, tmp_path
) -> None:
    monkeypatch.setattr(processes, "leave", sys.exit)
    lost = processes.LostAnother("process 0 has lost another one")
    with pytest.raises(SystemExit) as ends:
        entry.fail_by(lost)
    said = capsys.readouterr().err
    assert ends.value.code == 1 and "has lost another one: go on with resume=FOLDER" in said
    monkeypatch.setenv(several.TOLD, str(tmp_path / "lost"))
    with pytest.raises(SystemExit) as ends:
        entry.fail_by(lost)
    assert ends.value.code == LOST and not capsys.readouterr().err
    assert (tmp_path / "lost").read_text() == str(lost)


def test_only_a_lost_process_is_one() -> None:
    """What the device or the program did wrong has a traceback of its own."""
    for message in ("CUDA error: an illegal memory access was encountered", "CUDA error: out of memory"):
        with pytest.raises(RuntimeError, match="CUDA error"):
            processes._together(partial(_fail, RuntimeError(message)))
    with pytest.raises(processes.LostAnother, match="Connection closed by peer"):
        processes._together(partial(_fail, RuntimeError("Connection closed by peer")))


def _fail(error: Exception) -> None:
    raise error


def _exchanged(x: torch.Tensor, other: int) -> torch.Tensor:
    """`x` with its first entry in the place of another one."""
    x = x.clone()
    x[[0, other]] = x[[other, 0]]
    return x


LARGE = torch.arange(600_000, dtype=torch.float32)  # more than two pieces


@pytest.mark.parametrize(
    "there",
    [
        {"b": _exchanged(LARGE, 1)},
        {"b": _exchanged(LARGE, 8191)},
        {"b": _exchanged(LARGE, processes.PIECE // 4)},
        {"b": _exchanged(LARGE, 2 * processes.PIECE // 4 + 7)},
        {"b": LARGE.index_fill(0, torch.tensor(500_000), 500_000.03125)},  # the last bit
        {"b": LARGE.index_fill(0, torch.tensor(0), -0.0)},
        {"a": torch.tensor(2), "c": torch.tensor(1)},  # exchanged weights
        {"d": torch.tensor([True, False])},
        {"e": torch.tensor([1.0, 1.0078125], dtype=torch.bfloat16)},
        {"g": torch.tensor([0.99610901, 1.0])},  # as many in the sum of their bytes
        {},
    ],
)
def test_weights_that_are_no_longer_the_same_end_the_run(monkeypatch, there: dict[str, torch.Tensor]) -> None:
    """Also those whose sums are: the first that differs is named. What is no tensor is not compared."""
    weights = {"a": torch.tensor(1), "b": LARGE, "c": torch.tensor(2), "d": torch.tensor([False, True])}
    weights |= {"e": torch.ones(2, dtype=torch.bfloat16), "f": torch.zeros(0)}
    weights["g"] = torch.tensor([1.0, 0.99610901])
    heard = []
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "objects", lambda mine: heard.append(mine) or [heard[0], mine])
    processes.require_same({**weights, "size": torch.Size([3])})
    first = rf"\(first {next(iter(there), '')}, {len(there)} in all\)"
    line = f"weights of process 1 are no longer those of process 0 {first}"
    with pytest.raises(UserError, match=line) if there else nullcontext():
        processes.require_same({**weights, **there, "size": torch.Size([4])})


def test_comparing_weights_takes_little_memory(monkeypatch) -> None:
    made = []

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            out = func(*args, **(kwargs or {}))
            if (
                isinstance(out, torch.Tensor)
                and out.untyped_storage().data_ptr() != large.untyped_storage().data_ptr()
            ):
                made.append(out.nbytes)
            return out

    large = torch.zeros(8_000_000)
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "objects", lambda mine: [mine, mine])
    with Watch():
        processes.require_same({"large": large})
    assert made and max(made) <= 8 * processes.PIECE < large.nbytes


def test_what_to_do_after_a_killed_process_is_what_can_be_done(monkeypatch, tmp_path: Path) -> None:
    told = []
    monkeypatch.setattr(launching, "launch_verb", lambda command, gpus, device, advice: told.append(advice))
    monkeypatch.setattr(launching, "run_folder", lambda _: tmp_path)
    launching.launch([], ["scale=smoke", "device=cpu", "plugins=[mine]"], 2, "cpu")
    (advice,) = told
    assert advice() == "nothing was saved before; start it again"
    save(tmp_path / "checkpoints" / "latest")
    assert advice().startswith("go on from the last checkpoint: ")
    assert advice().endswith(f"train resume={tmp_path} 'plugins=[mine]'")


def test_processes_end_with_who_has_started_them(tmp_path: Path) -> None:
    """Killed, it can tell them nothing; they would hold GPUs and the run's folder."""
    note = tmp_path / "started"

    def launch() -> None:
        if os.fork():
            time.sleep(60)
        several.end_with(os.getppid(), every=0.05)
        note.write_text(str(os.getpid()))
        time.sleep(60)

    launcher, ends = Fork(launch, cwd=tmp_path, log=tmp_path / "log"), time.monotonic() + 30
    while not (note.is_file() and note.read_text()) and time.monotonic() < ends:
        time.sleep(0.02)
    started = int(note.read_text())
    time.sleep(0.3)
    os.kill(started, 0)  # it lives as long as the other does
    os.kill(launcher.pid, signal.SIGKILL)
    launcher.wait(10)
    while Path(f"/proc/{started}").exists() and time.monotonic() < ends:
        time.sleep(0.02)
    assert not Path(f"/proc/{started}").exists()
