"""Masks of a JEPA: tokens that it sees and tokens that it predicts, fixed numbers of them, drawn on the device.

A sampler is made for a grid of tokens, (time slots, rows, columns), numbered in that order. Called with a
batch size it draws `Masks` for each entry. The numbers of tokens never vary, so that shapes are static: where
a paper draws a block's size, here it is fixed and only shape and place are drawn. A block is the k tokens
nearest to a random centre in a metric that has the block's aspect ratio, which is a rectangle up to rounding.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_FAR = 1e6

# As published in I-JEPA and V-JEPA.
ASPECT = (0.75, 1.5)
"""Range of height / width of blocks to predict."""
CONTEXT = 0.925
"""Part of the places that I-JEPA's context block is drawn around."""
TUBES = 4
"""Blocks whose union V-JEPA predicts."""


class Masks(NamedTuple):
    """Token indices: `context` (N, n) seen, `targets` (N, M, k) to predict, in M groups; never both."""

    context: Tensor
    targets: Tensor


class Sampler:
    """Draws `Masks` for tokens on a grid (time slots, rows, columns)."""

    def __init__(self, grid: tuple[int, int, int]) -> None:
        if len(grid) != 3 or min(grid) < 1:
            raise ValueError(f"a grid of tokens is (time slots, rows, columns), each at least 1, got {grid}")
        self.grid = grid
        self.slots, self.rows, self.columns = grid
        self.places = self.rows * self.columns
        self.tokens = self.slots * self.places

    def __call__(self, count: int, device: torch.device | str) -> Masks:
        """Masks of `count` entries."""
        raise NotImplementedError

    def _distances(
        self, count: int, blocks: int, area: float, aspect: tuple[float, float], device: torch.device | str
    ) -> Tensor:
        """How far each place is from each of some random blocks, (count, blocks, places); tiny noise breaks ties.

        The block of this area, inside the grid, is where the distance is below one half.
        """
        low, high = (math.log(a) for a in aspect)
        u = torch.rand(4, count, blocks, 1, device=device)
        ratio = torch.exp(low + (high - low) * u[0])
        height = (area * ratio).sqrt().clamp(max=self.rows)
        width = (area / height).clamp(max=self.columns)
        height = (area / width).clamp(max=self.rows)
        row = height / 2 + u[1] * (self.rows - height) - 0.5
        column = width / 2 + u[2] * (self.columns - width) - 0.5
        place = torch.arange(self.places, device=device)
        dy = (torch.div(place, self.columns, rounding_mode="floor") - row).abs() / height
        dx = (place % self.columns - column).abs() / width
        return torch.maximum(dy, dx) + 1e-4 * torch.rand(count, blocks, self.places, device=device)

    def _over_time(self, places: Tensor) -> Tensor:
        """The same places (N, n) in every time slot: (N, slots · n)."""
        start = torch.arange(self.slots, device=places.device) * self.places
        return (start.unsqueeze(-1) + places.unsqueeze(-2)).flatten(-2)


class MultiBlock(Sampler):
    """I-JEPA's masks (arXiv:2301.08243): predict `targets` blocks from one large block less these.

    In clips a block covers its places in every time slot.

    Args:
        grid: (time slots, rows, columns).
        targets: number of target blocks.
        target_scale: part of the places that each has.

    Raises:
        ValueError: blocks that leave no context.
    """

    def __init__(self, grid: tuple[int, int, int], *, targets: int = 4, target_scale: float = 0.175) -> None:
        super().__init__(grid)
        self.blocks = targets
        self.block = max(1, round(target_scale * self.places))
        # What is left if no two blocks overlap: as many can always be seen, whatever was drawn.
        self.seen = self.places - targets * self.block
        if targets < 1 or self.seen < 1:
            raise ValueError(
                f"{targets} target blocks of {self.block} of {self.places} places leave no context; take fewer "
                "or smaller ones, or smaller patches"
            )

    def __call__(self, count: int, device: torch.device | str) -> Masks:
        near = self._distances(count, self.blocks, self.block, ASPECT, device)
        targets = near.topk(self.block, dim=-1, largest=False).indices  # (N, M, k)
        context = self._distances(count, 1, CONTEXT * self.places, (1.0, 1.0), device).squeeze(1)
        hidden = torch.zeros_like(context).scatter_(1, targets.flatten(1), _FAR)
        # Inside the context block all places are equally good; those outside it come last.
        order = (context - 0.5).clamp_min(0.0) + torch.rand_like(context) * 1e-3 + hidden
        seen = order.topk(self.seen, dim=-1, largest=False).indices
        return Masks(self._over_time(seen), self._over_time(targets))


class Tube(Sampler):
    """V-JEPA's masks (arXiv:2404.08471): blocks of places hidden for the whole clip.

    The union of `TUBES` random blocks, grown or cut to exactly `ratio` of the places, is predicted from
    the rest.

    Raises:
        ValueError: a ratio that hides all places or none.
    """

    def __init__(self, grid: tuple[int, int, int], *, ratio: float = 0.75) -> None:
        super().__init__(grid)
        self.hidden = _part(ratio, self.places, "places")

    def __call__(self, count: int, device: torch.device | str) -> Masks:
        area = max(1.0, self.hidden / TUBES)
        near = self._distances(count, TUBES, area, ASPECT, device).amin(1)
        places = near.argsort(dim=-1)
        hidden, seen = places[:, : self.hidden], places[:, self.hidden :]
        return Masks(self._over_time(seen), self._over_time(hidden).unsqueeze(1))


class Temporal(Sampler):
    """Predict `ratio` of the time slots, drawn, from the others.

    Raises:
        ValueError: a single time slot, or a ratio that hides all or none.
    """

    def __init__(self, grid: tuple[int, int, int], *, ratio: float = 0.5) -> None:
        super().__init__(grid)
        if self.slots < 2:
            raise ValueError("temporal masks need clips of at least two time slots (tubelets)")
        self.hidden = _part(ratio, self.slots, "time slots")

    def __call__(self, count: int, device: torch.device | str) -> Masks:
        order = torch.rand(count, self.slots, device=device).argsort(-1)
        place = torch.arange(self.places, device=device)
        tokens = order.unsqueeze(-1) * self.places + place  # (N, slots, places)
        cut = self.slots - self.hidden
        return Masks(tokens[:, :cut].flatten(1), tokens[:, cut:].reshape(count, 1, -1))


class Random(Sampler):
    """Predict `ratio` of all tokens, drawn independently, from the others (MAE, arXiv:2111.06377).

    Raises:
        ValueError: a ratio that hides all tokens or none.
    """

    def __init__(self, grid: tuple[int, int, int], *, ratio: float = 0.75) -> None:
        super().__init__(grid)
        self.hidden = _part(ratio, self.tokens, "tokens")

    def __call__(self, count: int, device: torch.device | str) -> Masks:
        order = torch.rand(count, self.tokens, device=device).argsort(-1)
        return Masks(order[:, self.hidden :], order[:, : self.hidden].unsqueeze(1))


SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "multiblock": MultiBlock,
    "tube": Tube,
    "temporal": Temporal,
    "random": Random,
}


def make_masks(name: str, grid: tuple[int, int, int], **options: float) -> Sampler:
    """The sampler `name` for a grid (time slots, rows, columns); `options` go to its constructor.

    Raises:
        ValueError: no sampler has this name, or it cannot work on this grid.
    """
    if name not in SAMPLERS:
        raise ValueError(f"unknown masks {name!r}; available: {', '.join(SAMPLERS)}")
    return SAMPLERS[name](grid, **options)


def _part(ratio: float, count: int, what: str) -> int:
    hidden = round(ratio * count)
    if not 0 < hidden < count:
        raise ValueError(f"a ratio of {ratio} hides {hidden} of {count} {what}; some must stay, some must go")
    return hidden
