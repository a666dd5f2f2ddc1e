"""A loss compiled part by part is the loss, and leaves no part out."""

from collections import Counter
from typing import Any

import pytest
import torch

from franka_wm.models import make
from franka_wm.models.base import WorldModel
from franka_wm.models.tdmpc2 import TDMPC2
from small_tdmpc2 import windows

FAMILIES = {
    "tdmpc2": dict(latent_dim=16, hidden_dim=16, encoder_dim=16, num_q=2, bins=21),
    "dreamer": dict(
        deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, imagination=4
    ),
}


def small(family: str) -> WorldModel:
    torch.manual_seed(0)
    sizes = {"state": 3, "joint_target": 2}
    return make(family, observation_sizes=sizes, action_dim=2, discount=0.9, **FAMILIES[family]).eval()


@pytest.mark.parametrize("family", FAMILIES)
def test_each_part_is_compiled_and_called(family, monkeypatch):
    model, calls = small(family), Counter()

    def compile(part: Any) -> Any:
        def counted(*given: Any) -> Any:
            calls[part.__name__] += 1
            return part(*given)

        return counted

    monkeypatch.setattr(torch, "compile", compile)
    batch = windows(batch=3, horizon=4)
    torch.manual_seed(1)
    plain = model.loss(batch)
    torch.manual_seed(1)
    compiled = model.compiled_loss()(batch)
    assert set(calls) == set(model.parts_of_loss) and model.parts_of_loss
    for name, value in plain.items():
        torch.testing.assert_close(compiled[name], value)


def test_a_subclass_with_a_loss_of_its_own_is_compiled_whole(monkeypatch):
    class Other(TDMPC2):
        def loss(self, batch):  # type: ignore[override]
            return super().loss(batch)

    compiled = []
    monkeypatch.setattr(torch, "compile", lambda part: compiled.append(part.__qualname__) or part)
    options = FAMILIES["tdmpc2"]
    Other(observation_sizes={"state": 3}, action_dim=2, discount=0.9, **options).compiled_loss()  # type: ignore[arg-type]
    assert [name.split(".")[-2:] for name in compiled] == [["Other", "loss"]]
