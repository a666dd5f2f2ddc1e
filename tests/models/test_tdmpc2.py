import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import make
from franka_wm.models.tdmpc2 import TDMPC2


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


SMALL = dict(latent_dim=32, simnorm_dim=8, encoder_dim=32, hidden_dim=32)


def small(**overrides) -> TDMPC2:
    settings = dict(observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.9, **SMALL)
    return make("tdmpc2", **{**settings, **overrides})


def windows(batch: int = 6, horizon: int = 3, *, reward: float | None = None) -> TensorDict:
    def observation() -> dict[str, torch.Tensor]:
        return {"state": torch.randn(batch, horizon, 3), "joint_target": torch.randn(batch, horizon, 2)}

    rewards = torch.randn(batch, horizon, 1) if reward is None else torch.full((batch, horizon, 1), reward)
    terminated = torch.zeros(batch, horizon, 1, dtype=torch.bool)
    data = TensorDict(
        {
            **observation(),
            "action": torch.rand(batch, horizon, 2) * 2 - 1,
            "next": {**observation(), "reward": rewards, "terminated": terminated},
        },
        batch_size=[batch, horizon],
    )
    for key in ("state", "joint_target"):  # contiguous: what follows a step is the root of the following one
        data["next", key][:, :-1] = data[key][:, 1:]
    return data


def randomise(model: TDMPC2) -> None:
    """Leave the zero initialisation of the reward and value heads, behind which gradients vanish."""
    with torch.no_grad():
        model.reward_head[-1].weight.normal_(std=0.5)  # type: ignore[union-attr,operator]
        model.q_ensemble.weight_2.normal_(std=0.5)  # type: ignore[operator]
    model.q_ensemble.update_target(1.0)


def optimiser_of(model: TDMPC2, lr: float = 1e-3) -> torch.optim.Adam:
    return torch.optim.Adam(model.parameter_groups(lr), fused=True)


def update(model: TDMPC2, optimiser: torch.optim.Adam, batch: TensorDict) -> TensorDict:
    losses = model.loss(batch)
    optimiser.zero_grad()
    losses["loss"].backward()
    optimiser.step()
    model.after_update()
    return losses.detach()


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


def test_the_policy_loss_is_as_documented():
    """-Σ ρ^t (Q / scale + coefficient · A · entropy of the actions), over four latents."""
    model = small(entropy_coef=0.25, rho=0.3).eval()
    randomise(model)
    model.scale.value.fill_(4.0)
    with torch.no_grad():
        model.policy_head.network[-1].weight.normal_(std=0.1)  # type: ignore[union-attr,operator]
    batch, handed = windows(), []

    def policy_loss(z, weight):
        handed.append(z)
        torch.manual_seed(1)
        return model._policy_loss(z, weight)

    losses = model.loss(batch, parts={"_policy_loss": policy_loss})
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
        data = _point_mass(batch)
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


def test_one_backward_keeps_policy_and_model_gradients_apart():
    torch.manual_seed(0)
    batch = windows()

    def gradients(**coefficients) -> dict[str, torch.Tensor | None]:
        torch.manual_seed(1)
        model = small(dropout=0.0, **coefficients)
        randomise(model)
        torch.manual_seed(2)
        model.loss(batch)["loss"].backward()
        return {name: p.grad for name, p in model.named_parameters()}

    full = gradients()
    policy_alone = gradients(consistency_coef=0.0, reward_coef=0.0, value_coef=0.0)
    for name, gradient in full.items():
        assert gradient is not None and gradient.abs().sum() > 0, f"{name} gets no gradient"
        alone = policy_alone[name]
        if name.startswith("policy_head"):  # the model losses do not reach the policy
            torch.testing.assert_close(gradient, alone)
        else:  # the policy loss reaches nothing else: not the critic, not the encoder
            assert alone is None or alone.abs().max() == 0, name


def test_target_and_detached_parameters_do_not_move_with_the_optimiser():
    model, batch = small(), windows()
    randomise(model)
    optimiser = optimiser_of(model)
    targets = {name: b.clone() for name, b in model.q_ensemble.named_buffers()}
    model.loss(batch)["loss"].backward()
    optimiser.step()
    assert all(torch.equal(b, targets[name]) for name, b in model.q_ensemble.named_buffers())
    model.after_update()
    name = "weight_1"
    old, live = targets[f"target_{name}"], model.q_ensemble.get_parameter(name).detach()
    moved = model.q_ensemble.get_buffer(f"target_{name}")
    torch.testing.assert_close(moved, old + 0.01 * (live - old))
    assert not torch.equal(moved, old)


def test_a_terminated_step_has_the_reward_as_its_target_and_a_truncated_one_bootstraps():
    model, batch = small(), windows(reward=2.0)
    randomise(model)
    with torch.no_grad():
        model.q_ensemble.get_parameter("bias_2")[..., 80] += 12.0  # every value is about symexp(6) = 402
    model.q_ensemble.update_target(1.0)
    bootstrapped = model.loss(batch)["q_target_mean"]
    assert bootstrapped > 100
    batch["next", "truncated"] = torch.ones(6, 3, 1, dtype=torch.bool)
    assert model.loss(batch)["q_target_mean"] > 100
    batch["next", "terminated"][:] = True
    assert model.loss(batch)["q_target_mean"] == pytest.approx(2.0)


def test_targets_come_from_the_slow_copies():
    model, batch = small(), windows()
    randomise(model)
    torch.manual_seed(1)
    before = model.loss(batch)
    with torch.no_grad():
        model.q_ensemble.get_parameter("bias_2")[..., 80] += 12.0
    torch.manual_seed(1)
    after = model.loss(batch)
    assert after["q_target_mean"] == before["q_target_mean"]
    assert after["q_mean"] > before["q_mean"] + 100


def test_the_last_next_observation_is_learned_from():
    model, batch = small(dropout=0.0), windows()
    changed = batch.clone()
    changed["next", "state"][:, -1] += 1.0
    assert model.loss(changed)["loss_consistency"] != model.loss(batch)["loss_consistency"]
    # while what the following root holds already is not read twice
    changed = batch.clone()
    changed["next", "state"][:, :-1] = torch.nan
    torch.testing.assert_close(model.loss(changed)["loss_consistency"], model.loss(batch)["loss_consistency"])


def test_a_window_of_images_is_its_frames_and_the_last_next_one():
    model = small(image_sizes={"pixels": (64, 64, 3)}).eval()
    frames = torch.randint(256, (2, 5, 64, 64, 3), dtype=torch.uint8)
    pieces = {"pixels": frames, "state": torch.randn(2, 5, 3), "joint_target": torch.randn(2, 5, 2)}
    after = {key: value[:, 1:] for key, value in pieces.items()}
    root = {key: value[:, :-1] for key, value in pieces.items()}
    batch = TensorDict(root | {"next": TensorDict(after, batch_size=[2, 4])}, batch_size=[2, 4])
    moments = [
        TensorDict({key: value[:, t] for key, value in pieces.items()}, batch_size=[2]) for t in range(5)
    ]
    expected = [model.encode(moment) for moment in moments]
    torch.testing.assert_close(model._encode_window(batch), torch.stack(expected))


def test_the_target_is_the_smaller_of_two_distinct_members():
    model = small()
    randomise(model)
    z, action = model.encode(windows(1, 1)), torch.rand(1, 1, 2)
    members = model.two_hot.decode(model.q_ensemble(torch.cat((z, action), -1))).flatten()
    second_largest = members.sort().values[-2]
    seen = {round(model.q(z, action, reduce="pair_min").item(), 3) for _ in range(200)}
    assert max(seen) <= second_largest + 1e-3  # the largest is never the minimum of two distinct ones
    assert len(seen) == 4
    torch.testing.assert_close(model.q(z, action).flatten(), members.mean(0, keepdim=True))


def test_value_is_deterministic_in_evaluation_and_on_demand():
    model = small(dropout=0.5)
    randomise(model)
    z = model.encode(windows())
    assert not torch.equal(model.value(z), model.value(z))
    assert torch.equal(model.value(z, deterministic=True), model.value(z, deterministic=True))
    model.eval()
    assert torch.equal(model.value(z), model.value(z))
    assert not torch.equal(model.value(z, deterministic=False), model.value(z, deterministic=False))


def test_evaluating_the_loss_leaves_the_scale_alone():
    model, batch = small(), windows()
    randomise(model)
    model.eval()
    model.loss(batch)
    assert model.scale.value == 1.0
    model.train()
    for _ in range(3):
        model.loss(batch)
    assert model.scale.value > 1.0


def test_parameter_groups_hold_every_parameter_once():
    model = small()
    groups = model.parameter_groups(1e-3)
    held = [id(p) for group in groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in model.parameters())
    by_name = {group["name"]: group for group in groups}
    assert by_name["encoder"]["lr"] == pytest.approx(3e-4) and by_name["model"]["lr"] == 1e-3
    assert by_name["policy"]["eps"] == 1e-5
    assert {g["name"]: g["clip"] for g in groups} == {
        "encoder": "model",
        "model": "model",
        "policy": "policy",
    }


def test_the_loss_refuses_single_transitions():
    with pytest.raises(ValueError, match=r"\[B, H\]"):
        small().loss(windows()[:, 0])


def test_a_saved_model_is_the_same_model():
    model = small()
    randomise(model)
    model.set_observation_statistics(torch.randn(5), torch.rand(5))
    other = small()
    other.load_state_dict(model.state_dict())
    batch = windows()
    assert torch.equal(other.encode(batch), model.encode(batch))
    assert torch.equal(
        other.q(model.encode(batch), batch["action"], weights="target"),
        model.q(model.encode(batch), batch["action"], weights="target"),
    )


def _point_mass(batch: int, horizon: int = 3) -> TensorDict:
    """A point x in [-1, 1] moved by 0.3 a; reward 1 - |x'|, so returns lie in [0, 1 / (1 - γ)]."""
    x = torch.rand(batch, 1) * 2 - 1
    action = torch.rand(batch, horizon, 1) * 2 - 1
    states = [x]
    for t in range(horizon):
        states.append((states[-1] + 0.3 * action[:, t]).clamp(-1, 1))
    s = torch.stack(states, 1)
    return TensorDict(
        {
            "state": s[:, :-1],
            "action": action,
            "next": {
                "state": s[:, 1:],
                "reward": 1 - s[:, 1:].abs(),
                "terminated": torch.zeros(batch, horizon, 1, dtype=torch.bool),
            },
        },
        batch_size=[batch, horizon],
    )


def test_on_a_tiny_problem_the_losses_fall_the_critic_stays_true_and_the_policy_heads_home():
    torch.manual_seed(0)
    model = small(observation_sizes={"state": 1}, action_dim=1, discount=0.8, tau=0.05)
    optimiser = optimiser_of(model, lr=3e-3)
    history = [update(model, optimiser, _point_mass(64)) for _ in range(500)]
    first, last = history[5], history[-1]
    assert last["reward_error"] < 0.3 * first["reward_error"]
    # Returns lie in [0, 1 / (1 - 0.8) = 5]; a critic driven by its policy runs off to symexp(10).
    assert max(float(h["q_mean"]) for h in history) < 5.0
    assert 2.0 < last["q_mean"] < 5.0
    model.eval()
    at = TensorDict({"state": torch.tensor([[-0.8], [0.8]])}, [2])
    z = model.encode(at)
    action = model.policy(z, deterministic=True)
    assert action[0] > 0.3 and action[1] < -0.3
    # one step on, the dynamics' latent is that of the true next observation
    push = torch.tensor([[1.0], [-1.0]])
    true_next = model.encode(TensorDict({"state": torch.tensor([[-0.5], [0.5]])}, [2]))
    near = (model.next(z, push) - true_next).norm(dim=-1)
    far = (z - true_next).norm(dim=-1)
    assert (near < 0.5 * far).all()


def test_the_update_traces_without_graph_breaks_or_host_reads():
    """Data-dependent control flow or `.item()` in the loss fails here before it fails in a CUDA graph."""
    model, batch = small(), windows()
    randomise(model)
    seen: list[bool] = []

    def loss(**data: torch.Tensor) -> torch.Tensor:
        seen.append(True)
        nested = TensorDict(
            {
                "state": data["state"],
                "joint_target": data["joint_target"],
                "action": data["action"],
                "next": {k.removeprefix("next_"): v for k, v in data.items() if k.startswith("next_")},
            },
            batch_size=[6, 3],
        )
        return model.loss(nested)["loss"]

    flat = {"_".join(k) if isinstance(k, tuple) else k: v for k, v in batch.items(True, True)}
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    torch.manual_seed(3)
    expected = loss(**flat)
    model.scale.value.fill_(1.0)
    torch.manual_seed(3)
    torch.testing.assert_close(compiled(**flat), expected)


def test_the_value_averages_as_many_members_as_asked():
    model = small(num_q=3).eval()
    randomise(model)
    z = model.encode(windows()[:, 0])
    x = torch.cat((z, model.policy(z, deterministic=True)), -1)
    members = model.two_hot.decode(model.q_ensemble(x))
    torch.testing.assert_close(model.value(z), members.mean(0))
    model.value_members = 2
    torch.testing.assert_close(model.value(z), members[:2].mean(0))
    assert not torch.allclose(members[:2].mean(0), members.mean(0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_side_by_side_is_as_one_after_the_other(monkeypatch):
    """On a GPU, losses and gradients do not depend on the streams that they are computed on."""
    from franka_wm.models import tdmpc2

    class Plainly:
        def __init__(self, *inputs, lane=0): ...

        def __enter__(self):
            return self

        def __exit__(self, *error): ...

        def join(self, *outputs): ...

    model = make("tdmpc2", observation_sizes={"state": 20}, action_dim=7, episode_length=20).cuda().eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    shape = (256, 3)
    batch = TensorDict(
        {
            "state": torch.randn(*shape, 20),
            "action": torch.rand(*shape, 7) * 2 - 1,
            "next": TensorDict(
                {
                    "state": torch.randn(*shape, 20),
                    "reward": torch.randn(*shape, 1),
                    "terminated": torch.rand(*shape, 1) < 0.1,
                },
                batch_size=shape,
            ),
        },
        batch_size=shape,
    ).cuda()

    def results():
        found = []
        for seed in range(20):
            torch.manual_seed(seed)
            model.zero_grad()
            losses = model.loss(batch)
            losses["loss"].backward()
            found += [losses["loss"].detach().clone(), *(p.grad.clone() for p in model.parameters())]
        return found

    beside = results()
    monkeypatch.setattr(tdmpc2, "side_stream", Plainly)
    for found, expected in zip(beside, results(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
