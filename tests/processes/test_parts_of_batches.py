"""Two processes with half of each batch learn what one process learns from all of it, in every family."""

from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
import torch

from forks import ranks_in_forks
from parts_of_batches import FAMILIES, learn, together

MESSAGES = {
    "tdmpc2": 2,
    "tdmpc2, demonstrations": 3,
    "muzero": 1,
    "dreamer": 2,
    "lewm": 8,
    "lewm, contrastive": 12,
    "action_world_model": 6,
    "jepa": 1,
    "lejepa": 6,
    "vicreg": 11,
    "dino_wm": 1,
}
"""Family -> how many an update sends: that of the gradients, and statistics, which wait for each other."""


def _learned(folder, *, cuda: bool):
    done = ranks_in_forks([partial(together, folder, cuda=cuda)] * 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return torch.load(folder / "learned.pt", weights_only=True)


@pytest.fixture(scope="module")
def learned(tmp_path_factory) -> dict[str, tuple[dict[str, torch.Tensor], int]]:
    """Family -> weights that two processes have learned together, and the messages of one update."""
    return _learned(tmp_path_factory.mktemp("processes"), cuda=False)


@pytest.fixture(scope="module")
def learned_on_gpus(tmp_path_factory) -> dict[str, tuple[dict[str, torch.Tensor], int]]:
    """The same of two GPUs."""
    if torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    return _learned(tmp_path_factory.mktemp("gpus"), cuda=True)


def _compare(alone: dict[str, torch.Tensor], together: dict[str, torch.Tensor]) -> None:
    assert alone.keys() == together.keys()
    for key, value in alone.items():
        torch.testing.assert_close(
            together[key], value, rtol=1e-7, atol=1e-8, msg=lambda m, k=key: f"{k}: {m}"
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_parts_of_a_batch_teach_what_the_whole_does(learned, name):
    _compare(learn(name)[0], learned[name][0])


@pytest.mark.gpu
@pytest.mark.parametrize("name", FAMILIES)
def test_gpus_learn_what_one_does(learned_on_gpus, name):
    """Also inside a captured update."""
    _compare(learn(name, "cuda")[0], learned_on_gpus[name][0])


@pytest.mark.slow
def test_an_update_sends_few_messages(learned):
    assert {name: messages for name, (_, messages) in learned.items()} == {k: MESSAGES[k] for k in FAMILIES}


def test_the_cost_model_reckons_with_them(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    reckoned = import_module("scale").MESSAGES
    assert reckoned["LeWorldModel"] == MESSAGES["lewm"]
    assert reckoned["TD-MPC2"] == reckoned["TD-MPC2, images"] == MESSAGES["tdmpc2"]
