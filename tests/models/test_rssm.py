"""The recurrent state-space model: its pieces against plain loops and torch's distributions."""

import pytest
import torch
from torch.nn import functional as F

from franka_wm.models.rssm import RSSM, BlockLinear, RMSNorm, divergence, layer, network


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def small(unimix: float = 0.01) -> RSSM:
    return RSSM(
        embed_dim=16, action_dim=2, deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, unimix=unimix
    )


def test_blocks_are_a_block_diagonal_matrix():
    layer = BlockLinear(6, 4, 2)
    with torch.no_grad():
        layer.bias.normal_()
    x = torch.randn(3, 5, 6)
    dense = torch.block_diag(*layer.weight)
    torch.testing.assert_close(layer(x), x @ dense + layer.bias.flatten())


def test_the_recurrent_step_is_a_gated_unit_whose_blocks_see_their_own_memory_and_all_inputs():
    rssm = small()
    z, action = torch.randn(5, rssm.size), torch.rand(5, 2) * 2 - 1
    h, s = z[:, :16], z[:, 16:]
    shared = torch.cat((rssm.of_deter(h), rssm.of_codes(s), rssm.of_action(action)), -1)
    inputs = rssm.mix_inputs.weight.mT.unflatten(-1, (2, 8))
    parts = [h[:, 8 * k : 8 * k + 8] @ rssm.mix.weight[k] + shared @ inputs[:, k] for k in range(2)]
    x = F.silu(rssm.mix_norm(torch.cat(parts, -1) + rssm.mix.bias.flatten()))
    after = []
    for k in range(2):
        gates = x[:, 8 * k : 8 * k + 8] @ rssm.gates.weight[k] + rssm.gates.bias[k]
        reset, candidate, update = gates[:, :8], gates[:, 8:16], gates[:, 16:]
        update = torch.sigmoid(update - 1)
        own = h[:, 8 * k : 8 * k + 8]
        after.append(update * torch.tanh(torch.sigmoid(reset) * candidate) + (1 - update) * own)
    torch.testing.assert_close(rssm.recur(z, action), torch.cat(after, -1))


def test_the_posterior_reads_memory_and_observation_as_one_layer_would():
    rssm = small()
    h, embedded = torch.randn(5, 16), torch.randn(5, 16)
    weight = torch.cat((rssm.posterior_mix.weight, rssm.of_observation.weight), -1)
    torch.nn.init.normal_(rssm.posterior_mix.bias)
    x = rssm.posterior_head(F.linear(torch.cat((h, embedded), -1), weight, rssm.posterior_mix.bias))
    torch.testing.assert_close(
        rssm.posterior(h, rssm.of_observation(embedded)), rssm._log_probabilities(x), atol=1e-5, rtol=1e-5
    )


def test_divergence_is_that_of_categorical_distributions_with_a_uniform_share():
    rssm = small(unimix=0.1)
    p, q = rssm.prior(torch.randn(6, 16)), rssm.posterior(torch.randn(6, 16), torch.randn(6, 16))
    assert p.shape == q.shape == (6, 3, 4)
    torch.testing.assert_close(p.exp().sum(-1), torch.ones(6, 3))
    far = rssm._log_probabilities(1000.0 * torch.eye(4)[[0, 1, 2]].flatten())
    torch.testing.assert_close(far.exp().amin(), torch.tensor(0.1 / 4))
    categorical = torch.distributions.Categorical
    expected = torch.distributions.kl_divergence(categorical(logits=p), categorical(logits=q)).sum(-1)
    torch.testing.assert_close(divergence(p, q).squeeze(-1), expected)


def test_codes_are_one_hot_drawn_with_their_probabilities_and_pass_gradients_straight_through():
    rssm = small()
    logits = torch.randn(3, 4, requires_grad=True)
    probabilities = logits.log_softmax(-1)
    h = torch.zeros(20_000, 16)
    s = rssm.state(h, probabilities.expand(20_000, 3, 4), sample=True)[:, 16:].unflatten(-1, (3, 4))
    drawn = s.detach().round()
    assert torch.equal(drawn.sum(-1), torch.ones(20_000, 3)) and torch.equal(drawn.amax(-1), drawn.sum(-1))
    torch.testing.assert_close(drawn.mean(0), probabilities.exp().detach(), atol=0.02, rtol=0)
    (gradient,) = torch.autograd.grad(s.mean(0)[0, 0], logits)
    (expected,) = torch.autograd.grad(logits.softmax(-1)[0, 0], logits)
    torch.testing.assert_close(gradient, expected)
    mode = rssm.state(h[:1], probabilities[None], sample=False)[0, 16:].view(3, 4).detach()
    assert torch.equal(mode.argmax(-1), logits.argmax(-1))


def test_leading_dimensions_are_free():
    rssm = small()
    z, action, embedded = torch.randn(2, 3, rssm.size), torch.rand(2, 3, 2), torch.randn(2, 3, 16)

    def flat(x):
        return x.flatten(0, 1)

    h = rssm.recur(z, action)
    torch.testing.assert_close(flat(h), rssm.recur(flat(z), flat(action)))
    torch.testing.assert_close(flat(rssm.begin(embedded)), rssm.begin(flat(embedded)))
    p, q = rssm.prior(h), rssm.posterior(h, embedded)
    torch.testing.assert_close(flat(q), rssm.posterior(flat(h), flat(embedded)))
    assert divergence(p, q).shape == (2, 3, 1)
    state = rssm.state(h, q, sample=False)
    torch.testing.assert_close(flat(state), rssm.state(flat(h), flat(q), sample=False))


def test_an_episode_begins_with_a_step_from_nothing():
    rssm, like = small(), torch.zeros(3, 1)
    with torch.no_grad():
        for parameter in rssm.parameters():
            parameter.normal_(std=0.5)
    h = rssm.begin(like)
    nothing, action = torch.zeros(3, rssm.size), torch.zeros(3, rssm.action_dim)
    assert torch.equal(h, rssm.recur(nothing, action)) and h.all()


def test_first_weights_keep_the_size_of_what_passes_through():
    rssm = RSSM(
        embed_dim=256, action_dim=2, deter_dim=512, hidden_dim=64, codes=4, classes=8, blocks=4, unimix=0.01
    )
    for weight, inputs, scale in (
        (rssm.mix.weight, 128 + 3 * 64, 1.0),  # each block its own part of h, and all inputs
        (rssm.mix_inputs.weight, 128 + 3 * 64, 1.0),
        (rssm.posterior_mix.weight, 512 + 256, 1.0),
        (rssm.of_observation.weight, 512 + 256, 1.0),
        (BlockLinear(512, 256, 4).weight, 128, 1.0),
        (layer(256, 256)[0].weight, 256, 1.0),
        (network(256, (128, 64, 32), 512)[-1].weight, 32, 1.0),
        (network(256, (64,), 512, scale=0.01)[-1].weight, 64, 0.01),
    ):
        std = scale / inputs**0.5
        torch.testing.assert_close(weight.std().item(), std, rtol=0.05, atol=0)
        assert 1.8 * std < weight.amax() < 2.0 / 0.8796 * std and weight.amin() > -2.0 / 0.8796 * std
    assert not network(8, (4,), 4, scale=0.0)[-1].weight.any()


def test_normalisation_of_low_precision_is_in_that_of_its_weights():
    """Torch has one kernel for inputs and weights of one type; for others it warns, and rounds on the way."""
    x = torch.randn(5, 8, dtype=torch.bfloat16)
    norm = RMSNorm(8)
    assert norm(x).dtype == torch.float32
    assert torch.equal(norm(x), norm(x.float()))
    assert isinstance(layer(3, 4)[1], RMSNorm) and isinstance(small().mix_norm, RMSNorm)
