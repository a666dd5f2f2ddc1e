"""Jobs of two processes by the command line: what they save, how they go on, and what ends them."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict

from forks import TRAIN, job_in_fork, script, spare, torchrun, torchrun_in_fork, train_in_fork
from franka_wm.console import quoted, resuming
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.evaluation.protocol import evaluate_agent
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.load import load_agent

SMOKE = [
    "env=reach", "scale=smoke", "device=cpu", "env.episode_length=12", "evaluation.episodes=4", "evaluation.during=[]",
    "evaluation.video_episodes=0", "logger=none",
]  # fmt: skip
pytestmark = [pytest.mark.slow]


class Forks:
    """``train.py gpus=2 …`` in a fork, as are the processes that it starts; one at a time.

    Args:
        folder: Where it writes, in the working directory.
        overrides: Options.
        before: In place of `gpus=2`, torchrun's own options.
        hosts: So many, at each of which torchrun is told the same.
    """

    def __init__(self, folder: Path, *overrides: str, before: tuple[str, ...] = (), hosts: int = 1) -> None:
        words = (*SMOKE, *overrides, f"hydra.run.dir={quoted(str(folder))}")
        alone = torchrun_in_fork(script(TRAIN, *words))
        work = torchrun(*before, str(TRAIN), *words, hosts=hosts) if before else alone
        self._place = folder.parent
        self.pid = spare().begin(work, self._place, folder.parent / "log")

    def workers(self) -> dict[int, int]:
        """Rank -> process number, of those that live."""
        files = {k: self._place / f"rank{k}.pid" for k in range(2)}
        found = {k: int(file.read_text()) for k, file in files.items() if file.exists()}
        return {rank: pid for rank, pid in found.items() if Path(f"/proc/{pid}").exists()}

    def finished(self, status: int) -> str:
        """What it has said, when it has ended with this status."""
        done = spare().end()
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr


def saved(folder: Path) -> None:
    """Waits for the first checkpoint of a job."""
    for _ in range(1200):
        if (folder / "checkpoints" / "latest" / "manifest.json").exists():
            return
        time.sleep(0.1)
    raise AssertionError("no checkpoint")


def checkpoint(folder: Path) -> Checkpoint:
    return load_checkpoint(latest_checkpoint(folder))


def bits(folder: Path) -> dict[str, bytes]:
    """What two runs must have in common to the bit: weights, optimiser, experience, worlds and random numbers."""
    names = [
        "model",
        "optimizer",
        *(f"{name}{k}" for name in ("replay", "rng") for k in ("", 1)),
        "moment1",
    ]
    place = latest_checkpoint(folder)
    found = {name: (place / f"{name}.safetensors").read_bytes() for name in names}
    first = load_file(
        place / "extra.safetensors"
    )  # the first process's moment, and what was logged: it has times
    return found | {
        name: x.numpy().tobytes() for name, x in first.items() if not name.startswith("extra/rows/")
    }


def run(folder: Path, *overrides: str, count: int = 2) -> str:
    """What a job has said that ended well; its processes are forks, without torchrun."""
    kept = (
        [] if any("resume=" in one for one in overrides) else [*SMOKE, "export=lerobot", "export.workers=1"]
    )
    arguments = [*kept, *overrides, f"hydra.run.dir={quoted(str(folder))}"]
    start = train_in_fork if count == 1 else functools.partial(job_in_fork, count)
    done = start(*arguments, cwd=folder.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run of 40 updates by two processes, and what they have gathered as a dataset."""
    folder = tmp_path_factory.mktemp("jobs") / "whole"
    said = run(folder, "trainer.updates=40")
    assert said.count("results in") == 1 and said.count("updates 40/40") == 1  # one speaks
    return folder


def test_a_world_of_the_job_sees_the_same_episodes_wherever_it_is() -> None:
    config = FrankaConfig(observations=("state",), goal_sampling="reachable", episode_length=3)

    def played(worlds: int, first: int) -> TensorDict:
        env = FrankaEnv(config, num_envs=worlds, seed=7, first_world=first, device="cpu")
        actions = torch.linspace(-1, 1, 4 * 7).view(4, 7)[first : first + worlds]
        return env.rollout(7, lambda td: td.set("action", actions), break_when_any_done=False)

    together, second = played(4, 0), played(2, 2)
    for key in ("state", "goal"):
        assert torch.equal(together[key][2:], second[key])
    assert not torch.equal(together["goal"][:2], second["goal"])


def test_the_checkpoint_holds_the_parts_of_all(whole) -> None:
    found = checkpoint(whole)
    assert found.processes == 2 and found.config["gpus"] == 2
    parts = [found.replay(rank=k) for k in range(2)]
    together = found.replay()
    assert together is not None and parts[0] is not None and parts[1] is not None
    assert [len(one) for one in (*parts, together)] == [4, 4, 8]
    assert torch.equal(together["state"][4:], parts[1]["state"])
    assert not torch.equal(parts[0]["state"], parts[1]["state"])
    assert found.counters["env_steps"] == together.numel()  # of the whole job
    assert not torch.equal(*(torch.as_tensor(found._tree(name)["torch"]) for name in ("rng", "rng1")))


def test_the_dataset_holds_what_all_have_gathered(whole) -> None:
    rows = pd.concat([pd.read_parquet(file) for file in (whole / "dataset" / "data").rglob("*.parquet")])
    played = checkpoint(whole).replay()
    assert played is not None
    first = rows.sort_values("index").groupby("episode_index").first()
    worlds = np.stack(first["seed"].to_list())[:, 1]
    ends = played.shape[1] // 12
    assert sorted(worlds) == [world for world in range(8) for _ in range(ends)] and ends
    for world, state in zip(worlds, first["observation.state"], strict=True):
        starts = played["state"][world][played["is_init"][world, :, 0]]
        assert (starts[:, : len(state)] == torch.tensor(state)).all(-1).any()


def test_the_table_is_that_of_one_process(whole) -> None:
    table = json.loads((whole / "evaluation.json").read_text())["policies"]
    found = evaluate_agent(load_agent(whole), episodes=4, timing=False).policies
    again = json.loads(json.dumps(found))
    for policy in ("noop", "random"):
        assert table[policy] == again[policy]
    for policy in (
        "ik",
        "planner",
        "policy",
    ):  # matrix products of two worlds are rounded otherwise than those of four
        for name in ("final_distance", "return"):
            assert table[policy][name] == pytest.approx(again[policy][name], rel=1e-3)


def acts_in_evaluation(folder: Path, what: str) -> None:
    """A plugin by which the second process does something in each evaluation."""
    (folder / "acts.py").write_text(
        "import os, signal\n"
        "from franka_wm.evaluation import protocol\n"
        "def acting(*arguments, **options):\n"
        f"    {what}\n"
        "    return play(*arguments, **options)\n"
        "if os.environ.get('RANK') == '1':\n"
        "    play, protocol.play_episodes = protocol.play_episodes, acting\n"
    )


def test_an_exception_in_the_evaluation_of_one_process_ends_all(tmp_path) -> None:
    acts_in_evaluation(tmp_path, "raise KeyError('of a plugin')")
    folder = tmp_path / "run"
    said = Forks(folder, "gpus=2", "plugins=[acts]", "trainer.updates=4").finished(1)
    assert "KeyError: 'of a plugin'" in said and not (folder / "evaluation.json").exists()
    assert checkpoint(folder).counters["updates"] == 4


def test_a_signal_in_an_evaluation_saves_all(tmp_path) -> None:
    acts_in_evaluation(tmp_path, "os.kill(os.getpid(), signal.SIGTERM)")
    folder, curves = tmp_path / "run", ("evaluation.during=[policy]", "evaluation.every=4")
    said = Forks(folder, "gpus=2", "plugins=[acts]", "trainer.updates=400", *curves).finished(130)
    assert said.count("stopped; go on with") == 1 and said.count("eval/policy/return") == 1
    assert checkpoint(folder).counters["updates"] == 10  # those of a batch


def test_a_signal_in_the_last_evaluation_leaves_what_can_go_on(tmp_path) -> None:
    acts_in_evaluation(tmp_path, "os.kill(os.getpid(), signal.SIGTERM)")
    folder, again = tmp_path / "run", tmp_path / "again"
    said = Forks(folder, "gpus=2", "plugins=[acts]", "trainer.updates=4").finished(1)
    assert re.search(r"process \d of the run .* was ended by SIGTERM.*resume=", said), said
    assert not (folder / "evaluation.json").exists()
    run(again, f"resume={folder}", "plugins=[]")
    assert (again / "evaluation.json").exists()


@pytest.fixture(scope="module")
def half(tmp_path_factory) -> Path:
    """The first 20 of those updates."""
    folder = tmp_path_factory.mktemp("jobs") / "half"
    run(folder, "trainer.updates=20")
    return folder


def test_going_on_is_exact(whole, half, tmp_path) -> None:
    again = tmp_path / "again"
    run(again, f"resume={half}", "trainer.updates=40")
    one, other = bits(whole), bits(again)
    assert [name for name in one if one[name] != other[name]] == []


def test_another_number_of_processes_goes_on(half, tmp_path) -> None:
    """Two, then one, then two: weights and optimiser as they were, every world with its experience."""
    one, two = tmp_path / "one", tmp_path / "two"
    said = run(one, f"resume={half}", "gpus=1", "trainer.updates=20", count=1)
    assert "the checkpoint is of 2 processes, here are 1" in said
    for name in ("model", "optimizer"):
        file = f"{name}.safetensors"
        assert (latest_checkpoint(one) / file).read_bytes() == (latest_checkpoint(half) / file).read_bytes()
    before, after = checkpoint(half).replay(), checkpoint(one).replay()
    assert before is not None and after is not None and torch.equal(before["state"], after["state"])
    run(two, f"resume={one}", "trainer.updates=24")
    longer = checkpoint(two).replay()
    assert longer is not None and checkpoint(two).processes == 2
    assert torch.equal(longer["state"][:, : after.shape[1]], after["state"])  # no world is lost or exchanged


@pytest.mark.parametrize("to", ["SIGTERM to one", "Ctrl-C", "SIGTERM to all, the launcher last"])
def test_a_signal_saves_all(tmp_path, to) -> None:
    folder = tmp_path / "stopped"
    job = Forks(folder, "gpus=2", "trainer.updates=100000", "trainer.checkpoint_every=1")
    saved(folder)
    if to == "Ctrl-C":
        os.kill(job.pid, signal.SIGINT)
    else:
        workers = job.workers()
        for one in [workers[1]] if to == "SIGTERM to one" else workers.values():
            os.kill(one, signal.SIGTERM)
    if to.endswith("last"):
        time.sleep(0.1)  # it passes it on: each is told twice
        os.kill(job.pid, signal.SIGTERM)
    said = job.finished(143 if to.endswith("last") else 130)
    assert said.count("stopped; go on with") == 1
    updates = checkpoint(folder).counters["updates"]
    assert checkpoint(folder).processes == 2
    more = tmp_path / "more"
    run(more, f"resume={folder}", f"trainer.updates={int(updates) + 3}")


def test_a_killed_process_ends_the_others(tmp_path) -> None:
    folder = tmp_path / "killed"
    job = Forks(folder, "gpus=2", "trainer.updates=100000", "trainer.checkpoint_every=1")
    saved(folder)
    number = job.workers()[1]
    os.kill(number, signal.SIGKILL)
    started = time.monotonic()
    said = job.finished(1)
    assert time.monotonic() - started < 60
    advice = re.search(rf"process 1 of the run \(pid {number}\) was ended by SIGKILL.*(resume=\S+)", said)
    assert advice is not None, said
    updates = int(checkpoint(folder).counters["updates"])
    assert not job.workers()
    run(tmp_path / "on", advice[1], f"trainer.updates={updates + 2}")


def two_hosts() -> tuple[str, ...]:
    """What torchrun is told on each."""
    with socket.socket() as one:
        one.bind(("localhost", 0))
        port = one.getsockname()[1]
    meeting = ("--rdzv-backend=c10d", f"--rdzv-endpoint=localhost:{port}", "--rdzv-id=7")
    return ("--nnodes=2", "--nproc-per-node=1", "--local-addr=localhost", *meeting)


def test_torchrun_starts_a_job_anew(tmp_path) -> None:
    """Two agents as two hosts; after a process has died, all begin again from what was saved, as resumed by hand."""
    folder, before, again = (tmp_path / name for name in ("anew", "before", "again"))
    updates = ("trainer.updates=80", "trainer.checkpoint_every=0.2")
    job = Forks(folder, *updates, before=(*two_hosts(), "--max-restarts=1"), hosts=2)
    saved(folder)
    ended = job.workers()
    os.kill(ended[1], signal.SIGKILL)
    while any(Path(f"/proc/{pid}").exists() for pid in ended.values()):
        time.sleep(0.02)
    shutil.copytree(folder, before)  # those that begin anew take seconds to build their worlds
    said = job.finished(0)
    assert f"started anew: going on from {folder}" in said and "updates 80/80" in said
    assert checkpoint(folder).counters["updates"] == 80
    left = checkpoint(before).counters["updates"]
    assert 0 < left < 80
    run(again, f"resume={before}")
    one, other = bits(folder), bits(again)
    assert [name for name in one if one[name] != other[name]] == []


def test_one_process_that_torchrun_starts_anew_goes_on(tmp_path) -> None:
    folder = tmp_path / "anew"
    nodes = ("--standalone", "--nproc-per-node=1", "--max-restarts=1")
    job = Forks(folder, "trainer.updates=80", "trainer.checkpoint_every=0.2", before=nodes)
    saved(folder)
    os.kill(job.workers()[0], signal.SIGKILL)
    said = job.finished(0)
    assert f"started anew: going on from {folder}" in said and "updates 80/80" in said


@pytest.mark.parametrize("count", [1, 2])
def test_torchrun_does_not_begin_a_stopped_job_again(count: int, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "stopped"
    nodes = ("--standalone", f"--nproc-per-node={count}", "--max-restarts=1")
    job = Forks(folder, "trainer.updates=100000", "trainer.checkpoint_every=1", before=nodes)
    saved(folder)
    os.kill(job.workers()[count - 1], signal.SIGTERM)
    said = job.finished(1)
    monkeypatch.chdir(tmp_path)  # as it was
    line = f"stopped; go on with: {resuming(folder, {})}"
    assert said.count(line) == 2  # when it stops, and when it is started anew
    assert re.search(rf"error: (process 1: )?{line}", said)
    assert (folder / "stopped.txt").read_text() == f"{line}\n"


def test_an_exception_in_one_process_ends_all(tmp_path) -> None:
    """Of the second, whose threads would keep it alive."""
    (tmp_path / "breaks.py").write_text(
        "import os, threading, time\n"
        "from franka_wm.training.learner import Learner\n"
        "def broken(self, *arguments, **options):\n"
        "    if os.environ['RANK'] == '1':\n"
        "        threading.Thread(target=time.sleep, args=(1000,)).start()\n"
        "        raise KeyError('of a plugin')\n"
        "    update(self, *arguments, **options)\n"
        "if 'RANK' in os.environ:\n"
        "    update, Learner.update = Learner.update, broken\n"
    )
    folder = tmp_path / "run with spaces, [brackets]"
    said = Forks(folder, "gpus=2", "plugins=[breaks]").finished(1)
    assert "KeyError: 'of a plugin'" in said and (folder / "config.yaml").is_file()


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["gpus=2", "device=auto"], "gpus=2: this machine has 0 usable CUDA devices"),
        (
            ["gpus=2", "device=auto", "seed=0,1", "--multirun"],
            "job 0 (seed=0): gpus=2: this machine has 0 usable CUDA",
        ),
    ],
)
def test_what_cannot_be_started_is_one_line(tmp_path, overrides, says) -> None:
    if torch.cuda.is_available():
        pytest.skip("there are GPUs")
    folder = tmp_path / "none"
    said = Forks(folder, *overrides).finished(1)
    assert [line for line in said.splitlines() if says in line] and "Traceback" not in said
    assert not folder.exists()


def test_other_options_in_another_process_are_refused(tmp_path) -> None:
    """Of processes that torchrun starts from a shell, none of which is a fork."""
    folder, jobs = tmp_path / "two", []
    nodes = (sys.executable, "-m", "torch.distributed.run", *two_hosts(), str(TRAIN), *SMOKE)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
    for k in range(2):
        with folder.with_suffix(f".log{k}").open("w") as out:
            command = [*nodes, f"seed={k}", f"hydra.run.dir={folder}"]
            jobs.append(subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment))
    assert all(job.wait(timeout=240) for job in jobs)
    for k in range(2):  # on each host, since one looks at one of them
        said = folder.with_suffix(f".log{k}").read_text()
        assert said.count("has options") == 1 and "start all of a job with the same command" in said, (
            k,
            said,
        )
    assert not folder.exists()


def test_who_leaves_takes_its_semaphores_along(tmp_path) -> None:
    """Python would tell of them, after a run that has ended well, once for each process."""
    text = f"""
import multiprocessing
from torch import distributed
from franka_wm import processes
if __name__ == "__main__":
    distributed.init_process_group("gloo", init_method="file://{tmp_path}/meeting", rank=0, world_size=1)
    shared = multiprocessing.get_context("spawn").Value("i", 0)
    processes.leave()
"""
    (tmp_path / "leaves.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "leaves.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
