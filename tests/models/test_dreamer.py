"""DreamerV3: its pieces against plain loops, which gradients go where, and what it learns."""

import math

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.models import make
from franka_wm.models.dreamer import Dreamer
from franka_wm.models.layers import symlog
from franka_wm.models.returns import lambda_returns
from franka_wm.models.rssm import divergence
from franka_wm.models.windows import window_of
from franka_wm.planning import RewardPlusValue
from small_tdmpc2 import windows

SMALL = dict(
    deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, bins=41, imagination=4
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def small(**overrides) -> Dreamer:
    settings = dict(observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, **SMALL)
    return make("dreamer", **{**settings, **overrides})  # type: ignore[return-value]


def randomise(model: Dreamer) -> Dreamer:
    """Leave the zero initialisation of reward and critic, behind which gradients vanish."""
    with torch.no_grad():
        for head in (model.reward_head, model.critic, model.slow_critic):
            head[-1].weight.normal_(std=0.5)
    return model


# -- pieces against plain loops -----------------------------------------------------------------------------


def test_lambda_returns_are_those_of_a_plain_loop():
    reward, value = torch.randn(5, 3, 1), torch.randn(5, 3, 1)
    going_on = torch.rand(5, 3, 1)
    going_on[2, 1] = 0.0  # an end: nothing that follows counts
    found = lambda_returns(reward, going_on, value, discount=0.9, decay=0.7)
    for k in range(3):
        after = value[4, k]
        for t in (4, 3, 2, 1, 0):
            after = reward[t, k] + 0.9 * going_on[t, k] * (0.3 * value[t, k] + 0.7 * after)
            torch.testing.assert_close(found[t, k], after)
    assert found[2, 1] == reward[2, 1]
    ended = torch.tensor([True, False, True]).view(3, 1, 1)
    assert torch.equal(
        lambda_returns(torch.ones(3, 1, 1), ~ended, torch.full((3, 1, 1), 9.0), discount=0.5, decay=0.0),
        torch.tensor([1.0, 5.5, 1.0]).view(3, 1, 1),
    )


# -- what acts ----------------------------------------------------------------------------------------------


def test_observe_carries_memory_and_an_episodes_first_observation_starts_anew():
    model = small()
    first, second = (
        TensorDict({"state": torch.randn(4, 3), "joint_target": torch.randn(4, 2)}, [4]) for _ in "ab"
    )
    action = torch.rand(4, 2) * 2 - 1
    z = model.encode(first)
    new = torch.tensor([[True], [False], [True], [False]])
    after = model.observe(second, z, action, new)
    torch.testing.assert_close(after[::2], model.encode(second)[::2])
    h = model.rssm.recur(z, action)
    torch.testing.assert_close(after[1::2, :16], h[1::2])
    assert not torch.allclose(after[1::2], model.encode(second)[1::2])
    # The window's filter is the same steps, with drawn codes: with certain ones they agree.
    torch.testing.assert_close(model.next(z, action)[:, :16], h)


def test_windows_are_filtered_as_observe_does_step_by_step(monkeypatch):
    model = small()
    batch = windows(batch=5, horizon=4)
    state = model.rssm.state
    monkeypatch.setattr(model, "unrolled", 3)  # steps in one program: three, then one
    monkeypatch.setattr(model.rssm, "state", lambda h, p, *, sample: state(h, p, sample=False))
    frames = window_of(batch, model.observation_keys)
    embedded = model._embed(frames.transpose(0, 1))
    action = batch["action"].transpose(0, 1)
    found, posterior = model._filter(model.rssm.begin(embedded[0]), embedded, action)
    z = model.encode(frames[:, 0])
    for t in range(5):
        if t:
            z = model.observe(frames[:, t], z, batch["action"][:, t - 1], torch.zeros(5, 1, dtype=torch.bool))
        torch.testing.assert_close(found[t], z)
    assert posterior.shape == (5, 5, 3, 4)


def test_eight_steps_of_a_window_are_one_program(monkeypatch):
    model, given = small(), []
    steps = model._steps
    monkeypatch.setattr(model, "_steps", lambda h, *others: given.append(len(others[0])) or steps(h, *others))
    model.loss(windows(batch=2, horizon=10))
    assert given == [8, 2] and "_steps" in model.parts_of_loss


def test_reward_is_that_of_the_state_an_action_leads_to_and_ends_need_a_head():
    model = randomise(small())
    z, action = torch.randn(7, model.latent_dim), torch.rand(7, 2)
    torch.testing.assert_close(
        model.reward(z, action), model.two_hot.decode(model.reward_head(model.next(z, action)))
    )
    assert not model.terminates
    with pytest.raises(ValueError, match="terminates=True"):
        model.terminated(z)
    ending = small(terminates=True)
    assert ending.terminates and ending.terminated(z).dtype == torch.bool


def test_actions_stay_in_their_range_and_the_mode_is_the_mean():
    model = small()
    z = torch.randn(500, model.latent_dim)
    mean, std = model.action_distribution(z)
    assert std.min() >= 0.1 and std.max() <= 1.0
    assert torch.equal(model.policy(z, deterministic=True), mean)
    drawn = model.policy(z)
    assert drawn.min() == -1.0 and drawn.max() == 1.0
    torch.testing.assert_close(drawn.mean(), mean.mean(), atol=0.05, rtol=0)


# -- gradients ----------------------------------------------------------------------------------------------


def test_an_untrained_actor_varies_its_actions_by_nine_tenths_of_their_range():
    model = small()
    with torch.no_grad():
        for parameter in model.actor.parameters():
            parameter.zero_()
    mean, std = model.action_distribution(torch.randn(5, model.latent_dim))
    assert not mean.any()
    torch.testing.assert_close(std, torch.full_like(std, 0.1 + 0.9 / (1 + math.exp(-2.0))))


def test_vectors_are_read_by_their_symlog():
    model = small()
    observation = TensorDict({"state": 1e3 * torch.randn(4, 3), "joint_target": torch.randn(4, 2)}, [4])
    vectors = torch.cat((observation["state"], observation["joint_target"]), -1)
    read = model.rssm.of_observation(model.vector_encoder(symlog(vectors)))
    torch.testing.assert_close(model._embed(observation), read)


def test_a_plan_asks_for_the_rewards_of_what_it_has_reached(monkeypatch):
    """And does not predict once more what its actions lead to."""
    model = randomise(small()).eval()
    actions = torch.rand(1, 4, 3, 2) * 2 - 1
    reached = [torch.zeros(1, 4, model.latent_dim)]
    for action in actions.unbind(2):
        reached.append(model.next(reached[-1], action))
    trajectory = torch.stack(reached, 2)
    expected = RewardPlusValue(model.reward, model.value, model.discount)(trajectory, actions)
    objective = RewardPlusValue.of(model)
    monkeypatch.setattr(model.rssm, "next", None)
    torch.testing.assert_close(objective(trajectory, actions), expected)
    assert expected.std() > 1e-3
    assert objective.compiled().arrival_reward is not None


PARTS = ("dynamics_coef", "representation_coef", "decoder_coef", "reward_coef", "replay_value_coef")


def gradients(batch: TensorDict, **coefficients) -> dict[str, bool]:
    """Which parts of the model a loss with these weights reaches (all others 0)."""
    torch.manual_seed(1)
    none = dict.fromkeys((*PARTS, "termination_coef"), 0.0) | {"decoder_coef": 1e-30, "free_nats": 0.0}
    model = randomise(small(terminates=True, **{**none, **coefficients}))
    torch.manual_seed(2)
    model.loss(batch)["loss"].backward()
    reached: dict[str, bool] = {}
    for name, parameter in model.named_parameters():
        part = ".".join(name.split(".")[: 2 if name.startswith("rssm") else 1])
        there = parameter.grad is not None and bool(parameter.grad.abs().max() > 1e-20)
        reached[part] = reached.get(part, False) or there
    return reached


def test_each_loss_reaches_what_it_should_and_nothing_else():
    batch = windows(batch=5, horizon=4)
    model = {
        "vector_encoder",
        *(
            f"rssm.{n}"
            for n in ("of_deter", "of_codes", "of_action", "mix", "mix_inputs", "mix_norm", "gates")
        ),
        *(f"rssm.{n}" for n in ("of_observation", "posterior_mix", "posterior_head")),
    }
    always = {"actor", "critic"}  # their losses have no weight

    def reached(**coefficients) -> set[str]:
        return {part for part, there in gradients(batch, **coefficients).items() if there}

    assert reached() == always  # imagination trains actor and critic, and nothing of the model
    assert reached(dynamics_coef=1.0) == always | model | {"rssm.prior_head"}
    assert reached(representation_coef=1.0) == always | model  # the prior stands still
    assert reached(reward_coef=1.0) == always | model | {"reward_head"}
    assert reached(termination_coef=1.0) == always | model | {"termination_head"}
    assert reached(decoder_coef=1.0) == always | model | {"vector_decoder"}
    assert reached(replay_value_coef=1.0) == always | model


def test_the_loss_is_the_weighted_sum_of_its_parts():
    weights = {"dynamics": 3.0, "representation": 5.0, "decoder": 7.0, "reward": 11.0}
    weights |= {"termination": 13.0, "replay_value": 17.0}
    model = randomise(small(terminates=True, free_nats=0.0, **{f"{k}_coef": v for k, v in weights.items()}))
    losses = model.loss(windows(batch=5, horizon=4))
    total = losses["loss_policy"] + losses["loss_value"]
    for name, weight in weights.items():
        total = total + weight * losses[f"loss_{name}"]
    torch.testing.assert_close(losses["loss"].detach(), total)


def test_what_is_logged_is_what_it_says(monkeypatch):
    model = randomise(small(image_sizes={"pixels": (40, 40, 3)}, channels=2, vector_coef=3.0))
    batch = windows(batch=4, horizon=2)
    for part in (batch, batch["next"]):
        part.set("pixels", torch.randint(0, 256, (4, 2, 40, 40, 3), dtype=torch.uint8))
    kept, filtered = [], model._filter
    monkeypatch.setattr(model, "_filter", lambda *given: kept.append(filtered(*given)) or kept[-1])
    losses = model.loss(batch)
    z = kept[0][0]
    frames = window_of(batch, model.observation_keys).transpose(0, 1)
    vectors = torch.cat((frames["state"], frames["joint_target"]), -1)
    squared = 3.0 * (model.vector_decoder(z) - symlog(vectors)).square().sum(-1).mean()
    squared += (model.image_decoder(z) - frames["pixels"] / 255).square().sum((-3, -2, -1)).mean()
    torch.testing.assert_close(losses["loss_decoder"], squared.detach())
    guessed = model.two_hot.decode(model.reward_head(z[1:])).squeeze(-1)
    error = (guessed - batch["next", "reward"][..., 0].T).abs().mean()
    torch.testing.assert_close(losses["reward_error"], error.detach())
    prior = torch.distributions.Categorical(logits=model.rssm.prior(z[1:, ..., :16]))
    torch.testing.assert_close(losses["prior_entropy"], prior.entropy().sum(-1).mean().detach())


def test_the_priors_divergence_leaves_the_posterior_alone():
    model = small()
    p, q = (torch.randn(6, 3, 4, requires_grad=True) for _ in range(2))
    divergence(p.log_softmax(-1).detach(), q.log_softmax(-1)).sum().backward()
    assert p.grad is None and q.grad is not None
    batch, grads = windows(batch=5, horizon=4), {}
    for coefficient in ("dynamics_coef", "representation_coef"):
        torch.manual_seed(1)
        model = small(**(dict.fromkeys(PARTS, 0.0) | {"free_nats": 0.0, coefficient: 1.0}))
        torch.manual_seed(2)
        model.loss(batch)["loss"].backward()
        grads[coefficient] = model.rssm.posterior_head[-1].bias.grad
    assert not torch.allclose(grads["dynamics_coef"], grads["representation_coef"])


def test_divergences_below_the_free_nats_train_nothing():
    batch = windows(batch=5, horizon=4)
    free = gradients(batch, dynamics_coef=1.0, representation_coef=1.0, free_nats=1e6)
    assert {part for part, there in free.items() if there} == {"actor", "critic"}
    losses = small(free_nats=50.0).loss(batch)
    assert losses["loss_dynamics"] == losses["loss_representation"] == 50.0


def test_each_step_has_its_own_free_nats():
    model = small(free_nats=0.5)
    batch = windows(batch=64, horizon=4)
    torch.manual_seed(3)
    clipped = model.loss(batch)["loss_dynamics"]
    torch.manual_seed(3)
    model.free_nats = 0.0
    plain = model.loss(batch)["loss_dynamics"]
    assert clipped > max(float(plain), 0.5)  # the mean of what was clipped, not the clipped mean


def test_the_slow_critic_follows_and_is_not_trained():
    model = randomise(small(tau=0.25))
    assert all(not p.requires_grad for p in model.slow_critic.parameters())
    trained = {id(p) for group in model.parameter_groups(1e-3) for p in group["params"]}
    assert trained == {id(p) for p in model.parameters() if p.requires_grad}
    assert [group["clip"] for group in model.parameter_groups(1.0)] == ["model", "policy", "value"]
    old, live = model.slow_critic[-1].weight.clone(), model.critic[-1].weight.detach()
    model.after_update()
    torch.testing.assert_close(model.slow_critic[-1].weight, old + 0.25 * (live - old))


def test_the_critic_is_also_pulled_towards_the_slow_one():
    model = randomise(small())
    z, target = torch.randn(6, model.latent_dim), torch.randn(6, 1)
    slow = model.two_hot.decode(model.slow_critic(z))
    logits = model.critic(z)
    expected = model.two_hot.loss(logits, target) + model.two_hot.loss(logits, slow)
    torch.testing.assert_close(model._value_loss(z, target), expected)


# -- imagination --------------------------------------------------------------------------------------------


def test_imagined_trajectories_follow_prior_and_actor(monkeypatch):
    model = small()
    drawn, state = [], model.rssm.state
    monkeypatch.setattr(
        model.rssm, "state", lambda h, p, *, sample: drawn.append(sample) or state(h, p, sample=sample)
    )
    torch.manual_seed(5)
    states, actions = model._imagine(torch.randn(9, model.latent_dim))
    assert states.shape == (5, 9, model.latent_dim) and actions.shape == (4, 9, 2)
    for k in range(4):
        torch.testing.assert_close(
            states[k + 1, :, :16], model.rssm.recur(states[k], actions[k].clamp(-1, 1))
        )
    assert drawn == [True] * 4
    assert actions.abs().max() > 1.0  # the density is that of what was drawn, not of what was clamped


def test_imagined_returns_stop_where_the_model_expects_an_end():
    model = randomise(small(terminates=True, return_lambda=1.0))
    states = torch.randn(5, 6, model.latent_dim)
    reward = model.two_hot.decode(model.reward_head(states[1:]))
    with torch.no_grad():
        model.termination_head[-1].weight.zero_()
        model.termination_head[-1].bias.fill_(50.0)  # every state is an end
    begun = torch.ones(6, 1)
    returns, value, weight = model._imagined_returns(states, begun)
    torch.testing.assert_close(returns, reward)
    torch.testing.assert_close(value, model.value(states[:-1]))
    assert torch.equal(weight[0], torch.ones(6, 1)) and weight[1:].max() < 1e-10
    with torch.no_grad():
        model.termination_head[-1].bias.fill_(-50.0)
    begun[2] = 0.0  # that state had ended its episode: nothing is learned from what would follow
    returns, _, weight = model._imagined_returns(states, begun)
    assert not weight[:, 2].any()
    expected = model.value(states[-1])
    for t in (3, 2, 1, 0):
        expected = reward[t] + 0.9 * expected
    torch.testing.assert_close(returns[0], expected)
    torch.testing.assert_close(weight[:, 0, 0], 0.9 ** torch.arange(4.0))


def test_the_actor_takes_up_what_paid_more_than_expected():
    model = small(entropy_coef=0.0)
    z = torch.randn(1, 400, model.latent_dim).expand(1, 400, -1)
    mean, std = model.action_distribution(z)
    actions = (mean + std * torch.randn_like(mean)).detach()
    returns, value = actions[..., :1], torch.zeros(1, 400, 1)  # more of the first component pays
    loss, entropy = model._policy_loss(z, actions, returns, value, torch.ones(1, 400, 1))
    loss.backward()
    with torch.no_grad():
        for parameter in model.actor.parameters():
            parameter -= 0.1 * parameter.grad
    assert model.action_distribution(z)[0][..., 0].mean() > mean[..., 0].mean() + 0.01
    expected = torch.distributions.Normal(mean, std).entropy().sum(-1).mean()
    torch.testing.assert_close(entropy, expected)
    keen = small(entropy_coef=2.0)
    bonus, entropy = keen._policy_loss(z, actions, value, value, torch.full((1, 400, 1), 0.5))
    torch.testing.assert_close(bonus, -0.5 * 2.0 * entropy)  # entropy alone is rewarded


def test_what_had_ended_begins_no_imagined_trajectory(monkeypatch):
    model, seen = randomise(small(terminates=True)), []
    batch = windows(batch=5, horizon=3)
    batch["next", "terminated"][1, -1] = True
    returns = model._imagined_returns
    monkeypatch.setattr(model, "_imagined_returns", lambda z, begun: seen.append(begun) or returns(z, begun))
    model.loss(batch)
    expected = torch.ones(4, 5)
    expected[3, 1] = 0.0
    assert torch.equal(seen[0].view(4, 5), expected)


def test_advantages_are_divided_by_the_running_range_of_returns():
    model = randomise(small(entropy_coef=0.0))
    batch = windows(batch=5, horizon=3)
    model.eval().loss(batch)
    assert model.scale.value == 1.0
    with torch.no_grad():
        model.critic[-1].weight.normal_(std=5.0)
    model.train().loss(batch)
    assert model.scale.value > 1.0  # moved in training mode alone
    z, actions = torch.randn(2, 6, model.latent_dim), torch.randn(2, 6, 2)
    returns, value, weight = torch.randn(2, 6, 1), torch.randn(2, 6, 1), torch.ones(2, 6, 1)
    losses = []
    for scale in (1.0, 4.0):
        model.scale.value.fill_(scale)
        losses.append(model._policy_loss(z, actions, returns, value, weight)[0])
    torch.testing.assert_close(losses[0], 4.0 * losses[1])


def test_no_value_is_bootstrapped_past_a_recorded_termination(monkeypatch):
    model = randomise(small(terminates=True))
    batch = windows(batch=5, horizon=3, reward=2.0)
    batch["next", "terminated"][:, -1] = True
    seen = []
    value_loss = model._value_loss
    monkeypatch.setattr(model, "_value_loss", lambda z, r: seen.append(r) or value_loss(z, r))
    model.loss(batch)
    recorded = seen[-1]
    torch.testing.assert_close(recorded[-1], torch.full((5, 1), 2.0))


# -- options -----------------------------------------------------------------------------------------------


def test_without_a_decoder_there_is_none():
    model = small(decoder_coef=0.0, image_sizes={"pixels": (40, 40, 3)}, channels=2)
    assert model.vector_decoder is None and model.image_decoder is None
    batch = windows(batch=3, horizon=3)
    for part in (batch, batch["next"]):
        part.set("pixels", torch.randint(0, 256, (3, 3, 40, 40, 3), dtype=torch.uint8))
    assert model.loss(batch)["loss_decoder"] == 0.0
    both = small(image_sizes={"pixels": (40, 40, 3)}, channels=2)
    both.loss(batch)["loss"].backward()
    for part in (both.image_decoder, both.image_encoder, both.vector_decoder, both.vector_encoder):
        assert all(p.grad is not None for p in part.parameters())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"blocks": 3}, "model.blocks=3: must divide model.deter_dim=2048"),
        ({"std_min": 2.0}, "model.std_min=2.0: must be below model.std_max=1.0"),
        ({"classes": 1}, "model.classes=1"),
        ({"imagination": 0}, "model.imagination=0"),
        ({"tau": 0.0}, "model.tau=0.0"),
    ],
)
def test_wrong_options_are_refused(options, said):
    with pytest.raises(UserError, match=said):
        Dreamer.validate(options)


def test_statistics_standardise_what_is_encoded_and_reconstructed():
    model = small()
    model.set_observation_statistics(torch.full((5,), 3.0), torch.full((5,), 2.0))
    observation = TensorDict({"state": torch.full((1, 3), 5.0), "joint_target": torch.full((1, 2), 5.0)}, [1])
    other = small()
    other.load_state_dict(model.state_dict())
    other.set_observation_statistics(torch.zeros(5), torch.ones(5))
    ones = observation.apply(torch.ones_like)
    torch.testing.assert_close(model.encode(observation), other.encode(ones))
    z = torch.randn(1, model.latent_dim)
    torch.testing.assert_close(model._reconstruction(z, observation), other._reconstruction(z, ones))
