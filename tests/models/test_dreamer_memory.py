"""The steps before a window, from which Dreamer's memory begins: as when it acts, of one episode, without gradients."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.evaluation.health import training_diagnostics
from franka_wm.evaluation.spectrum import latent_statistics
from franka_wm.models import dreamer
from franka_wm.models.dreamer import Dreamer
from small_tdmpc2 import windows

B, EARLIER, H = 4, 3, 2


def small() -> Dreamer:
    torch.manual_seed(0)
    model = Dreamer(
        observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, deter_dim=16, hidden_dim=16, codes=3,
        classes=4, blocks=2, encoder_layers=2, bins=21, imagination=2, burn_in=EARLIER,
    )  # fmt: skip
    with torch.no_grad():
        for head in (model.reward_head, model.critic):
            head[-1].weight.normal_()
    return model


def batch() -> TensorDict:
    """Windows of one episode, of one that begins amid the steps before it, and of one that begins with it."""
    data = windows(batch=B, horizon=EARLIER + H)
    data["is_init"] = torch.zeros(B, EARLIER + H, 1, dtype=torch.bool)
    data["is_init"][1, 1] = data["is_init"][2, EARLIER] = True
    return data


def first_memory(model: Dreamer, data: TensorDict) -> torch.Tensor:
    return model._remember(data, model._embed(data[:, EARLIER]))


def test_a_windows_memory_is_that_of_acting(monkeypatch) -> None:
    model, data = small(), batch()
    see = model._see
    monkeypatch.setattr(model, "_see", lambda h, embedded, sample: see(h, embedded, sample=False))
    z = model.encode(data[:, 0])
    for t in range(1, EARLIER + 1):
        z = model.observe(data[:, t], z, data["action"][:, t - 1], data["is_init"][:, t])
    torch.testing.assert_close(first_memory(model, data), z[:, :16])


def test_codes_are_drawn_on_the_way() -> None:
    model, data = small(), batch()
    assert not torch.equal(first_memory(model, data)[0], first_memory(model, data)[0])


@pytest.mark.parametrize(("window", "since"), [(0, 0), (1, 1), (2, EARLIER)])
def test_what_came_before_an_episode_is_forgotten(window: int, since: int) -> None:
    model, data = small().eval(), batch()

    def loss() -> torch.Tensor:
        torch.manual_seed(1)
        return model.loss(data[window : window + 1])["loss"].detach()

    before = loss()
    for t in range(EARLIER):
        kept = data["action"][window, t].clone()
        data["action"][window, t] = -kept
        assert torch.equal(loss(), before) == (t < since)
        data["action"][window, t] = kept


def test_no_gradient_reaches_the_steps_before() -> None:
    model, data = small(), batch()
    state = data["state"].requires_grad_()
    model.loss(data)["loss"].backward()
    assert state.grad is not None
    assert (state.grad[:, :EARLIER] == 0).all() and (state.grad[:, EARLIER:] != 0).any()


def test_a_number_of_steps_that_cannot_be_is_refused() -> None:
    with pytest.raises((ValueError, UserError), match="burn_in=-1"):
        Dreamer(observation_sizes={"state": 3}, action_dim=2, burn_in=-1)


def test_windows_without_the_steps_before_them_are_refused() -> None:
    model, data = small(), batch()
    with pytest.raises(ValueError, match=r"burn_in=3: windows have so many steps in front.*, not 3 in all"):
        model.loss(data[:, :EARLIER])
    with pytest.raises(ValueError, match="not 5 in all"):
        model.loss(data.exclude("is_init"))


def test_a_log_tells_of_latents_with_their_memory() -> None:
    """Values at a window's start and end, and the latents' spread, are of what the model remembers there."""
    model, data = small().eval(), batch()
    with torch.no_grad():
        z = [model.encode(data[:, 0])]
        for t in range(1, EARLIER + H):
            z.append(model.observe(data[:, t], z[-1], data["action"][:, t - 1], data["is_init"][:, t]))
        never = torch.zeros(B, 1, dtype=torch.bool)
        last = model.observe(data["next"][:, -1], z[-1], data["action"][:, -1], never)
        reward = data["next", "reward"][:, EARLIER:]
        target = reward[:, 0] + model.discount * (reward[:, 1] + model.discount * model.value(last))
        value = model.value(z[EARLIER])
    found = training_diagnostics(model, data)
    assert found["value/mean"] == pytest.approx(float(value.mean()), abs=1e-5)
    assert found["value/td_bias"] == pytest.approx(float((value - target).mean()), abs=1e-5)
    expected = {f"latent/{name}": number for name, number in latent_statistics(z[EARLIER]).items()}
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_a_decision_goes_through_the_recurrent_network_once(monkeypatch):
    model, calls = small(), []
    recur = model.rssm.recur
    monkeypatch.setattr(model.rssm, "recur", lambda *given: (calls.append(1), recur(*given))[1])
    observation = TensorDict({"state": torch.randn(4, 3), "joint_target": torch.randn(4, 2)}, [4])
    model.observe(observation, torch.randn(4, model.latent_dim), torch.rand(4, 2), torch.eye(4)[:, :1].bool())
    assert len(calls) == 1


def test_weights_that_are_cast_for_an_update_are_told_to_the_streams_that_read_them(monkeypatch):
    """Their memory would be given away as soon as the main stream is done with it."""
    model, told = small(), []

    class Noted(dreamer.side_stream):
        def __init__(self, *inputs: torch.Tensor, lane: int = 0) -> None:
            told.append({id(one) for one in inputs})
            super().__init__(*inputs, lane=lane)

    monkeypatch.setattr(dreamer, "side_stream", Noted)
    model.loss(batch())
    for layer, inputs in zip((model.rssm.of_observation, model.rssm.prior_head), told, strict=True):
        assert {id(one) for one in layer.parameters()} <= inputs


def stored() -> tuple[Dreamer, TensorDict]:
    """A model whose windows begin with what was remembered, and windows whose second one begins an episode."""
    model, data = small().eval(), batch()
    model.replay_keys = ("context",)
    data["context"] = torch.randn(B, EARLIER + H, model.latent_dim)
    data["is_init"][1, 0] = True
    return model, data


def test_a_window_begins_with_the_stored_memory() -> None:
    """But where an episode begins, as it does then."""
    model, data = stored()
    model.burn_in = 0
    found = model._remember(data, model._embed(data[:, 0]))
    begin = model.rssm.begin(torch.zeros(1, 1))
    expected = data["context"][:, 0, :16].clone()
    expected[1] = begin[0]
    torch.testing.assert_close(found, expected)


def test_the_steps_before_a_window_go_on_from_the_stored_memory(monkeypatch) -> None:
    model, data = stored()
    see = model._see
    monkeypatch.setattr(model, "_see", lambda h, embedded, sample: see(h, embedded, sample=False))
    z = torch.cat((data["context"][:, 0, :16], torch.zeros(B, 12)), -1)
    h = torch.where(data["is_init"][:, 0], model.rssm.begin(z), z[:, :16])
    z = model._see(h, model._embed(data[:, 0]), sample=False)[0]
    for t in range(1, EARLIER + 1):
        z = model.observe(data[:, t], z, data["action"][:, t - 1], data["is_init"][:, t])
    torch.testing.assert_close(first_memory(model, data), z[:, :16])


@pytest.mark.parametrize("key", ["context", "is_init"])
def test_windows_without_what_was_stored_are_refused(key: str) -> None:
    model = Dreamer(observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, stored_state=True)
    assert model.replay_keys == ("context",)
    with pytest.raises(ValueError, match="stored_state=True: the batch must have `context` and `is_init`"):
        model.loss(stored()[1].exclude(key))
