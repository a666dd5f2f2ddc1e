"""DreamerV3 on a GPU: the update as one CUDA graph."""

import pytest
import torch

from franka_wm.models import make
from franka_wm.models.dreamer import Dreamer
from franka_wm.training.learner import Learner
from small_tdmpc2 import windows

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"]),
]


def small(actor_gradient: str) -> Dreamer:
    torch.manual_seed(0)
    sizes = dict(deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, bins=41, imagination=4)
    model = make(
        "dreamer", observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, encoder_layers=2,
        actor_gradient=actor_gradient, **sizes,
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
        batches = [windows(batch=16, horizon=6).cuda() for _ in range(8)]
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
