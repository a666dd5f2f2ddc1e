"""Which way the actor's gradient goes: by what actions paid, or back through the model that imagined them."""

from functools import partial
from typing import Any

import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.models.dreamer import Dreamer
from small_tdmpc2 import windows

STATES, STEPS = 6, 4
"""That imagination begins in, and how far it goes."""


def small(actor_gradient: Any, **overrides: Any) -> Dreamer:
    torch.manual_seed(0)
    model = Dreamer(
        observation_sizes={"state": 3}, action_dim=2, discount=0.8, return_lambda=0.7, deter_dim=16, hidden_dim=16,
        codes=3, classes=4, blocks=2, encoder_layers=2, bins=21, imagination=STEPS, value_low=-4.0, value_high=4.0,
        terminates=True, entropy_coef=0.3, actor_gradient=actor_gradient, **overrides,
    )  # fmt: skip
    with torch.no_grad():
        for head in (model.reward_head, model.critic, model.slow_critic, model.termination_head, model.actor):
            assert head is not None
            head[-1].weight.normal_(std=0.5)  # pyright: ignore[reportIndexIssue]
    return model.eval()


def policy_loss(model: Dreamer) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss of the actor, and what it imagined, with the same noise at each call."""
    torch.manual_seed(1)
    imagined, actions = model._imagine(torch.randn(STATES, model.latent_dim))
    return model._actor_critic_loss(imagined, actions, torch.ones(STATES, 1))[0], imagined


def reached(model: Dreamer) -> set[str]:
    return {name.split(".")[0] for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}


@pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"])
def test_the_actors_loss_trains_the_actor_alone(actor_gradient):
    model = small(actor_gradient)
    policy_loss(model)[0].backward()
    assert reached(model) == {"actor"}


@pytest.mark.parametrize("actor_gradient", ["reinforce", "dynamics"])
def test_imagination_teaches_the_model_nothing(actor_gradient):
    """Of the whole loss, where the model's own parts weigh nothing."""
    nothing = ("dynamics", "representation", "decoder", "reward", "termination", "replay_value")
    model = small(actor_gradient, **{f"{name}_coef": 0.0 for name in nothing})
    batch = windows(batch=3, horizon=4).exclude("joint_target", ("next", "joint_target"))
    model.loss(batch)["loss"].backward()
    assert reached(model) == {"actor", "critic"}


def test_the_gradient_of_returns_goes_back_through_imagined_steps_to_the_actions():
    model = small("dynamics")
    model.scale.value.fill_(3.0)
    loss, imagined = policy_loss(model)
    loss.backward()
    found = [p.grad.clone() for p in model.actor.parameters() if p.grad is not None]
    model.zero_grad()

    # The same trajectories, written out, through a model that is not held.
    torch.manual_seed(1)
    states, spread = [torch.randn(STATES, model.latent_dim)], []
    for _ in range(STEPS):
        mean, std = model.action_distribution(states[-1].detach())
        spread.append(std)
        action = (mean + std * torch.randn_like(mean)).clamp(-1.0, 1.0)
        states.append(model.rssm.next(states[-1], action, sample=True))
    torch.testing.assert_close(torch.stack(states), imagined)
    returns, weights = [model.value(states[-1])], [torch.ones(STATES, 1)]
    for z in reversed(states[1:]):
        going_on = 1.0 - model.termination_head(z).sigmoid()  # type: ignore[misc]
        ahead = 0.3 * model.value(z) + 0.7 * returns[0]
        returns.insert(0, model.arrival_reward(z) + 0.8 * going_on * ahead)
    for z in states[1:-1]:
        weights.append(weights[-1] * 0.8 * (1.0 - model.termination_head(z).sigmoid()))  # type: ignore[misc]
    entropy = [(0.5 + 0.5 * torch.log(2.0 * torch.pi * std.square())).sum(-1, keepdim=True) for std in spread]
    plain = [
        -w.detach() * ((r - model.value(z).detach()) / 3.0 + 0.3 * e)
        for w, r, z, e in zip(weights, returns, states[:-1], entropy, strict=False)
    ]
    torch.testing.assert_close(loss, expected := torch.stack(plain).mean())
    expected.backward()
    for mine, theirs in zip(found, model.actor.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs.grad)
    assert {"rssm", "reward_head", "critic"} <= reached(model)  # so that they were held, above


def test_only_dynamics_keeps_gradients_of_imagination():
    model = small("reinforce")
    assert not policy_loss(model)[1].requires_grad
    assert policy_loss(small("dynamics"))[1].requires_grad


def test_nothing_is_kept_for_gradients_where_none_is_asked_for():
    with torch.no_grad():
        loss, imagined = policy_loss(small("dynamics"))
    assert not loss.requires_grad and not imagined.requires_grad


def test_actor_and_critic_have_a_learning_rate_of_their_own():
    model = small("dynamics", actor_critic_lr_scale=0.3)
    rates = {group["name"]: group["lr"] for group in model.parameter_groups(1e-3)}
    assert rates == {"model": 1e-3, "policy": pytest.approx(3e-4), "value": pytest.approx(3e-4)}


def test_a_gradient_that_there_is_not_is_refused():
    with pytest.raises(UserError, match=r"actor_gradient='straight'.*reinforce.*dynamics"):
        small("straight")


@pytest.mark.parametrize(("actor_gradient", "burn_in"), [("reinforce", 0), ("dynamics", 0), ("reinforce", 2)])
def test_each_part_of_the_loss_compiles_as_one_graph(actor_gradient, burn_in, monkeypatch):
    """A break of the graph would cost time on a GPU, and a wrong one numbers."""
    batch = windows(batch=3, horizon=4 + burn_in).exclude("joint_target", ("next", "joint_target"))
    batch["is_init"] = torch.zeros(3, 4 + burn_in, 1, dtype=torch.bool)
    found = []
    for compiled in (False, True):
        model = small(actor_gradient, burn_in=burn_in)
        if compiled:
            monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager", fullgraph=True))
        loss = model.compiled_loss() if compiled else model.loss
        torch.manual_seed(1)
        losses = loss(batch)
        losses["loss"].backward()
        grads = {f"of {name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
        found.append({**losses.detach(), **grads})
    assert found[0].keys() == found[1].keys() and "of actor.0.0.weight" in found[0]
    for name, value in found[0].items():
        torch.testing.assert_close(found[1][name], value, msg=lambda text, name=name: f"{name}: {text}")
