"""Regularisers that keep embeddings from collapsing without a decoder, and measures of collapse.

All of it is computed in float32, on the device, with static shapes.
"""

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from franka_wm import processes

COLLAPSE = ("ema", "sigreg", "vicreg", "none")
"""Names of the guards against collapse that a family may offer."""

CollapseName = Literal["ema", "sigreg", "vicreg", "none"]


class SIGReg(nn.Module):
    """Sketched isotropic Gaussian regularisation (LeJEPA: Balestriero & LeCun 2025, arXiv:2511.08544).

    Embeddings are projected on random unit directions, drawn afresh at each call; along each, the
    Epps-Pulley statistic compares the empirical characteristic function with that of N(0, 1):

        n ∫ |mean exp(i t x) - exp(-t² / 2)|² exp(-t² / 2) dt,

    by the trapezoid rule on `knots` points of [0, `limit`], doubled for the negative half. By Cramér and Wold
    it is at its least for all directions only if the embeddings are N(0, I). Under several processes the
    means of sine and cosine are averaged over all of them, and the directions are those of the first.

    Args:
        directions: number of random directions.
        knots: points of the integral.
        limit: its end.

    Raises:
        ValueError: fewer than one direction or two knots, or an empty interval.
    """

    knot: Tensor
    weight: Tensor
    gaussian: Tensor

    def __init__(self, *, directions: int = 1024, knots: int = 17, limit: float = 3.0) -> None:
        super().__init__()
        if directions < 1 or knots < 2 or not limit > 0.0:
            raise ValueError(
                f"need directions >= 1, knots >= 2 and limit > 0, got {directions}, {knots} and {limit}"
            )
        self.directions = directions
        t = torch.linspace(0.0, limit, knots)
        gaussian = torch.exp(-0.5 * t.square())
        step = torch.full((knots,), 2.0 * limit / (knots - 1))
        step[0] *= 0.5
        step[-1] *= 0.5
        self.register_buffer("knot", t, persistent=False)
        self.register_buffer("gaussian", gaussian, persistent=False)
        self.register_buffer("weight", step * gaussian, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Embeddings (..., n, D) -> the statistic of each set of n, averaged over directions and sets: ()."""
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            directions = torch.randn(x.shape[-1], self.directions, device=x.device)
            directions = processes.broadcast(directions)
            angle = (x @ F.normalize(directions, dim=0)).unsqueeze(-1) * self.knot  # (..., n, M, knots)
            cos, sin = processes.means(angle.cos().mean(-3), angle.sin().mean(-3))
            error = (cos - self.gaussian).square() + sin.square()
            return (error @ self.weight).mean() * (x.shape[-2] * processes.count())


def variance_loss(x: Tensor) -> Tensor:
    """VICReg's hinge at 1 on the standard deviation of each feature over n samples (..., n, D) -> ()."""
    centred, samples = _centred(x.float())
    std = (processes.mean(centred.square().sum(-2)) / samples + 1e-4).sqrt()
    return F.relu(1.0 - std).mean()


def _centred(x: Tensor) -> tuple[Tensor, float]:
    """Samples (..., n, D) minus their mean over all processes, and what to divide the mean of sums by: n - 1 alone."""
    return x - processes.mean(x.mean(dim=-2, keepdim=True)), x.shape[-2] - 1 / processes.count()


def covariance_loss(x: Tensor) -> Tensor:
    """VICReg's squared covariances off the diagonal, summed and divided by D: (..., n, D) -> ()."""
    x, samples = _centred(x.float())
    with torch.autocast(x.device.type, enabled=False):  # in bfloat16 the difference below is rounding
        covariance = processes.mean(x.mT @ x) / samples
    off = covariance.square().sum((-2, -1)) - covariance.diagonal(dim1=-2, dim2=-1).square().sum(-1)
    return (off / x.shape[-1]).mean()


def info_nce(queries: Tensor, keys: Tensor) -> Tensor:
    """InfoNCE of matching rows (n, D) against all others, both ways, on cosines -> () (arXiv:1807.03748)."""
    with torch.autocast(queries.device.type, enabled=False):
        queries, keys = (processes.gather(F.normalize(x.float(), dim=-1)) for x in (queries, keys))
        logits = queries @ keys.mT / 0.1  # the temperature
        own = torch.arange(logits.shape[0], device=logits.device)
        return 0.5 * (F.cross_entropy(logits, own) + F.cross_entropy(logits.mT, own))


class CollapseGuard(nn.Module):
    """The loss that keeps embeddings from collapsing to a point: SIGReg or VICReg.

    For `ema` and `none` it is zero: `ema` guards through its slow teacher instead, `none` not at all.

    Args:
        kind: one of `COLLAPSE`.
        coef: weight of the guard; None: 0.05 for sigreg (LeJEPA's); for vicreg 1, which with a prediction
            loss of weight 1 gives the published ratio 25 : 25 : 1.
        directions: random directions of SIGReg.

    Raises:
        ValueError: an unknown `kind`, or a negative `coef`.
    """

    def __init__(self, kind: str, *, coef: float | None = None, directions: int = 1024) -> None:
        super().__init__()
        if kind not in COLLAPSE:
            raise ValueError(f"unknown collapse guard {kind!r}; available: {', '.join(COLLAPSE)}")
        if coef is not None and coef < 0.0:
            raise ValueError(f"the coefficient of the collapse guard must not be negative, got {coef}")
        self.kind, self.acts = kind, kind in ("sigreg", "vicreg")
        self.coef = {"sigreg": 0.05, "vicreg": 1.0}.get(kind, 0.0) if coef is None else coef
        self.sigreg = SIGReg(directions=directions) if kind == "sigreg" else None

    def forward(self, x: Tensor) -> Tensor:
        """Embeddings (..., n, D), n samples of each of any number of sets -> (), weighted by `coef`."""
        if not self.acts:
            return torch.zeros((), device=x.device)
        if self.sigreg is not None:
            return self.coef * self.sigreg(x)
        return self.coef * (variance_loss(x) + covariance_loss(x) / 25.0)


class ProjectionMLP(nn.Module):
    """Linear, BatchNorm, GELU, Linear: (..., inputs) -> (..., outputs).

    Which statistics the BatchNorm uses is asked for at each call instead of read from the module's mode, so
    that planning never depends on what else is in the batch, whatever the mode.

    Args:
        hidden: width of the hidden layer; 4 × `outputs` when None.
    """

    def __init__(self, inputs: int, outputs: int, *, hidden: int | None = None) -> None:
        super().__init__()
        hidden = 4 * outputs if hidden is None else hidden
        self.up, self.norm = nn.Linear(inputs, hidden), BatchNorm(hidden)
        self.down = nn.Linear(hidden, outputs)
        for layer in (self.up, self.down):  # of unit gain: embeddings start spread, not near a point
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, *, batch_statistics: bool) -> Tensor:
        h = F.gelu(self.norm(self.up(x), batch_statistics=batch_statistics))
        return self.down(h)


class BatchNorm(nn.Module):
    """Batch normalisation of the last dimension, whose statistics are chosen at each call.

    Over all leading dimensions; with `batch_statistics` those of the batch, which also move the running ones
    by `MOMENTUM`; otherwise the running ones.

    `MOMENTUM` is five times the usual one: what is normalised drifts with every update, and running
    statistics that lag ten updates behind can be far from those of the present weights (seen in training:
    errors a hundredfold of those with the batch's own). Batches hold hundreds of frames, enough for these.
    """

    MOMENTUM, EPS = 0.5, 1e-5

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(features)), nn.Parameter(torch.zeros(features))
        self.register_buffer("running_mean", torch.zeros(features))
        self.register_buffer("running_var", torch.ones(features))

    def forward(self, x: Tensor, *, batch_statistics: bool) -> Tensor:
        flat = x.reshape(-1, x.shape[-1])
        if batch_statistics and processes.count() > 1:
            return self._of_all(flat).reshape(x.shape)
        y = F.batch_norm(
            flat,
            self.running_mean,
            self.running_var,
            self.weight,
            self.bias,
            training=batch_statistics,
            momentum=self.MOMENTUM,
            eps=self.EPS,
        )
        return y.reshape(x.shape)

    def _of_all(self, flat: Tensor) -> Tensor:
        """The same over the batches (n, D) of all processes."""
        wide = flat.float()
        near = (
            self.running_mean.clone()
        )  # all processes' own: squares of what is far from zero would lose digits
        off = wide.mean(0) - near
        mean, square = processes.means(off, wide.var(0, correction=0) + off.square())
        var = (square - mean.square()).clamp_min(0.0)
        mean = mean + near
        with torch.no_grad():
            samples = len(flat) * processes.count()
            self.running_mean.lerp_(mean, self.MOMENTUM)
            self.running_var.lerp_(var * (samples / (samples - 1)), self.MOMENTUM)
        y = (wide - mean) * (var + self.EPS).rsqrt() * self.weight + self.bias
        return y.to(flat.dtype)


# -- measuring collapse -----------------------------------------------------------------------------------


def feature_std(x: Tensor) -> Tensor:
    """Mean over features of their standard deviation over samples: (..., D) -> (). Zero: collapsed."""
    return x.detach().float().reshape(-1, x.shape[-1]).std(0, correction=0).mean()


def participation_ratio(x: Tensor) -> Tensor:
    """How many directions the samples (..., D) spread over: tr(C)² / tr(C²) of their covariance -> ().

    From 1 (a line) to D (a ball); 0 where all samples agree. It needs no decomposition, which would wait for the
    host, so that losses can report it.
    """
    x = x.detach().float().reshape(-1, x.shape[-1])
    x = x - x.mean(0)
    with torch.autocast(x.device.type, enabled=False):
        covariance = x.mT @ x / x.shape[0]
    return covariance.trace().square() / covariance.square().sum().clamp_min(1e-30)
