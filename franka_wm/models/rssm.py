"""Recurrent state-space model with discrete codes (Hafner et al., Nature 2025, arXiv:2301.04104).

Everything here is device-side tensor code with static shapes, so that a whole update can be captured as a CUDA graph.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm.models.layers import Linear, RMSNorm


class RSSM(nn.Module):
    """States z = (h, s) that a recurrent network carries from step to step.

    h (`deter_dim`) is what the past determines: h' = GRU(h, s, a), with a recurrent matrix of `blocks` blocks on its
    diagonal. s are `codes` one-hot codes of `classes` each: the posterior reads them from h and what was observed, the
    prior guesses them from h alone. z has `size` features, h first.

    Distributions over codes are log-probabilities (..., codes, classes). A share `unimix` of each is uniform, so that
    no class is ever impossible and divergences stay finite.

    Args:
        embed_dim: size of an observation's features.
        action_dim: size of an action.
        deter_dim: size of h; a multiple of `blocks`.
        hidden_dim: width of hidden layers.
        codes, classes: of s.
        blocks: of the recurrent matrix.
        unimix: share of the uniform distribution.
    """

    def __init__(
        self,
        *,
        embed_dim: int,
        action_dim: int,
        deter_dim: int,
        hidden_dim: int,
        codes: int,
        classes: int,
        blocks: int,
        unimix: float,
    ) -> None:
        super().__init__()
        self.deter_dim, self.action_dim, self.blocks = deter_dim, action_dim, blocks
        self.codes, self.classes = codes, classes
        self.unimix = unimix
        self.sizes = (deter_dim, codes * classes)
        self.size = sum(self.sizes)
        self.of_deter = layer(deter_dim, hidden_dim)
        self.of_codes = layer(codes * classes, hidden_dim)
        self.of_action = layer(action_dim, hidden_dim)
        # A layer of several inputs is a sum of one for each: blocks share theirs, an observation's needs no h.
        self.mix = BlockLinear(deter_dim, deter_dim, blocks)
        self.mix_inputs = Linear(3 * hidden_dim, deter_dim, bias=False)
        self.mix_norm = RMSNorm(deter_dim, eps=EPS)
        self.gates = BlockLinear(deter_dim, 3 * deter_dim, blocks)
        self.prior_head = network(deter_dim, (hidden_dim, hidden_dim), codes * classes)
        self.posterior_mix = Linear(deter_dim, hidden_dim)
        self.of_observation = Linear(embed_dim, hidden_dim, bias=False)
        self.posterior_head = nn.Sequential(
            RMSNorm(hidden_dim, eps=EPS), nn.SiLU(), *network(hidden_dim, (), codes * classes)
        )
        for one, other, inputs in (
            (self.mix, self.mix_inputs, deter_dim // blocks + 3 * hidden_dim),
            (self.posterior_mix, self.of_observation, deter_dim + embed_dim),
        ):
            spread(one.weight, inputs)
            spread(other.weight, inputs)
        nn.init.zeros_(self.posterior_mix.bias)

    def begin(self, like: Tensor) -> Tensor:
        """h (..., deter_dim) of an episode's first observation, for inputs `like` (..., anything)."""
        nothing = like.new_zeros(*like.shape[:-1], self.size)
        return self.recur(nothing, like.new_zeros(*like.shape[:-1], self.action_dim))

    def recur(self, z: Tensor, action: Tensor) -> Tensor:
        """The next h (..., deter_dim) after actions (..., A) in [-1, 1] in z (..., size)."""
        h, s = z.split(self.sizes, dim=-1)
        inputs = torch.cat((self.of_deter(h), self.of_codes(s), self.of_action(action)), dim=-1)
        x = F.silu(self.mix_norm(self.mix(h) + self.mix_inputs(inputs)))
        reset, candidate, update = (
            gate.flatten(-2) for gate in self.gates(x).unflatten(-1, (self.blocks, -1)).chunk(3, dim=-1)
        )
        update = torch.sigmoid(update - 1.0)  # at first it keeps most of what was
        return update * torch.tanh(torch.sigmoid(reset) * candidate) + (1.0 - update) * h

    def prior(self, h: Tensor) -> Tensor:
        """Log-probabilities (..., codes, classes) of s from h (..., deter_dim)."""
        return self._log_probabilities(self.prior_head(h))

    def posterior(self, h: Tensor, observed: Tensor) -> Tensor:
        """Log-probabilities (..., codes, classes) of s from h and `of_observation` (..., hidden_dim) of features."""
        return self._log_probabilities(self.posterior_head(self.posterior_mix(h) + observed))

    def state(self, h: Tensor, log_probabilities: Tensor, *, sample: bool) -> Tensor:
        """z (..., size) of h and codes: drawn, or the likeliest. Gradients pass straight through to probabilities."""
        scores = log_probabilities.detach()
        if sample:
            # The largest of log-probabilities + Gumbel noise is a draw.
            noise = torch.empty_like(scores).exponential_().clamp_min(torch.finfo(scores.dtype).tiny)
            scores = scores - noise.log()
        hot = torch.zeros_like(scores).scatter_(-1, scores.argmax(-1, keepdim=True), 1.0)
        probabilities = log_probabilities.exp()
        s = hot + probabilities - probabilities.detach()
        return torch.cat((h, s.flatten(-2).to(h.dtype)), dim=-1)

    def next(self, z: Tensor, action: Tensor, *, sample: bool) -> Tensor:
        """z' (..., size) that the prior expects after actions (..., A)."""
        h = self.recur(z, action)
        return self.state(h, self.prior(h), sample=sample)

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        """z' (..., size), drawn: a step of imagination."""
        return self.next(z, action, sample=True)

    def _log_probabilities(self, logits: Tensor) -> Tensor:
        probabilities = logits.float().unflatten(-1, (self.codes, self.classes)).softmax(-1)
        return ((1.0 - self.unimix) * probabilities + self.unimix / self.classes).log()


def divergence(p: Tensor, q: Tensor) -> Tensor:
    """KL(p ‖ q) [nat] (..., 1), summed over codes, of log-probabilities (..., codes, classes)."""
    return (p.exp() * (p - q)).sum((-2, -1)).unsqueeze(-1)


EPS = 1e-4
"""Epsilon of the normalisations, as published."""


class BlockLinear(nn.Module):
    """Linear layer whose matrix has `blocks` blocks on its diagonal: (..., in_features) -> (..., out_features)."""

    def __init__(self, in_features: int, out_features: int, blocks: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(blocks, in_features // blocks, out_features // blocks))
        self.bias = nn.Parameter(torch.zeros(blocks, 1, out_features // blocks))
        spread(self.weight, in_features // blocks)

    def forward(self, x: Tensor) -> Tensor:
        leading, blocks = x.shape[:-1], self.weight.shape[0]
        grouped = x.reshape(-1, blocks, self.weight.shape[1]).transpose(0, 1)
        if torch.compiler.is_compiling():  # what follows adds the bias, which baddbmm copies first
            product = torch.bmm(grouped, self.weight)
            product = product + self.bias.to(product.dtype)
        else:
            product = torch.baddbmm(self.bias, grouped, self.weight)
        return product.transpose(0, 1).reshape(*leading, -1)


def layer(in_features: int, out_features: int) -> nn.Sequential:
    """Linear, RMSNorm, SiLU."""
    linear = Linear(in_features, out_features)
    spread(linear.weight, in_features)
    nn.init.zeros_(linear.bias)
    return nn.Sequential(linear, RMSNorm(out_features, eps=EPS), nn.SiLU())


def network(
    in_features: int, hidden: Sequence[int], out_features: int, *, scale: float = 1.0
) -> nn.Sequential:
    """A `layer` for each hidden width and a linear output whose first weights are multiplied by `scale`."""
    widths = (in_features, *hidden)
    last = Linear(widths[-1], out_features)
    spread(last.weight, widths[-1], scale)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*(layer(a, b) for a, b in pairwise(widths)), last)


def spread(weight: Tensor, inputs: int, scale: float = 1.0) -> None:
    """Truncated normal weights of variance `scale`² / `inputs`, as published; zeros where `scale` is 0."""
    if scale == 0.0:
        nn.init.zeros_(weight)
    else:
        std = scale / math.sqrt(inputs) / 0.8796  # the deviation that is left when ±2 are cut off
        nn.init.trunc_normal_(weight, std=std, a=-2.0 * std, b=2.0 * std)
