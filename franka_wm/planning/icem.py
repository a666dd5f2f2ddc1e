"""iCEM: the cross-entropy method with coloured noise and memory (Pinneri et al., CoRL 2020, arXiv:2008.06389)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.options import FRACTION, Bounds
from franka_wm.planning.base import Query
from franka_wm.planning.cem import CEM
from franka_wm.planning.sampling import best, normal, refit, require_is_init, take


def coloured_noise(
    shape: tuple[int, ...],
    exponent: float,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Gaussian noise whose power spectrum falls as 1 / f^`exponent` along the last dimension.

    Drawn in the frequency domain (Timmer & König, 1995), all series at once. Every entry has mean 0 and
    variance 1; 0 is white noise, 2 a random walk's spectrum. Frequency 0, the series' own mean, has the
    power of the lowest other one.

    Args:
        shape: (E, ..., T), T the length of a series.
        dtype: float32 or float64.
    """
    length = shape[-1]
    k = torch.arange(length // 2 + 1, device=device)
    amplitude = (k.clamp(min=1).to(dtype or torch.get_default_dtype()) / length) ** (-0.5 * exponent)
    parts = normal((*shape[:-1], k.shape[0], 2), amplitude, generator)
    # The series is real: at frequency 0 and, for an even length, at the highest one, so is the spectrum, and
    # its single part has the power of two. All others also stand for their negative frequency.
    alone = (k == 0) | (2 * k == length)
    scale = torch.stack(
        (torch.where(alone, 2**0.5 * amplitude, amplitude), torch.where(alone, 0.0 * amplitude, amplitude)),
        dim=-1,
    )
    series = torch.fft.irfft(torch.view_as_complex(parts * scale), n=length)
    power = torch.where(alone, 2.0 * amplitude.square(), 4.0 * amplitude.square()).sum()
    return series * (length / power.sqrt())


@dataclass(kw_only=True, eq=False)
class ICEM(CEM):
    """iCEM: good plans from few candidates, for real-time control (Pinneri et al., arXiv:2008.06389).

    What it adds to `CEM`, with the published defaults:
      * noise that is correlated in time (`noise_beta`), so that candidates go somewhere instead of
        trembling on the spot;
      * a share of the elites joins the candidates of the next iteration, and, shifted by one step, those of
        the next decision;
      * the population shrinks by `decay` with every iteration, down to twice the number of elites;
      * the mean is a candidate of the last iteration, and the action is that of the best candidate, not of
        the mean.

    Elites are carried from one decision to the next inside the entry `plan`, which for this planner is
    (E, 1 + R, H, A): first the mean, then the R = int(`reuse` · `num_elites`) best elites, best first. On a
    cold start fresh candidates take their place, so shapes never change.

    Differences from the published implementation: the noise has variance 1 with its mean over the horizon
    included, so `std` means what it says for short horizons too; elites are scored again in the next
    iteration, which costs R rollouts and keeps the code free of special cases; `min_std` is new (0 is the
    published method). A score that is not finite counts for nothing.

    Args besides those of `CEM`:
        num_samples: candidates per environment of the first iteration, those of the policy included; the R
            reused elites come on top.
        num_policy_samples: how many of them are rolled out with `prior`, if `plan` gets one. They are
            candidates of the first iteration; the good ones stay as elites.
        noise_beta: exponent of the noise's spectrum, 0 (white) to about 4; at most 10.
        reuse: share of the elites that is kept.
        decay: factor by which the population shrinks, at least 1.
    """

    horizon: int = 30
    num_samples: int = 40
    num_elites: int = 10
    iterations: int = 3
    noise_beta: float = 3.0
    reuse: float = 0.3
    decay: float = 1.25
    momentum: float = 0.1
    std: float = 0.5

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **CEM.ranges,
        "noise_beta": Bounds(least=0, most=10),  # far beyond, no noise is left, or no number
        "reuse": FRACTION,
        "decay": Bounds(least=1),
    }

    @property
    def num_kept(self) -> int:
        """R: elites that are carried on."""
        return int(self.reuse * self.num_elites + 1e-9)  # 0.29 · 100 is a little less than 29

    def population(self) -> list[int]:
        """How many candidates are drawn in each iteration; the reused elites come on top."""
        least = min(self.num_samples, 2 * self.num_elites)
        return [max(least, int(self.num_samples * self.decay**-i)) for i in range(self.iterations)]

    def search(self, query: Query) -> TensorDict:
        """See `Planner.plan`; with `explore`, the noise has the final standard deviation.

        Args:
            query: `z` float32 or float64; `previous` the `plan` of the last call (E, 1 + R, H, A): mean and
                elites, both shifted by one step. The step that comes into sight repeats the mean's last
                action; elites draw theirs.

        Returns:
            TensorDict of batch size [E]: `action` (E, A), the first of the best plan (of the mean, if no
            score is finite); `plan` (E, 1 + R, H, A), the final mean and the elites to keep; `best`, the best
            plan, and `std`, both (E, H, A); `value` (E, 1), the score of the best plan.
        """
        previous, generator = query.previous, query.generator
        carried = (query.z.shape[0], 1 + self.num_kept, self.horizon, self.action_dim)
        if previous is not None and previous.shape != carried:
            raise ValueError(
                f"previous must have shape (E, 1 + R, H, A) = {carried}, got {tuple(previous.shape)}"
            )
        cold = None if previous is None else previous[:, 0]
        mean = self.start(query._replace(previous=cold), repeat_last=True).clamp(self.low, self.high)
        std = torch.full_like(mean, self.std)
        guided = 0 if query.prior is None else self.num_policy_samples

        kept, chosen, elites = mean[:, None][:, :0], mean[:, None], None
        for i, population in enumerate(self.population()):
            if i == 0:
                drawn = self._draw(mean, std, population - guided + self.num_kept, generator)
                pool = [self._shifted(previous, query.is_init, drawn), drawn[:, self.num_kept :]]
                pool += self.guided(query)
            else:
                pool = [kept, self._draw(mean, std, population, generator)]
            if i == self.iterations - 1:
                pool.append(mean.unsqueeze(1))
            actions = torch.cat(pool, dim=1)
            elites = best(query.score(actions), self.num_elites)
            chosen = take(actions, elites.which)
            kept = chosen[:, : self.num_kept]
            mean, std = refit(chosen, elites.valid, mean, std, momentum=self.momentum)
            # Rounding can carry a mean of actions at a bound just past it.
            mean, std = mean.clamp(self.low, self.high), std.clamp(min=self.min_std)

        assert elites is not None  # iterations >= 1
        winner = torch.where(elites.valid[:, :1, None], chosen[:, 0], mean)
        plan, value = torch.cat((mean.unsqueeze(1), kept), dim=1), elites.scores[:, :1]
        return self.result(query, winner[:, 0], std[:, 0], plan=plan, best=winner, std=std, value=value)

    def _draw(self, mean: Tensor, std: Tensor, samples: int, generator: torch.Generator | None) -> Tensor:
        """Candidates (E, samples, H, A) around the mean, each action component a series of its own."""
        noise = coloured_noise(
            (mean.shape[0], samples, self.action_dim, self.horizon),
            self.noise_beta,
            device=mean.device,
            dtype=mean.dtype,
            generator=generator,
        ).transpose(-1, -2)
        return (mean.unsqueeze(1) + std.unsqueeze(1) * noise).clamp(self.low, self.high)

    def _shifted(self, previous: Tensor | None, is_init: Tensor | None, drawn: Tensor) -> Tensor:
        """The last decision's elites one step on (E, R, H, A); fresh candidates where there are none."""
        fresh = drawn[:, : self.num_kept]
        if previous is None:
            return fresh
        elites = previous[:, 1:].to(drawn.dtype).clamp(self.low, self.high)
        shifted = torch.cat((elites[:, :, 1:], fresh[:, :, -1:]), dim=2)
        if is_init is None:
            return shifted
        require_is_init(is_init, drawn.shape[0])
        return torch.where(is_init[..., None, None], fresh, shifted)
