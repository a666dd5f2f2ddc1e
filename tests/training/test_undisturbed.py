"""Same seed, same weights: whatever is evaluated or logged, and however fast the machine is."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from franka_wm.commands.main import main
from franka_wm.seeding import seeded
from franka_wm.training.checkpoint import Checkpoint
from franka_wm.training.history import read_rows


def weights(checkpoint: Checkpoint) -> dict[str, torch.Tensor]:
    return load_file(checkpoint.folder / "model.safetensors")


def assert_same_weights(one: Checkpoint, other: Checkpoint) -> None:
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


OTHERWISE = {
    "more, oftener": ("evaluation.during=[policy,planner,random,ik]", "evaluation.every=1"),
    "other numbers of episodes": ("evaluation.during=[policy,random]", "evaluation.episodes=3"),
    "at steps": ("evaluation.during=[planner]", "evaluation.at_steps=[31]"),
    "every line": ("evaluation.during=[]", "trainer.log_every=1e-6"),
    "saved often": ("evaluation.during=[]", "trainer.checkpoint_every=1e-6"),
}


@pytest.fixture(scope="module")
def kept() -> dict[str, dict[str, torch.Tensor]]:
    return {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actor", "name"),
    [("policy", name) for name in OTHERWISE] + [(actor, "more, oftener") for actor in ("random", "planner")],
)
def test_what_is_looked_at_does_not_change_the_weights(actor: str, name: str, kept, train, tmp_path) -> None:
    actor = f"collector.policy={actor}"
    if actor not in kept:  # a run that nobody looks at
        kept[actor] = weights(train(actor, "evaluation.during=[]", folder=tmp_path / "alone"))
    run = train(actor, *OTHERWISE[name])
    if "during=[]" not in OTHERWISE[name][0]:
        rows = read_rows(run)
        assert any(key.startswith("eval/") for row in rows for key in row)
    if "log_every" in OTHERWISE[name][1]:
        assert len(read_rows(run)) == 3
    got = weights(run)
    assert [key for key in got if not torch.equal(got[key], kept[actor][key])] == []


def test_other_simulators_are_not_disturbed_either(train, tmp_path: Path) -> None:
    pytest.importorskip("gymnasium")
    gym = ("env=gym", "env.name=Pendulum-v1", "env.episode_length=8")
    alone = train(*gym, "evaluation.during=[]", folder=tmp_path / "alone")
    watched = train(*gym, "evaluation.during=[policy,random]", "evaluation.every=1", "evaluation.episodes=3")
    assert_same_weights(alone, watched)


def test_another_seed_gives_other_weights(train, tmp_path: Path) -> None:
    one, other = (
        weights(train(f"seed={k}", "evaluation.during=[]", folder=tmp_path / str(k))) for k in (0, 1)
    )
    assert any(not torch.equal(one[name], other[name]) for name in one)


def test_validation_losses_do_not_change_the_weights(train, tmp_path: Path) -> None:
    """They draw random numbers, one set for each line of the log."""
    arguments = [
        "collect",
        f"out={tmp_path}/data",
        "env=reach_fixed",
        "episodes=6",
        "num_envs=3",
        "workers=0",
    ]
    assert main([*arguments, "env.substeps=1", "env.episode_length=8", "device=cpu", "seed=0"]) == 0
    data = ["trainer=offline", "dataset=lerobot", f"dataset.root={tmp_path}/data", "dataset.workers=1"]
    data += [f"dataset.cache_dir={tmp_path}/cache", "env=reach_fixed", "dataset.validation_fraction=0.3"]
    data += ["trainer.updates=6", "trainer.updates_per_batch=1"]
    runs = [
        train(*data, f"trainer.log_every={seconds}", folder=tmp_path / str(seconds))
        for seconds in (1e9, 1e-6)
    ]
    counts = [sum("validation/loss" in row for row in read_rows(run)) for run in runs]
    assert counts == [1, 6]
    assert_same_weights(*runs)


def test_global_generators_are_put_back() -> None:
    torch.manual_seed(3)
    random.seed(3)
    np.random.seed(3)
    expected = torch.rand(2), random.random(), np.random.rand()
    torch.manual_seed(3)
    random.seed(3)
    np.random.seed(3)
    with seeded(0):
        inside = torch.rand(2), random.random(), np.random.rand()
    with pytest.raises(KeyboardInterrupt), seeded(0):
        assert torch.equal(torch.rand(2), inside[0]) and random.random() == inside[1]
        assert np.random.rand() == inside[2]
        raise KeyboardInterrupt
    assert torch.equal(torch.rand(2), expected[0])
    assert (random.random(), np.random.rand()) == expected[1:]


def test_evaluation_every_eighth_of_a_run(settled) -> None:
    assert settled("scale=laptop", "trainer.updates=8000").evaluation_period == 1000
    assert settled("scale=gpu", "trainer.updates=9").evaluation_period == 2
    assert settled("evaluation.every=7").evaluation_period == 7
