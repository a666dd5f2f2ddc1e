"""Jobs that train on a dataset: the processes divide each batch, and learn the same weights."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from forks import job_in_fork, train_in_fork
from franka_wm.commands.main import main
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

pytestmark = [pytest.mark.slow]
ARM = ["env=reach_fixed", "scale=smoke", "device=cpu", "env.substeps=1", "env.episode_length=8"]
UPDATES = 12
# Each process keeps the windows of its updates, and the weights that it ends with.
NOTES = """
import torch
from franka_wm import processes
from franka_wm.training.learner import Learner
from franka_wm.training.trainer import Trainer
update, save, learned = Learner.update, Trainer.save, []
def noted(self, batch, *arguments, **options):
    learned.append(torch.cat((batch["state"], batch["next", "state"], batch["action"]), -1))
    return update(self, batch, *arguments, **options)
def kept(self, **options):
    notes = {"learned": torch.stack(learned), "weights": dict(self.model.state_dict())}
    torch.save(notes, self.folder / f"notes{processes.rank()}.pt")
    return save(self, **options)
Learner.update, Trainer.save = noted, kept
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with a dataset of six episodes, and the plugin."""
    place = tmp_path_factory.mktemp("offline")
    assert (
        main(["collect", f"out={place}/data", *ARM, "episodes=6", "num_envs=3", "seed=0", "workers=0"]) == 0
    )
    (place / "notes.py").write_text(NOTES)
    return place


def run(place: Path, name: str, *words: str, count: int) -> list[dict[str, Any]]:
    """The notes of each process of a job."""
    start = train_in_fork if count == 1 else partial(job_in_fork, count)
    done = start("plugins=[notes]", *words, f"hydra.run.dir={place / name}", cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    return [torch.load(place / name / f"notes{rank}.pt") for rank in range(count)]


def offline(place: Path, name: str, *words: str, count: int) -> list[dict[str, Any]]:
    data = ["trainer=offline", "dataset=lerobot", f"dataset.root={place}/data", "dataset.workers=1"]
    data += [f"dataset.cache_dir={place}/cache", "trainer.updates_per_batch=3", "evaluation.episodes=4"]
    data += ["evaluation.during=[]", "evaluation.video_episodes=0", "logger=none"]
    return run(place, name, *ARM, *data, *words, count=count)


@pytest.fixture(scope="module")
def two(place) -> list[dict[str, Any]]:
    return offline(place, "two", f"trainer.updates={UPDATES}", count=2)


def test_processes_divide_each_batch_and_end_with_the_same_weights(place, two) -> None:
    (alone,) = offline(place, "one", f"trainer.updates={UPDATES}", count=1)
    halves = [one["learned"] for one in two]
    assert alone["learned"].shape[:2] == (UPDATES, 2 * halves[0].shape[1])
    assert torch.equal(torch.cat(halves, dim=1), alone["learned"])
    first, second = (one["weights"] for one in two)
    assert first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)
    found = load_checkpoint(latest_checkpoint(place / "two"))
    assert found.processes == 2 and found.counters["updates"] == UPDATES
    table = json.loads((place / "two" / "evaluation.json").read_text())["policies"]
    assert table["planner"]["final_distance"]["mean"] > 0


def test_a_job_goes_on_with_the_windows_that_follow(place, two) -> None:
    offline(place, "half", f"trainer.updates={UPDATES // 2}", count=2)
    words = (f"resume={place}/half", f"trainer.updates={UPDATES}")
    for again, whole in zip(run(place, "again", *words, count=2), two, strict=True):
        assert torch.equal(again["learned"], whole["learned"][UPDATES // 2 :])
        assert all(torch.equal(again["weights"][key], value) for key, value in whole["weights"].items())
