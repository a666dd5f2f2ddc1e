"""Dreamer's loss compiled part by part is its loss; TD-MPC2's: tests/training/test_learner.py."""

from collections import Counter
from functools import partial
from typing import Any

import pytest
import torch

from franka_wm.models import make
from franka_wm.models.dreamer import Dreamer
from small_tdmpc2 import windows


def small(actor_gradient: str) -> Dreamer:
    torch.manual_seed(0)
    model = make(
        "dreamer", observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, deter_dim=16,
        hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, imagination=4, actor_gradient=actor_gradient,
    )  # fmt: skip
    assert isinstance(model, Dreamer)
    with torch.no_grad():
        for head in (model.reward_head, model.critic):
            head[-1].weight.normal_(std=0.5)
    return model.eval()


@pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"])
def test_each_part_is_one_program_and_the_numbers_are_the_same(actor_gradient, monkeypatch):
    """Without a break of the graph, which a captured update could not replay."""
    calls, whole = Counter(), partial(torch.compile, backend="eager", fullgraph=True)

    def compile(part: Any) -> Any:
        program = whole(part)

        def counted(*given: Any) -> Any:
            calls[part.__name__] += 1
            return program(*given)

        return counted

    monkeypatch.setattr(torch, "compile", compile)
    batch, found = windows(batch=3, horizon=4), []
    for compiled in (False, True):
        model = small(actor_gradient)
        torch.manual_seed(1)
        losses = (model.compiled_loss() if compiled else model.loss)(batch)
        losses["loss"].backward()
        grads = {f"of {name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
        found.append({**losses.detach(), **grads})
    assert calls["_seen"] == 5 and calls["_dreamed"] == 4  # steps of a window and of imagination
    assert set(calls) == set(model.parts_of_loss)
    assert found[0].keys() == found[1].keys()
    for name, value in found[0].items():
        torch.testing.assert_close(found[1][name], value, msg=lambda text, name=name: f"{name}: {text}")


def test_a_subclass_with_a_loss_of_its_own_is_compiled_whole(monkeypatch):
    class Other(Dreamer):
        def loss(self, batch):  # type: ignore[override]
            return super().loss(batch)

    compiled = []
    monkeypatch.setattr(torch, "compile", lambda part: compiled.append(part.__qualname__) or part)
    Other(observation_sizes={"state": 3}, action_dim=2).compiled_loss()
    assert [name.split(".")[-2:] for name in compiled] == [["Other", "loss"]]
