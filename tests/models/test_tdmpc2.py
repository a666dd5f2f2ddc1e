"""TD-MPC2: its parts, and its losses by hand."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm import processes
from franka_wm.models import make
from small_tdmpc2 import optimiser_of, point_mass, randomise, small, update, windows


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_default_size_is_the_published_one():
    model = make(
        "tdmpc2", observation_sizes={"state": 20, "joint_target": 7}, action_dim=7, episode_length=100
    )
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(5e6, rel=0.05)


def test_discount_follows_the_episode_length():
    def discount(length: int) -> float:
        return small(discount=None, episode_length=length).discount

    assert discount(20) == pytest.approx(0.95)
    assert discount(250) == pytest.approx(0.98)
    assert discount(100_000) == pytest.approx(0.995)
    with pytest.raises(ValueError, match="episode_length"):
        small(discount=None)


@pytest.mark.parametrize(
    "overrides",
    [dict(simnorm_dim=7), dict(num_q=1), dict(observation_sizes={}), dict(discount=1.0), dict(dropout=1.0)],
)
def test_settings_that_cannot_work_are_refused(overrides):
    with pytest.raises(ValueError):
        small(**overrides)


def test_the_encoder_has_so_many_layers():
    def layers(count: int, **overrides) -> int:
        encoder = small(encoder_layers=count, **overrides).encoder
        return sum(name.endswith("weight") and p.ndim == 2 for name, p in encoder.named_parameters())

    assert [layers(count) for count in (1, 2, 3)] == [1, 2, 3]
    seen = {"image_sizes": {"pixels": (64, 64, 3)}}  # vectors beside images have a layer at least
    assert layers(1, **seen) == layers(2, **seen) == layers(3, **seen) - 1


def test_images_are_standardised_if_asked_for():
    seen = {"image_sizes": {"pixels": (64, 64, 3)}}
    for asked, keys in ((True, ["pixels"]), (False, [])):
        assert list(small(standardize_images=asked, **seen).standardized_images) == keys
    assert not small(standardize_images=True).standardized_images


@pytest.mark.parametrize("leading", [(), (4,), (2, 3, 4)])
def test_every_part_takes_any_leading_dimensions(leading):
    model = small()
    observation = TensorDict(
        {"state": torch.randn(*leading, 3), "joint_target": torch.randn(*leading, 2)}, leading
    )
    z, action = model.encode(observation), torch.rand(*leading, 2)
    assert z.shape == model.next(z, action).shape == (*leading, 32)
    assert model.reward(z, action).shape == model.q(z, action).shape == model.value(z).shape == (*leading, 1)
    sample, log_prob = model.policy_sample(z)
    assert model.policy(z).shape == sample.shape == (*leading, 2)
    assert log_prob.shape == (*leading, 1)


def test_latents_of_encoder_and_dynamics_are_simplices_alike():
    model = small()
    z = model.encode(windows())
    for latent in (z, model.next(z, torch.rand(6, 3, 2))):
        assert (latent >= 0).all()
        torch.testing.assert_close(latent.unflatten(-1, (4, 8)).sum(-1), torch.ones(6, 3, 4))


def test_observations_are_encoded_in_the_order_of_the_mapping():
    model = small()
    batch = windows()
    x = torch.cat((batch["state"], batch["joint_target"]), -1)
    torch.testing.assert_close(model.encode(batch), model.encoder(x))


def test_observation_statistics_standardise_and_the_default_is_the_identity():
    model, batch = small(), windows()
    mean, std = torch.randn(5), torch.rand(5) + 0.5
    plain = model.encode(batch)
    moved = batch.clone()
    moved["state"] = batch["state"] * std[:3] + mean[:3]
    moved["joint_target"] = batch["joint_target"] * std[3:] + mean[3:]
    model.set_observation_statistics(mean, std)
    torch.testing.assert_close(model.encode(moved), plain)
    assert not torch.allclose(model.encode(batch), plain)
    model.set_observation_statistics(mean, torch.zeros(5))  # constant features
    assert torch.isfinite(model.encode(batch)).all()
    with pytest.raises(ValueError, match="finite"):
        model.set_observation_statistics(mean * torch.nan, std)


def test_first_predictions_of_reward_and_value_are_zero():
    model = small()
    z = model.encode(windows())
    assert model.reward(z, torch.rand(6, 3, 2)).abs().max() < 1e-5
    assert model.value(z).abs().max() < 1e-5


def test_the_range_of_values_follows_the_rewards_and_rebuilds():
    model = small(reward_bounds=(-1.01, 0.0), discount=0.95)
    assert -3.3 < model.two_hot.low < -3.0 and model.two_hot.high == -model.two_hot.low
    again = small(discount=0.95, **model.rebuild_overrides())
    assert torch.equal(again.two_hot.support, model.two_hot.support)
    assert small().two_hot.low == -10.0


def test_targets_outside_of_the_range_are_counted():
    batch = windows(reward=-3.0)
    batch["next", "terminated"][:] = True
    batch["next", "reward"][:3] = -1.0
    assert small().loss(batch)["target_outside"] == 0.0
    assert (
        small(value_low=-1.0).loss(batch)["target_outside"] == 0.5
    )  # -1 is inside, -3 is not, as reward and target


def test_the_model_losses_are_those_of_a_plain_unroll():
    """One step at a time, each weighed by rho to its power; targets are the rewards, as all steps terminate."""
    model, batch = small(rho=0.3).eval(), windows()
    randomise(model)
    batch["next", "terminated"][:] = True
    losses = model.loss(batch)
    z = model.encode(batch[:, 0])
    consistency = reward = value = torch.zeros(())
    for t in range(3):
        x = torch.cat((z, batch["action"][:, t]), -1)
        earned = batch["next", "reward"][:, t]
        reward = reward + 0.3**t * model.two_hot.loss(model.reward_head(x), earned).mean() / 3
        value = value + 0.3**t * model.two_hot.loss(model.q_ensemble(x), earned).mean() / 3
        z = model.next(z, batch["action"][:, t])
        consistency = consistency + 0.3**t * (z - model.encode(batch["next"][:, t])).square().mean() / 3
    torch.testing.assert_close(losses["loss_consistency"], consistency.detach())
    torch.testing.assert_close(losses["loss_reward"], reward.detach())
    torch.testing.assert_close(losses["loss_value"], value.detach())
    total = 20 * consistency + 0.1 * reward + 0.1 * value + losses["loss_policy"]
    torch.testing.assert_close(losses["loss"], total)


@pytest.mark.parametrize("mode", [False, True])
def test_targets_bootstrap_at_a_sample_or_at_the_mode_of_the_policy(mode):
    model, after = small(mode_targets=mode).eval(), torch.rand(3, 6, 32)
    randomise(model)
    seen, own = [], model.policy

    def policy(z, deterministic=False):
        seen.append(deterministic)
        return own(z, deterministic)

    model.policy = policy
    model._td_target(after, torch.zeros(3, 6, 1), torch.zeros(3, 6, 1, dtype=torch.bool))
    assert seen == [mode]


def test_the_policy_loss_is_as_documented(monkeypatch):
    """-Σ ρ^t (Q / scale + coefficient · A · entropy of the actions), over four latents."""
    model = small(entropy_coef=0.25, rho=0.3).eval()
    randomise(model)
    model.scale.value.fill_(4.0)
    with torch.no_grad():
        model.policy_head.network[-1].weight.normal_(std=0.1)  # type: ignore[union-attr,operator]
    batch, handed, whole = windows(), [], model._policy_loss

    def policy_loss(z, weight):
        handed.append(z)
        torch.manual_seed(1)
        return whole(z, weight)

    monkeypatch.setattr(model, "_policy_loss", policy_loss)
    losses = model.loss(batch)
    mean, log_std = model.policy_head.distribution(handed[0])  # (4, 6, 2)
    torch.manual_seed(1)
    raw = mean + log_std.exp() * torch.randn_like(mean)
    members = torch.rand(5).topk(2).indices
    x = torch.cat((handed[0], raw.tanh()), -1)
    q = model.two_hot.decode(model.q_ensemble(x, members=members)).mean(0)
    log_prob = torch.distributions.Normal(mean, log_std.exp()).log_prob(raw).sum(-1, keepdim=True)
    squashed = log_prob - (1 - raw.tanh().square()).log().sum(-1, keepdim=True)
    wanted = -(0.3 ** torch.arange(4.0) * (q / 4.0 + 0.25 * 2 * -squashed).mean((1, 2))).mean()
    torch.testing.assert_close(losses["loss_policy"], wanted.detach(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(losses["policy_entropy"], -squashed.mean().detach(), rtol=1e-3, atol=1e-3)


def test_where_actions_hardly_matter_the_policy_does_not_saturate():
    """An entropy counted before squashing drives it to ±1 and its deviation to the bound, as it did on the arm."""
    torch.manual_seed(0)
    model = small()
    optimiser = optimiser_of(model, lr=3e-3)
    batch = windows()
    batch["next", "reward"] = 1e-3 * batch["action"].mean(-1, keepdim=True)
    for _ in range(200):
        update(model, optimiser, batch)
    mean, log_std = model.policy_head.distribution(model.encode(batch[:, 0]))
    assert mean.abs().mean() < 2.0 and log_std.mean() < 1.0


def test_ends_are_learned_where_episodes_terminate_and_only_there():
    """A point that is moved by the action and ends beyond 0.5: the head knows ends that it has not seen."""
    plain = small()
    with pytest.raises(ValueError, match="terminates"):
        plain.terminated(torch.zeros(1, 32))
    assert "loss_termination" not in plain.loss(windows())
    torch.manual_seed(0)
    model = small(observation_sizes={"state": 1}, action_dim=1, terminates=True)
    optimiser = optimiser_of(model, lr=3e-3)

    def ending(batch):
        data = point_mass(batch)
        data["next", "terminated"] = data["next", "state"] > 0.5
        return data

    losses = [float(update(model, optimiser, ending(128))["loss_termination"]) for _ in range(200)]
    assert losses[-1] < 0.3 * losses[0]
    model.eval()
    test = ending(500)[:, 0]
    predicted = model.terminated(model.next(model.encode(test), test["action"]))
    assert predicted.dtype == torch.bool and predicted.shape == (500, 1)
    far = (test["next", "state"] - 0.5).abs() > 0.1
    assert (predicted == test["next", "terminated"])[far].float().mean() > 0.98


def test_the_loss_of_ends_is_the_cross_entropy_of_what_is_predicted():
    batch = windows()
    batch["next", "terminated"][:2, -1] = True
    model = small(
        terminates=True, termination_coef=0.5, consistency_coef=0.0, reward_coef=0.0, value_coef=0.0
    ).eval()
    losses = model.loss(batch)
    z, logits = model.encode(batch[:, 0]), []
    for t in range(3):
        z = model.next(z, batch["action"][:, t])
        assert model.termination_head is not None
        logits.append(model.termination_head(z))
    chance = torch.stack(logits, 1).sigmoid()
    wanted = -torch.where(batch["next", "terminated"], chance.log(), (1 - chance).log()).mean()
    torch.testing.assert_close(losses["loss_termination"], wanted.detach())
    torch.testing.assert_close(losses["loss"], losses["loss_policy"] + 0.5 * wanted)


def test_imitation_is_the_error_of_the_mode_at_demonstrated_steps_and_moves_the_policy_alone():
    model, batch = small(imitation_coef=2.0), windows()
    model.eval()
    shown = torch.zeros(6, 3, 1, dtype=torch.bool)
    shown[:2] = True

    def loss(flags=None):
        torch.manual_seed(0)
        marked = batch.clone() if flags is None else batch.clone().set("demonstrated", flags)
        model.zero_grad()
        result = model.loss(marked)
        result["loss"].backward()
        others = [
            p.grad.clone()
            for name, p in model.named_parameters()
            if p.grad is not None and "policy" not in name
        ]
        return result["loss"].detach(), others

    z, errors = model.encode(batch[:, 0]), []
    for t in range(3):
        errors.append((model.policy(z, deterministic=True) - batch["action"][:, t]).square().mean(-1))
        z = model.next(z, batch["action"][:, t])
    wanted = 2.0 * (torch.stack(errors, 1) * shown.squeeze(-1)).mean()  # less of them, less weight
    (plain, before), (imitating, after), (nowhere, _) = loss(), loss(shown), loss(torch.zeros_like(shown))
    torch.testing.assert_close(imitating - plain, wanted.detach(), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(nowhere, plain)
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_among_demonstrations_alone_the_policy_and_the_encoder_imitate():
    model, batch = small(imitation_coef=2.0), windows()
    randomise(model)
    model.eval()

    def loss(flags):
        torch.manual_seed(0)
        model.zero_grad()
        result = model.loss(batch.clone().set("demonstrated", flags))
        result["loss"].backward()
        return result, {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}

    some = torch.zeros(6, 3, 1, dtype=torch.bool)
    plain, before = loss(some)
    result, after = loss(~some)
    z = model.encode(batch)
    error = 2.0 * (model.policy(z, deterministic=True) - batch["action"]).square().mean()
    torch.testing.assert_close(result["loss"] - plain["loss"], (error - plain["loss_policy"]).detach())
    model.zero_grad()
    error.backward()  # what is new in all gradients but the policy's own, which is all of theirs
    for name, parameter in model.named_parameters():
        if parameter.grad is not None:
            wanted = parameter.grad + (0.0 if "policy" in name else before[name])
            torch.testing.assert_close(after[name], wanted, rtol=1e-4, atol=1e-6)
    assert {n.split(".")[0] for n in before if not torch.equal(before[n], after[n])} == {
        "encoder",
        "policy_head",
    }


def test_a_policy_imitates_alone_where_the_windows_of_all_processes_are_demonstrations(monkeypatch):
    """This one's are, another one's are not: processes share them unequally."""
    model, batch = small(imitation_coef=2.0), windows()
    randomise(model)
    model.eval()
    batch["demonstrated"] = torch.ones(6, 3, 1, dtype=torch.bool)

    def loss():
        torch.manual_seed(0)
        return model.loss(batch)["loss"].item()

    alone = loss()
    with monkeypatch.context() as patched:
        patched.setattr(model.policy_head, "all_shown", lambda shown: torch.tensor(False))
        among_others = loss()
    monkeypatch.setattr(processes, "mean", lambda x: x / 2)
    assert loss() == among_others != alone


@pytest.mark.parametrize(
    "wrong",
    [
        {"rho": -1.0},
        {"rho": 1.5},
        {"entropy_coef": -1.0},
        {"encoder_lr_scale": -1.0},
        {"log_std_max": 500.0},
        {"log_std_min": -500.0},
        {"encoder_grid": -3},
    ],
)
def test_what_would_train_it_the_wrong_way_is_refused(wrong):
    """A negative weight, or rate, ascends where it should descend."""
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}.*: must be"):
        small(**wrong)
