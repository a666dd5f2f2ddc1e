# pyright: reportIndexIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportOptionalMemberAccess=false

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn import functional as F

from franka_wm.errors import UserError
from franka_wm.models import make
from franka_wm.models.muzero import MuZero

MOVES = 3
SMALL = dict(
    latent_dim=32, simnorm_dim=8, encoder_dim=32, hidden_dim=32, projector_dim=16, unroll=3, n_step=2
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def small(**overrides) -> MuZero:
    settings = dict(
        observation_sizes={"state": 3, "joint_target": 2}, num_actions=MOVES, discount=0.9, **SMALL
    )
    return make("muzero", **{**settings, **overrides})


def windows(
    batch: int = 6, length: int = 5, *, ends: int | None = None, terminated: bool = False, **images
) -> TensorDict:
    """Windows whose first episode has `ends` transitions; None: all."""

    def observation() -> dict[str, torch.Tensor]:
        vectors = {"state": torch.randn(batch, length, 3), "joint_target": torch.randn(batch, length, 2)}
        pictures = {
            key: torch.randint(0, 256, (batch, length, *size), dtype=torch.uint8)
            for key, size in images.items()
        }
        return vectors | pictures

    ends = length if ends is None else ends
    over, first = torch.zeros(2, batch, length, 1, dtype=torch.bool)
    over[:, ends - 1] = terminated
    first[:, ends:][:, :1] = True
    data = TensorDict(
        {
            **observation(),
            "action": torch.randint(MOVES, (batch, length)),
            "search_policy": torch.randn(batch, length, MOVES).softmax(-1),
            "search_value": torch.randn(batch, length, 1),
            "next": {**observation(), "reward": torch.randn(batch, length, 1), "terminated": over},
            "is_init": first,
        },
        batch_size=[batch, length],
    )
    for key in ("state", "joint_target", *images):
        data["next", key][:, :-1] = data[key][:, 1:]
    return data


def randomise(model: MuZero) -> None:
    """Leave the zero initialisation of the heads, behind which gradients vanish."""
    for head in (model.reward_head, model.value_head, model.policy_head):
        torch.nn.init.normal_(head.weight, std=0.3)


# ------------------------------------------------------------------ the parts


@pytest.mark.parametrize("leading", [(), (4,), (2, 3, 4)])
def test_every_part_takes_any_leading_dimensions(leading):
    model = small()
    observation = TensorDict(
        {"state": torch.randn(*leading, 3), "joint_target": torch.randn(*leading, 2)}, leading
    )
    z, action = model.encode(observation), torch.randint(MOVES, leading)
    assert z.shape == model.next(z, action).shape == (*leading, 32)
    assert model.reward(z, action).shape == model.value(z).shape == (*leading, 1)
    for deterministic in (True, False):
        move = model.policy(z, deterministic=deterministic)
        assert move.shape == leading and move.dtype == torch.int64
    logits, value = model.prediction(z)
    assert logits.shape == (*leading, MOVES) and value.shape == (*leading, 1)
    after, reward, discount, logits, value = model.recurrent(z, action)
    torch.testing.assert_close(after, model.next(z, action))
    torch.testing.assert_close(reward, model.reward(z, action))
    torch.testing.assert_close(value, model.value(after))
    torch.testing.assert_close(logits, model.prediction(after)[0])
    assert discount.shape == (*leading, 1) and (discount == 0.9).all()


def test_one_row_of_a_compiled_search_has_no_product_to_call():
    model, graphs = small().eval(), []
    torch._dynamo.reset()
    compiled = torch.compile(model.recurrent, backend=lambda graph, _: graphs.append(graph) or graph)
    with torch.no_grad():
        compiled(torch.rand(1, 32), torch.zeros(1, dtype=torch.int64))
    called = [node.target for graph in graphs for node in graph.graph.nodes if node.op == "call_function"]
    assert called and F.linear not in called


def test_latents_are_simplices_and_moves_matter():
    model = small()
    z = model.encode(windows())
    afters = [model.next(z, torch.full((6, 5), move)) for move in range(MOVES)]
    for latent in (z, *afters):
        torch.testing.assert_close(latent.unflatten(-1, (4, 8)).sum(-1), torch.ones(6, 5, 4))
    assert not torch.allclose(afters[0], afters[1])


def test_first_predictions_are_zero_and_all_moves_alike():
    model = small()
    z = model.encode(windows())
    logits, value = model.prediction(z)
    assert logits.abs().max() == 0 and value.abs().max() < 1e-5
    assert model.reward(z, torch.zeros(6, 5, dtype=torch.int64)).abs().max() < 1e-5


def test_the_sampled_policy_follows_its_logits():
    model = small()
    with torch.no_grad():
        model.policy_head.bias.copy_(torch.tensor([1.0, 0.0, -1.0]))
    z = model.encode(windows())[0, 0].expand(5000, -1)
    shares = F.one_hot(model.policy(z), MOVES).float().mean(0)
    torch.testing.assert_close(shares, model.policy_head.bias.softmax(-1).detach(), atol=0.03, rtol=0)
    assert (model.policy(z, deterministic=True) == 0).all()


def test_observation_statistics_standardise_vectors():
    model, batch = small(), windows()
    mean, std = torch.randn(5), torch.rand(5) + 0.5
    plain = model.encode(batch)
    moved = batch.clone()
    moved["state"] = batch["state"] * std[:3] + mean[:3]
    moved["joint_target"] = batch["joint_target"] * std[3:] + mean[3:]
    model.set_observation_statistics(mean, std)
    torch.testing.assert_close(model.encode(moved), plain)
    with pytest.raises(ValueError, match="finite"):
        model.set_observation_statistics(mean * torch.nan, std)
    with pytest.raises(ValueError, match="shape"):
        model.set_observation_statistics(mean[:3], std)


def test_discount_is_given_or_follows_the_episode_length():
    assert small(discount=None).discount == 0.997
    assert small(discount=None, episode_length=20).discount == pytest.approx(0.95)
    assert small(discount=None, episode_length=250).discount == pytest.approx(0.98)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (dict(simnorm_dim=7), "simnorm_dim"),
        (dict(num_actions=0), "num_actions"),
        (dict(observation_sizes={}), "observation_sizes"),
        (dict(discount=1.1), "discount"),
        (dict(unroll=0), "unroll"),
        (dict(n_step=0), "n_step"),
    ],
)
def test_settings_that_cannot_work_are_refused(overrides, said):
    with pytest.raises(ValueError, match=said):
        small(**overrides)


# ------------------------------------------------------------------ targets


def returns_by_hand(reward, ends, value, discount, n):
    """One window, as a sentence would say it."""
    length, found = len(reward), []
    for t in range(length):
        last = min(t + n, length if ends else length - 1)
        total = sum(discount ** (k - t) * reward[k] for k in range(t, last))
        if last < length:
            total += discount ** (last - t) * value[last]
        found.append(total)
    return found


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize(("length", "n"), [(5, 2), (7, 3), (4, 1), (3, 3), (3, 8), (1, 5)])
def test_value_targets_are_the_n_step_returns(ends, length, n):
    model, batch = small(n_step=n), windows(4, length, terminated=ends)
    reward, value = batch["next", "reward"], batch["search_value"]
    targets = model.value_targets(reward, batch["next", "terminated"], value)
    for b in range(4):
        wanted = returns_by_hand(reward[b, :, 0].tolist(), ends, value[b, :, 0].tolist(), 0.9, n)
        torch.testing.assert_close(targets[b, :, 0], torch.tensor(wanted))


def test_value_targets_in_numbers():
    reward = torch.tensor([1.0, 2.0, 3.0, 4.0]).view(1, 4, 1)
    value = torch.tensor([10.0, 20.0, 30.0, 40.0]).view(1, 4, 1)
    model = small(discount=0.5, n_step=2)
    going, over = torch.zeros(1, 4, 1, dtype=torch.bool), torch.zeros(1, 4, 1, dtype=torch.bool)
    over[:, -1] = True
    # 1 + 2/2 + 30/4;  2 + 3/2 + 40/4;  3 + 40/2 (the window is over);  40
    assert model.value_targets(reward, going, value).flatten().tolist() == [9.5, 13.5, 23.0, 40.0]
    # …;  3 + 4/2;  4: the episode is over
    assert model.value_targets(reward, over, value).flatten().tolist() == [9.5, 13.5, 5.0, 4.0]


def test_a_window_holds_the_whole_target_of_the_last_step():
    """Unroll 3, n_step 2: the value of step 3 sums the rewards of steps 3 and 4 and ends in the search of step 5."""
    model = small()
    batch = windows(4, model.window)
    reward, value = batch["next", "reward"], batch["search_value"]
    last = model.value_targets(reward, batch["next", "terminated"], value)[:, model.unroll]
    torch.testing.assert_close(last, reward[:, 3] + 0.9 * reward[:, 4] + 0.81 * value[:, 5])
    assert model.window == 6
    MuZero.validate(SMALL, window=6)
    with pytest.raises(UserError, match=r"replay\.window=6"):
        MuZero.validate(SMALL, window=5)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("held", [1, 3, 5])
def test_the_losses_are_those_of_a_plain_unroll(ends, held):
    """One window, one step at a time; steps past the end of its episode count only where that terminated."""
    model, length = small(random_shift=0), 5
    randomise(model)
    batch = windows(1, length, ends=held, terminated=ends)
    losses = model.loss(batch)

    own = batch[:, :held]  # what is of the first episode
    returns = model.value_targets(own["next", "reward"], own["next", "terminated"], own["search_value"])
    frames = torch.cat((model.encode(own), model.encode(own["next"])[:, -1:]), 1)[0]
    z, policy, value, reward, consistency = frames[0], 0.0, 0.0, 0.0, 0.0
    for k in range(model.unroll + 1):
        scale = 1.0 if k == 0 else 1.0 / model.unroll
        logits, _ = model.prediction(z)
        value_logits = model.value_head(model.prediction_body(z))
        if k < held:
            value += scale * model.two_hot.loss(value_logits, returns[0, k]).item()
            policy += scale * F.cross_entropy(logits, own["search_policy"][0, k]).item()
        elif ends:
            value += scale * model.two_hot.loss(value_logits, torch.zeros(1)).item()
        if k == model.unroll or k >= held:
            break  # moves past the end are random: checked below
        body = model._body(z, own["action"][0, k])
        target = own["next", "reward"][0, k]
        reward += model.two_hot.loss(model.reward_head(body), target).item() / model.unroll
        z = model.next(z, own["action"][0, k])
        consistency += model._consistency(z, frames[k + 1]).item() / model.unroll
    assert losses["loss_policy"].item() == pytest.approx(policy, rel=1e-4)
    assert losses["loss_consistency"].item() == pytest.approx(consistency, rel=1e-4)
    if model.unroll <= held or not ends:
        assert losses["loss_value"].item() == pytest.approx(value, rel=1e-4)
        assert losses["loss_reward"].item() == pytest.approx(reward, rel=1e-4)
    else:  # there is more to learn past the end
        assert losses["loss_value"].item() > value * (1 + 1e-4)
        assert losses["loss_reward"].item() > reward * (1 + 1e-4)
    total = losses["loss_reward"] + 0.25 * losses["loss_value"] + losses["loss_policy"]
    total = total + 2.0 * losses["loss_consistency"]
    torch.testing.assert_close(losses["loss"].detach(), total)


@pytest.mark.parametrize(("ends", "terminated"), [(8, False), (5, False), (5, True), (1, False), (2, True)])
def test_reanalyzed_values_are_the_models_and_not_the_searchs(ends, terminated):
    """unroll 3, n_step 2: the targets of steps 0 … 3 end at steps 2 … 5, or with the episode."""
    model, batch = small(reanalyze=True, discount=0.5), windows(length=8, ends=ends, terminated=terminated)
    torch.nn.init.normal_(model.value_head.weight)
    scrambled = batch.clone()
    scrambled["search_value"].normal_(100.0, 10.0)
    rng = torch.get_rng_state()
    found = model.loss(batch)
    torch.set_rng_state(rng)
    other = model.loss(scrambled)
    for name in ("loss", "loss_value", "value_target_mean"):
        torch.testing.assert_close(found[name], other[name])

    stop = min(2, ends - 1)
    if terminated and ends <= 2:
        bootstrap = torch.zeros(6, 1)  # over: no bootstrap
        summed = ends
    else:
        bootstrap = model.prediction(model.encode(batch[:, stop]))[1].detach()
        summed = stop
    rewards = batch["next", "reward"][:, :summed, 0] * 0.5 ** torch.arange(summed)
    expected = rewards.sum(-1, keepdim=True) + 0.5**summed * bootstrap
    torch.testing.assert_close(found["value_target_mean"], expected.mean())
    assert not found["value_target_mean"].requires_grad
    # No gradient reaches the model through its own targets.
    assert not model._present_values(batch, torch.full((6, 1), ends)).requires_grad


@pytest.mark.parametrize("terminated", [False, True])
def test_what_follows_the_end_of_an_episode_changes_nothing(terminated):
    model, batch = small(random_shift=0), windows(6, 5, ends=2, terminated=terminated)
    randomise(model)
    other = batch.clone()
    other[:, 2:] = windows(6, 3)
    other["is_init"] = batch["is_init"]
    for data in (batch, other):
        torch.manual_seed(1)  # of the moves past the end
        data["losses"] = model.loss(data).expand(6, 5)
    for name in ("loss_reward", "loss_value", "loss_policy", "loss_consistency"):
        assert torch.equal(batch["losses", name], other["losses", name])
    whole = batch[:, :2]
    wanted = model.value_targets(whole["next", "reward"], whole["next", "terminated"], whole["search_value"])
    found = model.value_targets(
        batch["next", "reward"], batch["next", "terminated"], batch["search_value"], torch.full((6, 1), 2)
    )
    torch.testing.assert_close(found[:, :2], wanted)


def test_weights_scale_the_loss_of_their_window():
    model, batch = small(), windows(2)
    randomise(model)
    first, second = (model.loss(batch[b : b + 1])["loss"] for b in range(2))
    batch["weight"] = torch.tensor([2.0, 0.5]).view(2, 1, 1).expand(2, 5, 1)
    torch.testing.assert_close(model.loss(batch)["loss"], (2.0 * first + 0.5 * second) / 2)


def test_the_range_of_values_follows_the_rewards_and_rebuilds():
    model = small(reward_bounds=(0.0, 1.0), discount=0.95)
    assert 3.0 < model.two_hot.high < 3.3 and model.two_hot.low == -model.two_hot.high
    again = small(discount=0.95, **model.rebuild_overrides())
    assert torch.equal(again.two_hot.support, model.two_hot.support)
    assert small(reward_bounds=(0.0, 1.0), discount=1.0).two_hot.high == 10.0


def test_targets_outside_of_the_range_are_counted():
    """A reward of 3 in each step: all three rewards, and the sums of two that the four value targets hold."""
    batch = windows()
    batch["next", "reward"][:], batch["search_value"][:] = 3.0, 0.0
    assert small().loss(batch)["target_outside"] == 0.0
    assert small(value_high=1.5).loss(batch)["target_outside"] == pytest.approx(3 / 7)  # symexp(1.5) = 3.48
    assert small(value_high=1.0).loss(batch)["target_outside"] == 1.0


# ------------------------------------------------------------------ gradients


def test_gradients_reach_everything_and_every_parameter_is_in_one_group():
    model = small()
    randomise(model)
    model.loss(windows())["loss"].backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    groups = model.parameter_groups(1e-3)
    grouped = [id(p) for group in groups for p in group["params"]]
    assert len(grouped) == len(set(grouped)) == len(list(model.parameters()))
    assert {group["weight_decay"] for group in groups} == {0.0, 1e-4}


def test_no_gradient_passes_through_what_came():
    """Only the first observation of an unroll is learned from as an input."""
    model = small()
    randomise(model)
    batch = windows()
    batch["state"].requires_grad_()
    batch["next", "state"].requires_grad_()
    batch["search_value"].requires_grad_()
    model.loss(batch)["loss"].backward()
    reached = batch["state"].grad.abs().amax((0, 2)) > 0
    assert reached.tolist() == [True, False, False, False, False]
    assert batch["next", "state"].grad is None or batch["next", "state"].grad.abs().max() == 0
    assert batch["search_value"].grad is None


def test_the_gradient_is_halved_at_each_use_of_the_dynamics():
    """With a value loss at the last step alone: a chain of K - 1 halvings against none."""
    batch = windows(4, 5)
    gradients = []
    for halve in (True, False):
        torch.manual_seed(1)
        model = small(policy_coef=0.0, consistency_coef=0.0, value_coef=0.0, reward_coef=1.0)
        randomise(model)
        z = model.encode(batch)[:, 0].detach().requires_grad_()
        latents, here = [], z
        for k in range(3):
            here = model.next(here, batch["action"][:, k])
            latents.append(here)
            if halve:
                here = 0.5 * here + 0.5 * here.detach()
        last = model._body(here, batch["action"][:, 3])
        gradients.append(torch.autograd.grad(model.reward_head(last).square().sum(), z)[0])
    torch.testing.assert_close(gradients[0] * 8, gradients[1])

    # And the loss does just that: its encoder gradient from the rewards is that of the halved chain.
    model = small(policy_coef=0.0, consistency_coef=0.0, value_coef=0.0)
    randomise(model)
    model.loss(batch)["loss"].backward()
    got = model.encoder[0].linear.weight.grad.clone()
    model.zero_grad()
    here, total = model.encode(batch)[:, 0], 0.0
    for k in range(3):
        body = model._body(here, batch["action"][:, k])
        target = batch["next", "reward"][:, k]
        total = total + model.two_hot.loss(model.reward_head(body), target).mean() / 3
        here = model.dynamics_head(body)
        here = 0.5 * here + 0.5 * here.detach()
    total.backward()
    torch.testing.assert_close(got, model.encoder[0].linear.weight.grad)


# ------------------------------------------------------------------ form


def test_pictures_with_and_without_vectors():
    for sizes in ({"state": 3, "joint_target": 2}, {}):
        model = small(observation_sizes=sizes, image_sizes={"pixels": (64, 64, 3)})
        assert model.observation_keys == [*sizes, "pixels"]
        batch = windows(2, 4, pixels=(64, 64, 3))
        assert model.encode(batch[0]).shape == (4, 32)
        losses = model.loss(batch)
        losses["loss"].backward()
        assert torch.isfinite(losses["loss"])
        assert any(p.grad.abs().max() > 0 for n, p in model.named_parameters() if "convolutions" in n)


@pytest.mark.parametrize("scale", [0.0, 1e6])
def test_extreme_inputs_stay_finite(scale):
    model, batch = small(), windows(terminated=True)
    for key in ("state", "joint_target", ("next", "state"), ("next", "reward"), "search_value"):
        batch[key] = batch[key] * scale
    batch["search_policy"] = F.one_hot(batch["action"], MOVES).float()  # no mass at all on the others
    optimiser = torch.optim.AdamW(model.parameter_groups(1e-2))
    for _ in range(20):
        losses = model.loss(batch)
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
        assert all(torch.isfinite(value).all() for value in losses.values())
    assert all(torch.isfinite(p).all() for p in model.parameters())


def test_mistakes_are_named():
    model, batch = small(), windows()
    with pytest.raises(ValueError, match=r"\[B, H\]"):
        model.loss(batch[0])
    with pytest.raises(ValueError, match="unroll=3"):
        model.loss(batch[:, :2])
    with pytest.raises(ValueError, match="search_policy"):
        model.loss(batch.exclude("search_policy"))


@pytest.mark.parametrize("reanalyze", [False, True])
def test_the_loss_reads_nothing_on_the_host(reanalyze):
    with FakeTensorMode():
        model = small(reanalyze=reanalyze, image_sizes={"pixels": (64, 64, 3)}, channels=4)
        batch = windows(pixels=(64, 64, 3))
        losses = model.loss(batch)
        losses["loss"].backward()
    assert losses["loss"].shape == ()
