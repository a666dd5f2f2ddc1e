"""Building blocks of TD-MPC2-like models (Hansen, Su & Wang, ICLR 2024, arXiv:2310.16828).

Everything here is device-side tensor code with static shapes and no host synchronisation, so that a whole
update can be compiled or captured as a CUDA graph. Leading dimensions are free everywhere.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm import processes
from franka_wm.models import fused
from franka_wm.seeding import normal_like

WEIGHT_STD = 0.02  # truncated-normal initialisation of every linear weight, as published


def symlog(x: Tensor) -> Tensor:
    """sign(x) · log(1 + |x|): compresses large magnitudes and is the identity near zero."""
    return torch.sign(x) * torch.log1p(x.abs())


def symexp(x: Tensor) -> Tensor:
    """Inverse of `symlog`."""
    return torch.sign(x) * torch.expm1(x.abs())


def initialize(module: nn.Module) -> None:
    """Truncated normal (std 0.02) weights and zero biases for every `nn.Linear` inside `module`."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.trunc_normal_(layer.weight, std=WEIGHT_STD)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


MANY_ROWS = 4096
"""From so many rows on, copies of inputs cost less than the slow product without them."""


def _missing(size: int, like: Tensor) -> int:
    """How many numbers a row of `size` lacks to be a multiple of 16 bytes, on CUDA and where it pays.

    Tensor cores read rows in such pieces. A latent of 512 with an action of 7 makes rows of 519, whose products fall
    back to kernels several times slower; zeros at the end change no result. A compiled program writes them on the way;
    otherwise they cost a copy.
    """
    pays = torch.compiler.is_compiling() or like.shape[:-1].numel() >= MANY_ROWS
    return -size % 8 if like.is_cuda and pays else 0


def _one_row_of_a_compiled_plan(input: Tensor, weight: Tensor) -> bool:
    """Whether `input` is one row on a CPU, in a program compiled (or exported) without gradients, in one precision."""
    return (
        torch.compiler.is_compiling()
        and not torch.is_grad_enabled()
        and input.device.type == "cpu"
        and input.dtype == weight.dtype
        and not torch.is_autocast_enabled("cpu")
        and input.shape[-1:] == weight.shape[1:]
        and input.shape[:-1].numel() == 1
    )


class Linear(nn.Linear):
    """`nn.Linear`, whose product is padded with zeros on CUDA where its sizes do not suit tensor cores.

    In plans on CUDA it calls `fused.linear`. In compiled plans on a CPU one row is multiplied as a sum, which the
    compiler joins with what follows; called as a product, it takes longer.
    """

    def forward(self, input: Tensor) -> Tensor:
        if fused.applies() and fused.suits(self.weight):
            return fused.linear(input, self.weight, self.bias)
        if _one_row_of_a_compiled_plan(input, self.weight):
            product = (
                (self.weight * input.reshape(1, -1)).sum(-1).reshape(*input.shape[:-1], self.out_features)
            )
            return product if self.bias is None else product + self.bias
        more, beyond = _missing(self.in_features, input), _missing(self.out_features, input)
        if not (more or beyond):
            return super().forward(input)
        weight = F.pad(self.weight, (0, more, 0, beyond))
        bias = None if self.bias is None else F.pad(self.bias, (0, beyond))
        return F.linear(F.pad(input, (0, more)), weight, bias)[..., : self.out_features]


class RMSNorm(nn.RMSNorm):
    """In the precision of its weights under autocast, too: torch's one kernel takes no other."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


class SimNorm(nn.Module):
    """Simplicial normalisation: softmax within consecutive groups of `group_size` features.

    (..., D) -> (..., D), each group non-negative and summing to one. It bounds the latent space, which keeps
    a consistency loss without decoder from collapsing or exploding (TD-MPC2, section 3.1).

    Raises:
        ValueError: `group_size` is not positive.
    """

    def __init__(self, group_size: int = 8) -> None:
        super().__init__()
        if group_size < 1:
            raise ValueError(f"group_size must be at least 1, got {group_size}")
        self.group_size = group_size

    def forward(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (-1, self.group_size)).softmax(-1).flatten(-2)

    def extra_repr(self) -> str:
        return f"group_size={self.group_size}"


def _as_made(module: nn.Module, kind: type[nn.Module]) -> bool:
    """Whether a module is of this very kind, and nobody listens to its calls."""
    return type(module) is kind and not (module._forward_hooks or module._forward_pre_hooks)


class NormedLinear(nn.Module):
    """Linear, LayerNorm, activation (Mish when None): (..., in_features) -> (..., out_features)."""

    def __init__(self, in_features: int, out_features: int, *, activation: nn.Module | None = None) -> None:
        super().__init__()
        self.linear = Linear(in_features, out_features)
        self.norm = nn.LayerNorm(out_features)
        self.activation = nn.Mish() if activation is None else activation

    def forward(self, x: Tensor) -> Tensor:
        if fused.applies() and (group := self._fuses) is not None:
            own = (self.linear.weight, self.linear.bias, self.norm.weight, self.norm.bias)
            return fused.normed_linear(x, *own, group_size=group, eps=self.norm.eps)
        return self.activation(self.norm(self.linear(x)))

    @property
    def _fuses(self) -> int | None:
        """What `fused.normed_linear` is told: the size of the groups, 0 for Mish; None: these layers are not its."""
        own = (
            _as_made(self.linear, Linear)
            and _as_made(self.norm, nn.LayerNorm)
            and fused.suits(self.linear.weight)
        )
        if not own:
            return None
        if isinstance(self.activation, SimNorm) and _as_made(self.activation, SimNorm):
            group = self.activation.group_size
            return group if group & (group - 1) == 0 else None
        return 0 if _as_made(self.activation, nn.Mish) else None


def mlp(
    in_features: int,
    hidden: Sequence[int],
    out_features: int,
    *,
    output: nn.Module | None = None,
) -> nn.Sequential:
    """`NormedLinear` hidden layers and an output layer: (..., in_features) -> (..., out_features).

    Args:
        hidden: width of each hidden layer.
        output: activation of the output layer, which is then normalised, too (`SimNorm`); None: a linear layer.
    """
    layers: list[nn.Module] = [NormedLinear(a, b) for a, b in pairwise((in_features, *hidden))]
    last = hidden[-1] if hidden else in_features
    layers.append(
        Linear(last, out_features) if output is None else NormedLinear(last, out_features, activation=output)
    )
    network = nn.Sequential(*layers)
    initialize(network)
    return network


def unit_gain(network: nn.Sequential) -> nn.Sequential:
    """Give the output layer weights of unit gain: where no normalisation follows, std 0.02 starts with no signal."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    nn.init.xavier_uniform_(last.weight)
    return network


def zero_head(in_features: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """An `mlp` whose output layer has zero weights: it first predicts exactly 0."""
    head = mlp(in_features, hidden, outputs)
    last = head[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    return head


class TwoHotSymlog(nn.Module):
    """Scalars as a categorical distribution over `bins` equidistant points of symlog space.

    A value between two points puts its mass on these two, in proportion (two-hot; Hafner et al.,
    arXiv:2301.04104). Cross-entropy on it makes gradients independent of the scale of rewards.
    Values outside symexp([low, high]) are clamped; for [-10, 10] that is about ±22025.

    Raises:
        ValueError: fewer than two bins, or an empty range.
    """

    support: Tensor

    def __init__(self, bins: int = 101, low: float = -10.0, high: float = 10.0) -> None:
        super().__init__()
        if bins < 2:
            raise ValueError(f"bins must be at least 2, got {bins}")
        if not low < high:
            raise ValueError(f"low must be below high, got [{low}, {high}]")
        self.bins, self.low, self.high = bins, float(low), float(high)
        self.register_buffer("support", torch.linspace(low, high, bins), persistent=False)

    def rebuild(self) -> dict[str, float]:
        """Constructor arguments of a model that make its code this one, wherever the range came from."""
        return {"value_low": self.low, "value_high": self.high}

    def encode(self, x: Tensor) -> Tensor:
        """Scalars (..., 1) -> probabilities (..., bins)."""
        position = (symlog(x).clamp(self.low, self.high) - self.low) * (
            (self.bins - 1) / (self.high - self.low)
        )
        # A triangle of width one bin is the two-hot code: no scatter, so it fuses and needs no index tensor.
        index = torch.arange(self.bins, device=x.device, dtype=position.dtype)
        return (1.0 - (position - index).abs()).clamp_min(0.0)

    def outside(self, *targets: Tensor) -> Tensor:
        """The share () of targets, of any shapes, beyond the range: `encode` clamps them."""
        beyond = [(symlog(x) < self.low) | (symlog(x) > self.high) for x in targets]
        return torch.cat([one.flatten() for one in beyond]).float().mean()

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) -> expected value (..., 1), the expectation taken in symlog space.

        In the support's precision, also under autocast: bfloat16's probabilities are too coarse for values of tens.
        """
        if fused.applies() and fused.suits(self.support):
            return fused.expectation(logits, self.support)
        probabilities = logits.softmax(-1, dtype=self.support.dtype)
        return symexp((probabilities * self.support).sum(-1, keepdim=True))

    def loss(self, logits: Tensor, target: Tensor) -> Tensor:
        """Soft cross-entropy: logits (..., bins), target scalars (..., 1), constants -> (..., 1), broadcasting."""
        probabilities = self.encode(target.detach())
        return -(probabilities * logits.log_softmax(-1)).sum(-1, keepdim=True)


class Ensemble(nn.Module):
    """Several MLPs of one shape, evaluated together as batched matrix products, with slow target copies.

    (..., in_features) -> (members, ..., out_features). Layers are as in `mlp` with a linear output; that last
    layer starts at zero, so that all members first predict the same.

    The target copies are buffers: no optimiser and no gradient reaches them; `update_target` moves them.

    Args:
        members: number of networks.
        hidden: width of each hidden layer.
        dropout: probability on the first layer, as published, applied only where `forward` is asked for it.

    Raises:
        ValueError: `members` is not positive.
    """

    def __init__(
        self,
        *,
        members: int,
        in_features: int,
        hidden: Sequence[int],
        out_features: int,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if members < 1:
            raise ValueError(f"members must be at least 1, got {members}")
        self.members, self.dropout, self.depth = members, dropout, len(hidden) + 1
        self.out_features = out_features
        self._names: list[str] = []
        for i, (a, b) in enumerate(pairwise((in_features, *hidden, out_features))):
            weight = torch.zeros(members, a, b)
            if i < len(hidden):
                nn.init.trunc_normal_(weight, std=WEIGHT_STD)
                self._add(f"norm_scale_{i}", torch.ones(members, 1, b))
                self._add(f"norm_shift_{i}", torch.zeros(members, 1, b))
            self._add(f"weight_{i}", weight)
            self._add(f"bias_{i}", torch.zeros(members, 1, b))

    def _add(self, name: str, value: Tensor) -> None:
        self._names.append(name)
        self.register_parameter(name, nn.Parameter(value))
        self.register_buffer(f"target_{name}", value.clone())

    def forward(
        self,
        x: Tensor,
        *,
        weights: Literal["live", "detached", "target"] = "live",
        members: Tensor | int | None = None,
        dropout: bool = False,
    ) -> Tensor:
        """Evaluate the ensemble.

        Args:
            x: (..., in_features), shared by all members.
            weights: `live` trains them; `detached` uses the same values but lets gradients pass only to `x`,
                so that a policy loss cannot move its critic; `target` uses the slow copies.
            members: indices (K,) on the device of `x`, or the first so many: these alone; None: all.
            dropout: whether to drop activations of the first layer.

        Returns:
            (members or K, ..., out_features).
        """

        def parameter(name: str) -> Tensor:
            value: Tensor = getattr(self, f"target_{name}" if weights == "target" else name)
            if weights != "live":
                value = value.detach()
            if members is None:
                return value
            return value[:members] if isinstance(members, int) else value.index_select(0, members)

        if isinstance(members, int) and not 1 <= members <= self.members:
            raise ValueError(f"members must be from 1 to {self.members}, got {members}")
        if fused.applies() and fused.suits(parameter("weight_0")) and not dropout:
            of = "target_" if weights == "target" else ""
            layers, norms = (
                [(getattr(self, f"{of}{one}_{i}"), getattr(self, f"{of}{two}_{i}")) for i in range(depth)]
                for one, two, depth in (
                    ("weight", "bias", self.depth),
                    ("norm_scale", "norm_shift", self.depth - 1),
                )
            )
            return fused.ensemble(x, layers, norms, members)
        if isinstance(x, fused.Joined):  # by weights or with dropout that the kernels do not know
            x = torch.cat(x, dim=-1)
        leading = x.shape[:-1]
        count = members if isinstance(members, int) else self.members if members is None else members.shape[0]
        h = x.reshape(-1, x.shape[-1]).expand(count, -1, -1)
        for i in range(self.depth):
            weight, bias = parameter(f"weight_{i}"), parameter(f"bias_{i}")
            width = weight.shape[2]
            more, beyond = _missing(weight.shape[1], h), _missing(width, h)
            if more or beyond:
                h, weight, bias = (
                    F.pad(h, (0, more)),
                    F.pad(weight, (0, beyond, 0, more)),
                    F.pad(bias, (0, beyond)),
                )
            h = torch.baddbmm(bias, h, weight)[..., :width]
            if i == self.depth - 1:
                break
            if i == 0 and dropout and self.dropout:
                h = F.dropout(h, self.dropout)
            h = F.layer_norm(h, h.shape[-1:])
            h = F.mish(torch.addcmul(parameter(f"norm_shift_{i}"), h, parameter(f"norm_scale_{i}")))
        return h.reshape(count, *leading, self.out_features)

    @torch.no_grad()
    def update_target(self, tau: float) -> None:
        """Move every target copy by the fraction `tau` towards its live value, on the device."""
        targets = [getattr(self, f"target_{name}") for name in self._names]
        live = [getattr(self, name).detach() for name in self._names]
        torch._foreach_lerp_(targets, live, tau)  # pyright: ignore[reportPrivateImportUsage]


def reads_apart(network: nn.Module) -> bool:
    """Whether a network can read features and actions apart, as `fused.Joined`: its first layer takes them so."""
    first = network[0] if _as_made(network, nn.Sequential) else network  # pyright: ignore[reportIndexIssue]
    if isinstance(first, NormedLinear) and _as_made(first, NormedLinear):
        return first._fuses is not None
    return _as_made(network, Ensemble)


class GaussianPolicy(nn.Module):
    """Diagonal Gaussian squashed by tanh: latents (..., latent_dim) -> actions (..., action_dim) in [-1, 1].

    The log standard deviation (before squashing) is bounded smoothly to [`log_std_min`, `log_std_max`].
    """

    def __init__(
        self,
        *,
        latent_dim: int,
        hidden: Sequence[int],
        action_dim: int,
        log_std_min: float = -10.0,
        log_std_max: float = 2.0,
    ) -> None:
        super().__init__()
        if not log_std_min < log_std_max:
            raise ValueError(f"log_std_min must be below log_std_max, got [{log_std_min}, {log_std_max}]")
        self.network = mlp(latent_dim, hidden, 2 * action_dim)
        self.log_std_min, self.log_std_max = log_std_min, log_std_max

    def distribution(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before squashing, each (..., action_dim)."""
        mean, raw = self.network(z).chunk(2, dim=-1)
        span = self.log_std_max - self.log_std_min
        return mean, self.log_std_min + 0.5 * span * (torch.tanh(raw) + 1.0)

    def forward(self, z: Tensor, *, deterministic: bool = False) -> Tensor:
        """Actions (..., action_dim): the squashed mean if `deterministic`, else a reparameterised sample."""
        mean, log_std = self.distribution(z)
        return torch.tanh(mean if deterministic else mean + log_std.exp() * normal_like(mean))

    def sample(self, z: Tensor, used: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """A reparameterised action (..., action_dim) and its log-density (..., 1), of the entries `used` alone.

        Averaged and negated, the second estimates the entropy [nat] of the actions.
        """
        mean, log_std = self.distribution(z)
        noise = torch.randn_like(mean)
        raw = mean + log_std.exp() * noise
        log_prob = -0.5 * (noise.square() + math.log(2.0 * math.pi)) - log_std
        # log(1 - tanh(u)^2), in the form that stays exact where tanh saturates
        log_slope = 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))
        density = log_prob - log_slope
        if used is not None:
            density = density * used
        return torch.tanh(raw), density.sum(-1, keepdim=True)

    def imitation_error(self, z: Tensor, action: Tensor, shown: Tensor) -> Tensor:
        """Mean squared error (,) of the mode against actions (..., A), 0 where not `shown` (..., 1) or (..., A)."""
        return ((self(z, deterministic=True) - action).square() * shown).mean()

    @staticmethod
    def all_shown(shown: Tensor) -> Tensor:
        """Whether (,) all steps are demonstrations, in the batches of all processes: they share them unequally."""
        return processes.mean(shown.all().float()) == 1
