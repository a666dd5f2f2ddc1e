"""The examples, run as their own first lines say."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from forks import TRAIN, module, run_in_fork, script, spare


def run(root: Path, *arguments: str) -> str:
    """What the command prints; it must end well."""
    done = run_in_fork(script(root / arguments[0], *arguments[1:]), cwd=root)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_use_the_environment(root: Path) -> None:
    out = run(root, "examples/use_the_environment.py")
    centimetres = float(out.split("steps: ")[1].split(" cm")[0])
    assert centimetres < 5  # by inverse kinematics, in 20 steps
    assert "(64, 32, 32, 3)" in out


@pytest.mark.slow
def test_train_from_a_dataset(root: Path, tmp_path: Path) -> None:
    from franka_wm.commands.main import main

    made = ["collect", f"out={tmp_path}/set", "episodes=12", "policy=random", "env=reach", "num_envs=4"]
    assert main([*made, "env.episode_length=10", "env.substeps=1"]) == 0
    out = run(root, "examples/train_from_a_dataset.py", f"{tmp_path}/set", "20")
    losses = [float(line.split("loss ")[1].split()[0]) for line in out.splitlines() if "loss" in line]
    assert len(losses) == 10 and losses[-1] < losses[0]


CONF = "hydra.searchpath=[file://examples/conf]"
RUN = (
    "scale=smoke", "logger=none", "device=cpu", "evaluation.video_episodes=0", "evaluation.during=[]",
    "evaluation.episodes=2", "trainer.updates=10", "env.episode_length=12",
)  # fmt: skip


@pytest.mark.slow  # four runs of train.py
@pytest.mark.parametrize(
    "arguments",
    [
        ("plugins=[examples.add_a_task]", "env.task=raise_tool"),
        ("plugins=[examples.add_a_model]", CONF, "model=linear", "collector.policy=planner"),
        ("plugins=[examples.add_a_planner]", CONF, "planner=shooting"),
        (
            "plugins=[examples.add_a_model,examples.add_a_planner]",
            CONF,
            "model=linear",
            "planner=shooting",
            "collector.policy=planner",
        ),
    ],
    ids=["task", "model", "planner", "both"],
)
def test_add(arguments: tuple[str, ...], root: Path, tmp_path: Path) -> None:
    out = run(root, "train.py", *RUN, *arguments, f"hydra.run.dir={tmp_path}/run")
    assert (tmp_path / "run" / "evaluation.json").is_file()
    assert "planner" in out
    told = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    own = "env.task=raise_tool" in arguments
    assert ("height [m]" in out) is own and ("final distance" in out) is not own
    assert told["protocol"]["task"] == ("raise_tool" if own else "reach")
    assert ("final_distance" in told["policies"]["planner"]) is not own
    if own:  # what a run was trained with is imported only if it is asked for
        evaluate = [
            "evaluate",
            f"{tmp_path}/run",
            "episodes=2",
            "open_loop=false",
            "probes=false",
            "device=cpu",
        ]
        # In a fork of a process in which no test has imported the module.
        done = spare().fork(module("franka_wm", *evaluate), root)
        assert done.returncode == 1 and "plugins=[MODULE] imports its module" in done.stderr, done.stderr
        assert "height [m]" in run(root, "franka_wm/__main__.py", *evaluate, arguments[0])


def test_a_plugin_that_is_not_there(root: Path, tmp_path: Path) -> None:
    arguments = "plugins=[no_such_module]", f"hydra.run.dir={tmp_path}/run"
    done = run_in_fork(script(TRAIN, *arguments), root)
    assert done.returncode == 1 and "no_such_module" in done.stderr
    assert not (tmp_path / "run").exists()


STAND_INS = {
    "scontrol": 'echo "scontrol $*" >> said; [ "$1" = requeue ] || echo host1',
    "srun": """case "$1" in
    torchrun) echo "$OMP_NUM_THREADS $VIRTUAL $*" >> said; while [ ! -e stop ]; do sleep 0.05; done; exit 130;;
    *) echo "srun $*" >> said; touch stop;;
esac""",
}


def test_a_job_of_slurm_saves_before_its_time_is_up(root: Path, tmp_path: Path) -> None:
    """With stand-ins for SLURM: the signal reaches the processes, not torchrun; then the job is queued again."""
    (tmp_path / "bin").mkdir()
    for name, text in STAND_INS.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "activate").write_text("export VIRTUAL=mine\n")
    slurm = {
        "JOB_ID": "7",
        "JOB_NODELIST": "host[1-2]",
        "NNODES": "2",
        "GPUS_ON_NODE": "4",
        "CPUS_PER_TASK": "32",
    }
    environment = os.environ | {f"SLURM_{name}": value for name, value in slurm.items()}
    environment["PATH"] = f"{tmp_path}/bin:{os.environ['PATH']}"
    script = root / "examples/cluster/train.slurm"
    job = subprocess.Popen(["bash", str(script), "env=lift", "name=a b"], cwd=tmp_path, env=environment)
    said = tmp_path / "said"
    for _ in range(200):
        if said.is_file() and "torchrun" in said.read_text():
            break
        time.sleep(0.05)
    time.sleep(0.2)  # it waits for the run
    job.send_signal(signal.SIGUSR1)
    job.wait(timeout=30)
    lines = said.read_text().splitlines()
    assert lines[1].startswith("8 mine torchrun --nnodes=2 --nproc-per-node=4 ")
    assert lines[1].endswith(f"train.py env=lift name=a b hydra.run.dir={tmp_path}/outputs/7")
    ranks = f"-u train\\.py .*hydra\\.run\\.dir={tmp_path}/outputs/7"  # of this job alone, not of another one
    assert f"pkill -TERM -f -- {ranks}" in lines[2] and lines[3:] == ["scontrol requeue 7"]
    assert re.search(ranks, f"python -u train.py env=lift hydra.run.dir={tmp_path}/outputs/7")
