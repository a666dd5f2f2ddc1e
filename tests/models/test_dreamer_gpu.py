"""DreamerV3 on a GPU: the update as one CUDA graph."""

from typing import Any

import pytest
import torch

from franka_wm.models import dreamer, make
from franka_wm.models.dreamer import Dreamer
from franka_wm.models.precision import lowered
from franka_wm.training.learner import Learner
from small_tdmpc2 import windows

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"]),
]


def small(actor_gradient: str, **more: Any) -> Dreamer:
    torch.manual_seed(0)
    sizes = dict(deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, bins=41, imagination=4)
    model = make(
        "dreamer", observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, encoder_layers=2,
        actor_gradient=actor_gradient, **sizes, **more,
    )  # fmt: skip
    assert isinstance(model, Dreamer)
    with torch.no_grad():
        for head in (model.reward_head, model.critic, model.slow_critic):
            head[-1].weight.normal_(std=0.5)  # pyright: ignore[reportIndexIssue]
    return model.cuda()


@pytest.mark.parametrize("compile", [False, True])
def test_a_captured_update_is_the_eager_one(actor_gradient, compile):
    """With the noise of the default generator."""
    losses = []
    for capture in (False, True):
        learner = Learner(small(actor_gradient), lr=1e-4, capture=capture, compile=compile and capture)
        torch.manual_seed(0)
        batches = [windows(batch=16, horizon=10).cuda() for _ in range(8)]
        for k, batch in enumerate(batches):
            torch.manual_seed(k)
            learner.update(batch)
        losses.append(learner.metrics())
        assert (learner._graph is not None) is capture
    for name, value in losses[0].items():
        if compile:  # it draws other noise, on which imagined returns of random heads depend most
            if name in ("loss_dynamics", "loss_representation", "loss_decoder", "loss_reward"):
                assert losses[1][name] == pytest.approx(value, rel=0.1), name
        else:
            assert losses[1][name] == pytest.approx(value, rel=0.02, abs=1e-3), name


class Plainly:
    """In place of `side_stream`: one after the other."""

    def __init__(self, *inputs: Any, lane: int = 0) -> None: ...

    def __enter__(self) -> "Plainly":
        return self

    def __exit__(self, *error: object) -> None: ...

    def join(self, *outputs: Any) -> None: ...


def test_side_by_side_is_as_one_after_the_other(actor_gradient, monkeypatch):
    """Losses and gradients do not depend on the streams that they are computed on, nor on whose weights were cast."""
    model = small(actor_gradient, image_sizes={"pixels": (40, 40, 3)}, channels=8, burn_in=2).eval()
    batch = windows(batch=64, horizon=6)
    for part in (batch, batch["next"]):
        part["pixels"] = torch.randint(0, 256, (64, 6, 40, 40, 3), dtype=torch.uint8)
    batch["is_init"] = torch.rand(64, 6, 1) < 0.1
    batch = batch.to(next(model.parameters()).device)

    def results() -> list[torch.Tensor]:
        found = []
        for seed in range(20):
            torch.manual_seed(seed)
            model.zero_grad()
            casts = torch.autocast(batch.device.type, torch.bfloat16, cache_enabled=False)
            with casts, lowered(model, torch.bfloat16):
                losses = model.loss(batch)
            losses["loss"].backward()
            found += [losses["loss"].detach().clone()]
            found += [p.grad.clone() for p in model.parameters() if p.grad is not None]
        return found

    beside = results()
    monkeypatch.setattr(dreamer, "side_stream", Plainly)
    for a, b in zip(beside, results(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3 + 1e-2 * float(b.abs().max()))
