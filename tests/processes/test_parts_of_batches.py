"""Two processes with half of each batch learn what one process learns from all of it, in every family."""

from functools import partial

import pytest
import torch

from forks import ranks_in_forks
from parts_of_batches import FAMILIES, learn, together


@pytest.fixture(scope="module")
def learned(tmp_path_factory) -> dict[str, dict[str, torch.Tensor]]:
    """Family -> weights that two processes have learned together."""
    folder = tmp_path_factory.mktemp("processes")
    done = ranks_in_forks([partial(together, folder)] * 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return torch.load(folder / "learned.pt", weights_only=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_parts_of_a_batch_teach_what_the_whole_does(learned, name):
    if "dino" in name:
        pytest.importorskip("transformers")
    alone = learn(name)
    assert alone.keys() == learned[name].keys()
    for key, value in alone.items():
        torch.testing.assert_close(
            learned[name][key], value, rtol=1e-7, atol=1e-8, msg=lambda m, k=key: f"{k}: {m}"
        )
