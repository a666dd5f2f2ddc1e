import pytest
import torch
from torch.nn import functional as F

from franka_wm.models import available, layers, make
from franka_wm.models.layers import (
    Ensemble,
    GaussianPolicy,
    SimNorm,
    TwoHotSymlog,
    mlp,
    symexp,
    symlog,
)
from franka_wm.models.returns import RunningScale, value_range


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_the_registry_names_what_exists():
    assert "tdmpc2" in available()
    with pytest.raises(ValueError, match="tdmpc2"):
        make("nonesuch")


def test_simnorm_gives_simplices_within_each_group():
    groups = SimNorm(4)(5 * torch.randn(3, 2, 12)).unflatten(-1, (3, 4))
    assert (groups >= 0).all()
    torch.testing.assert_close(groups.sum(-1), torch.ones(3, 2, 3))


def products(layer, x, *, grad=False, **autocast):
    """Whether the compiled layer has a product, and what it gives."""
    graphs = []

    def keep(graph, _):
        graphs.append(graph)
        return graph

    torch._dynamo.reset()
    with torch.set_grad_enabled(grad), torch.autocast("cpu", **(autocast or {"enabled": False})):
        given = torch.compile(layer, backend=keep)(x)
        torch.testing.assert_close(given, layer(x))
    return any("linear" in str(node.target) for graph in graphs for node in graph.graph.nodes)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(6,), (1, 6), (1, 1, 6)])
def test_one_row_is_a_sum_in_a_compiled_plan_on_a_cpu(shape, bias):
    assert not products(layers.Linear(6, 5, bias=bias), torch.randn(shape))


def test_everything_else_stays_a_product():
    layer, row = layers.Linear(6, 5), torch.randn(1, 6)
    assert products(layer, torch.randn(2, 6))
    assert products(layer, row, grad=True)
    assert products(layer, row, dtype=torch.bfloat16)  # one row is of the precision of many
    assert products(layers.Linear(0, 5), torch.randn(3, 0))
    for wrong in (row.double(), torch.randn(1, 1), torch.randn(1, 7)):
        with torch.no_grad(), pytest.raises(RuntimeError):
            torch.compile(layer, backend="eager")(wrong)


def test_mlp_starts_as_published():
    network = mlp(10, (200, 200), 7)
    linears = [m for m in network.modules() if isinstance(m, torch.nn.Linear)]
    assert all((layer.bias == 0).all() for layer in linears)
    assert linears[1].weight.std().item() == pytest.approx(0.02, rel=0.1)


def test_two_hot_round_trip_over_the_whole_range():
    code = TwoHotSymlog()
    x = torch.tensor([-2.0e4, -123.4, -1.0, -0.05, 0.0, 0.3, 1.0, 7.7, 60.0, 2.0e4]).unsqueeze(-1)
    p = code.encode(x)
    torch.testing.assert_close(p.sum(-1), torch.ones(10))
    assert ((p > 1e-6).sum(-1) <= 2).all()
    torch.testing.assert_close(code.decode((p + 1e-30).log()), x, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(symexp(symlog(x)), x, rtol=1e-4, atol=1e-5)


def test_two_hot_values_are_exact_under_autocast():
    """CUDA computes a softmax in float32 there, a CPU in bfloat16."""
    code, x = TwoHotSymlog(), torch.tensor([[50.0], [-37.0], [900.0]])
    logits = (code.encode(x) + 1e-30).log().to(torch.bfloat16)  # as a head returns them
    with torch.autocast("cpu", torch.bfloat16):
        found = code.decode(logits)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, code.decode(logits.float()), rtol=1e-5, atol=1e-5)
    wide = TwoHotSymlog().double()
    assert wide.decode(logits.double()).dtype == torch.float64


def test_two_hot_clamps_what_is_out_of_range():
    code = TwoHotSymlog(bins=11, low=-1.0, high=1.0)
    p = code.encode(torch.tensor([[-1e6], [1e6]]))
    assert p[0, 0] == 1 and p[1, -1] == 1


def test_two_hot_counts_what_is_out_of_range():
    code = TwoHotSymlog(bins=11, low=-1.0, high=2.0)  # from -1.72 to 6.39
    assert code.outside(torch.tensor([-1.7, 0.0, 6.3])) == 0.0
    assert code.outside(torch.tensor([[-1.8, 0.0]]), torch.tensor([6.5, 6.3])) == 0.5


@pytest.mark.parametrize(("least", "largest"), [(-1.01, 0.0), (-0.01, 1.0), (2.0, 3.0), (0.0, 1e6)])
@pytest.mark.parametrize("discount", [0.0, 0.95, 0.995])
def test_the_derived_range_holds_every_reward_return_and_bootstrapped_target(least, largest, discount):
    low, high = value_range(None, None, (least, largest), discount)
    code = TwoHotSymlog(101, low, high)
    rewards = torch.tensor([least, largest])
    returns = rewards / (1.0 - discount)
    ends = torch.tensor([symexp(torch.tensor(low)), symexp(torch.tensor(high))])
    assert code.outside(rewards, returns, torch.zeros(1), rewards + discount * ends) == 0.0
    size = returns.abs().max().log1p().item()
    assert high == -low and size < high < 1.1 * size  # and no further than a few points
    # Recorded bounds hold 0 besides, of rows without a reward.
    assert (low, high) == value_range(None, None, (min(least, 0.0), max(largest, 0.0)), discount)


def test_the_range_of_rewards_without_bounds_is_the_published_one_and_numbers_win():
    bounds = (-1.01, 0.0)
    assert value_range(None, None, None, 0.95) == (-10.0, 10.0)
    assert value_range(None, None, bounds, 1.0) == (-10.0, 10.0)  # returns have no bound
    assert value_range(None, None, (0.0, 0.0), 0.95) == (-10.0, 10.0)
    assert value_range(-4.0, 3.0, bounds, 0.95) == (-4.0, 3.0)
    low, high = value_range(-4.0, None, bounds, 0.95)
    assert low == -4.0 and 3.0 < high < 3.3
    for wrong in ((0.0, -1.0), (float("nan"), 0.0), (0.0, float("inf"))):
        with pytest.raises(ValueError, match="reward_bounds"):
            value_range(None, None, wrong, 0.95)


def test_two_hot_gradient_is_softmax_minus_target():
    code = TwoHotSymlog()
    logits, target = torch.randn(6, 101, requires_grad=True), 3 * torch.randn(6, 1)
    code.loss(logits, target).sum().backward()
    torch.testing.assert_close(logits.grad, logits.detach().softmax(-1) - code.encode(target))


def test_two_hot_fits_by_gradient_descent():
    code, target = TwoHotSymlog(), torch.tensor([[-40.0], [0.2], [3.0]])
    logits = torch.zeros(3, 101, requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.3)
    for _ in range(200):
        optimiser.zero_grad()
        code.loss(logits, target).mean().backward()
        optimiser.step()
    torch.testing.assert_close(code.decode(logits), target, rtol=0.05, atol=0.02)


def _ensemble(dropout: float = 0.0) -> Ensemble:
    ensemble = Ensemble(members=4, in_features=6, hidden=(16, 12), out_features=5, dropout=dropout)
    with torch.no_grad():
        for parameter in ensemble.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return ensemble


def test_the_ensemble_equals_a_loop_over_its_members():
    ensemble, x = _ensemble(), torch.randn(3, 7, 6)
    p = dict(ensemble.named_parameters())
    expected = []
    for k in range(4):
        h = x
        for i, width in enumerate((16, 12)):
            h = F.linear(h, p[f"weight_{i}"][k].T, p[f"bias_{i}"][k, 0])
            h = F.mish(F.layer_norm(h, (width,), p[f"norm_scale_{i}"][k, 0], p[f"norm_shift_{i}"][k, 0]))
        expected.append(F.linear(h, p["weight_2"][k].T, p["bias_2"][k, 0]))
    torch.testing.assert_close(ensemble(x), torch.stack(expected))
    chosen = torch.tensor([3, 1])
    torch.testing.assert_close(ensemble(x, members=chosen), torch.stack(expected)[chosen])


def test_a_fresh_ensemble_has_distinct_members_and_predicts_zero():
    ensemble = Ensemble(members=3, in_features=6, hidden=(16, 16), out_features=5)
    assert (ensemble(torch.randn(8, 6)) == 0).all()
    first = ensemble.get_parameter("weight_0")
    assert not torch.equal(first[0], first[1])


@pytest.mark.parametrize("weights", ["detached", "target"])
@pytest.mark.parametrize("members", [None, torch.tensor([0, 2])])
def test_detached_and_target_weights_pass_gradients_to_the_input_alone(weights, members):
    ensemble, x = _ensemble(), torch.randn(3, 6, requires_grad=True)
    ensemble.update_target(1.0)
    torch.testing.assert_close(ensemble(x, weights=weights), ensemble(x))
    ensemble(x, weights=weights, members=members).sum().backward()
    assert x.grad is not None and x.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in ensemble.parameters())


def test_the_target_moves_by_tau_exactly_and_is_not_trained():
    ensemble = _ensemble()
    before = {name: buffer.clone() for name, buffer in ensemble.named_buffers()}
    live = {name: parameter.detach().clone() for name, parameter in ensemble.named_parameters()}
    ensemble.update_target(0.25)
    for name, value in live.items():
        old = before[f"target_{name}"]
        torch.testing.assert_close(ensemble.get_buffer(f"target_{name}"), old + 0.25 * (value - old))
        assert torch.equal(ensemble.get_parameter(name), value)


def test_the_ensemble_drops_only_when_asked():
    ensemble, x = _ensemble(dropout=0.5), torch.randn(9, 6)
    assert torch.equal(ensemble(x), ensemble(x))
    assert not torch.equal(ensemble(x, dropout=True), ensemble(x, dropout=True))


def test_log_prob_of_the_squashed_gaussian_is_a_density():
    torch.manual_seed(0)
    policy = GaussianPolicy(latent_dim=3, hidden=(8,), action_dim=2)
    z = torch.randn(4, 5, 3)
    mean, log_std = policy.distribution(z)
    normal = torch.distributions.Normal(mean, log_std.exp())
    reference = torch.distributions.TransformedDistribution(
        normal, torch.distributions.transforms.TanhTransform(cache_size=1)
    )
    torch.manual_seed(1)
    action, log_prob = policy.sample(z)
    torch.testing.assert_close(
        log_prob, reference.log_prob(action).sum(-1, keepdim=True), rtol=1e-3, atol=1e-3
    )


def test_policy_is_bounded_and_finite_even_when_saturated():
    policy = GaussianPolicy(latent_dim=3, hidden=(8,), action_dim=2)
    with torch.no_grad():
        policy.network[-1].bias.fill_(40.0)  # type: ignore[union-attr]
    z = torch.randn(6, 3, requires_grad=True)
    action, log_prob = policy.sample(z)
    log_prob.sum().backward()
    assert (action.abs() <= 1).all() and torch.isfinite(log_prob).all()
    assert torch.isfinite(policy.network[-1].bias.grad).all()  # type: ignore[union-attr,arg-type]
    assert (policy.distribution(z)[1] <= 2.0).all()
    assert torch.equal(policy(z, deterministic=True), policy(z, deterministic=True))
    assert policy.distribution(z)[1].max().item() == pytest.approx(2.0)


def test_running_scale_follows_the_percentile_range():
    scale, x = RunningScale(tau=0.5), 100 * torch.randn(3, 40)
    expected = torch.quantile(x, 0.95) - torch.quantile(x, 0.05)
    scale.update(x)
    torch.testing.assert_close(scale.value, 0.5 + 0.5 * expected)
    small = RunningScale(tau=1.0)
    small.update(0.01 * x / 100)
    assert small.value == 1.0


# -- products padded for tensor cores ---------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["mlp", "ensemble", "members"])
def test_padding_changes_neither_results_nor_gradients(monkeypatch, kind):
    """As on CUDA: sizes 13, 10 and 5 become 16, 16 and 8."""
    if kind == "mlp":
        network = mlp(13, (10, 10), 5).double()
    else:
        network = Ensemble(members=3, in_features=13, hidden=(10, 10), out_features=5).double()
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter)
    x = torch.randn(4, 6, 13, dtype=torch.float64, requires_grad=True)
    options = {"members": 2} if kind == "members" else {}

    def results() -> list[torch.Tensor]:
        y = network(x, **options)
        return [y, *torch.autograd.grad(y.square().sum(), [x, *network.parameters()])]

    plain, padded_products = results(), []
    monkeypatch.setattr(layers, "_missing", lambda size, like: -size % 8)
    product = torch.baddbmm if kind != "mlp" else F.linear

    def noted(*inputs):
        padded_products.append([tuple(x.shape) for x in inputs])
        return product(*inputs)

    monkeypatch.setattr(*((torch, "baddbmm") if kind != "mlp" else (F, "linear")), noted)
    for found, expected in zip(results(), plain, strict=True):
        torch.testing.assert_close(found, expected)
    assert len(padded_products) == 3
    assert all(
        size[-2] % 8 == size[-1] % 8 == 0
        for sizes in padded_products
        for size in sizes[1:]
        if len(size) > 1 and size[-2] > 1
    )


def test_what_is_not_said_is_as_published():
    """Groups of 8; 101 classes from −10 to 10 in symlog; log standard deviations from −10 to 2."""
    assert SimNorm().group_size == 8
    two_hot = TwoHotSymlog()
    assert two_hot.support.shape == (101,)
    assert (two_hot.support[0].item(), two_hot.support[-1].item()) == (-10.0, 10.0)
    policy = GaussianPolicy(latent_dim=2, hidden=(4,), action_dim=1)
    assert (policy.log_std_min, policy.log_std_max) == (-10.0, 2.0)
    assert RunningScale().tau == 0.01


def test_numbers_are_decoded_along_the_last_dimension_alone():
    two_hot, logits = TwoHotSymlog(), torch.randn(2, 3, 4, 101)
    each = torch.stack([two_hot.decode(one) for one in logits.flatten(0, 2)]).view(2, 3, 4, 1)
    torch.testing.assert_close(two_hot.decode(logits), each)
