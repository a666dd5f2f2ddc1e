"""Weights that are used again and again, cast once an update."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.models.dreamer import Dreamer
from franka_wm.models.precision import lowered
from franka_wm.training.learner import Learner
from small_tdmpc2 import windows

H = 3


def small() -> Dreamer:
    torch.manual_seed(0)
    return Dreamer(
        observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, deter_dim=16, hidden_dim=16, codes=3,
        classes=4, blocks=2, encoder_layers=2, bins=21, imagination=2,
    )  # fmt: skip


def batch() -> Any:
    torch.manual_seed(0)
    return windows(batch=4, horizon=H)


def test_weights_of_products_are_cast_and_come_back() -> None:
    model = small()
    before = dict(model.named_parameters())
    with pytest.raises(KeyError), lowered(model, torch.bfloat16):
        rssm = model.rssm
        for weight in (rssm.mix.weight, rssm.mix.bias, rssm.of_deter[0].weight, model.actor[0][0].bias):
            assert weight.dtype == torch.bfloat16
        assert rssm.mix_norm.weight is before["rssm.mix_norm.weight"]  # a norm computes in float32
        assert model.critic[0][0].weight is before["critic.0.0.weight"]  # used once
        raise KeyError  # as any error in a loss
    after = dict(model.named_parameters())
    assert all(after[name] is weight for name, weight in before.items()) and after.keys() == before.keys()


def test_weights_come_back_where_a_cast_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where memory runs out after some of them."""
    model, cast, calls = small(), torch.Tensor.to, []
    before = dict(model.named_parameters())

    def to(tensor: torch.Tensor, *kind: Any) -> torch.Tensor:
        calls.append(kind)
        if len(calls) == 3:
            raise torch.OutOfMemoryError
        return cast(tensor, *kind)

    monkeypatch.setattr(torch.Tensor, "to", to)
    with pytest.raises(torch.OutOfMemoryError), lowered(model, torch.bfloat16):
        pass
    after = dict(model.named_parameters())
    assert all(after[name] is weight for name, weight in before.items()) and after.keys() == before.keys()


def gradients(*, once: bool) -> dict[str, torch.Tensor]:
    model = small()
    torch.manual_seed(1)
    casts = lowered(model, torch.bfloat16) if once else nullcontext()
    with torch.autocast("cpu", torch.bfloat16, cache_enabled=False), casts:
        loss = model.loss(batch())["loss"]
    loss.backward()
    return {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


def test_gradients_are_those_of_casts_at_every_use() -> None:
    many, once = gradients(once=False), gradients(once=True)
    assert many.keys() == once.keys() and "rssm.mix.weight" in once
    for name, gradient in many.items():
        assert once[name].dtype == torch.float32
        error = (once[name] - gradient).norm() / gradient.norm().clamp_min(1e-6)
        assert error < 0.02, f"{name}: {error}"


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_learner_casts_them_once(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, seen = small(), []
    loss = model.loss

    def noted(data: TensorDictBase) -> Any:
        seen.append(str(model.rssm.mix.weight.dtype))
        return loss(data)

    monkeypatch.setattr(model, "loss", noted)
    Learner(model, precision=precision).update(batch())
    assert seen == [f"torch.{precision}"] and model.rssm.mix.weight.dtype == torch.float32
