"""Windows of recorded episodes, sampled for training as if from a replay buffer."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm import processes
from franka_wm.data.future import FUTURE, future_frames
from franka_wm.data.image_storage import CHANNELS
from franka_wm.data.lerobot.cache import Cache
from franka_wm.data.lerobot.mapping import FeatureMap
from franka_wm.data.moments import moments
from franka_wm.errors import UserError
from franka_wm.options import is_real, whole_rule
from franka_wm.seeding import derive_seed, restore_generator

SPLITS = ("train", "validation", "all")

STILL = 1e-5
"""A component of the actions whose range is at most this part of the largest one's never changes: it is noise."""


class NoWindows(UserError):
    """A split has no window of the length asked for."""


@dataclass(eq=False)
class Recording:
    """One or several datasets as the arrays that windows are cut from; shared by the splits.

    Attributes:
        caches: One for each dataset.
        mapping: The same for all.
        arrays: Name → tensors (R_k, …), one for each part; a single part where everything is in memory.
        in_memory: Whether it is.
        device: Where windows are given out.
        episodes: (E, 4) int64 of all datasets: dataset, first row, rows, whether o_T is known. First rows count
            through all datasets.
        action_low, action_high: (A,) of the recorded actions, where they are scaled to [−1, 1]; else ``None``.
        notes: What a user should know.
    """

    caches: list[Cache]
    mapping: FeatureMap
    arrays: dict[str, list[Tensor]]
    in_memory: bool
    device: torch.device
    episodes: np.ndarray
    action_low: np.ndarray | None
    action_high: np.ndarray | None
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.action_low is None or self.action_high is None:
            return
        for k in np.flatnonzero(still(self.action_low, self.action_high)):
            low, high = self.action_low[k], self.action_high[k]
            self.notes.append(f"actions: component {k} never changes and becomes 0 ({low:.4g} … {high:.4g})")


class Moments(NamedTuple):
    """Moments of a vector's components, (size,) float32 each."""

    mean: Tensor
    std: Tensor
    min: Tensor
    max: Tensor


class RecordedWindows:
    """Windows of H transitions within one episode, uniform over all that there are.

    A batch is a TensorDict (B, H), or (B, burn_in + H): observations, ``action`` and ``is_init`` at its root; the
    observations that followed and, where the dataset has them, ``reward`` (float32), ``done``, ``terminated``,
    ``truncated``, ``success`` (bool), each (B, H, 1), under ``next``. Images are uint8 (B, H, h, w, 3), vectors
    float32, actions float32 (B, H, A) in [−1, 1] or int64 (B, H) where they are discrete.

    So a window has H + 1 observations. Where the observation after an episode's last action is known (datasets
    of this package), the last action is in some window; elsewhere it is left out.

    **Actions** of a dataset of this package are in [−1, 1] already. Others are scaled linearly, each component
    from its smallest and largest value in the dataset to [−1, 1] (a component that never changes, see
    :data:`STILL`, becomes 0); ``action_low`` and ``action_high`` record it, :meth:`recorded_action` undoes it.

    Made by :func:`~franka_wm.data.lerobot.opening.open_dataset`.

    Args:
        recording: The arrays.
        window: Transitions per window, H.
        batch_size: Windows per sample, B.
        split: ``"train"``, ``"validation"`` or ``"all"``.
        validation_fraction: Share of each dataset's episodes, in [0, 1); at least one if it is above 0.
        seed: Draws the validation episodes and the windows.
        frame_stack: Images in each observation under ``pixels`` and ``pixels_…``: the present one and those before
            it in its episode, oldest first along the channels, the first one repeated (as ``env.frame_stack``).
        future: Each window also has a frame that its episode reached later, see :mod:`franka_wm.data.future`.
        burn_in: So many steps of its episode are in front of each window, for a memory to begin with: batches are
            (B, burn_in + H). The episode's first step stands for those before it, each time as a first one.

    Attributes:
        observation_sizes: Vector key → size.
        image_sizes: Image key → (h, w, 3), or (h, w, 3 · ``frame_stack``).
        action_dim: A; 0 where actions are discrete.
        num_actions: Largest discrete action + 1; 0 where actions are continuous.
        episode_length: Transitions of the longest episode.
        fps: Frames per second.
        episodes: (dataset, index in it) of every episode of this split.
        notes: Lines about what was decided or is missing.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        window: int,
        batch_size: int,
        split: str = "train",
        validation_fraction: float = 0.1,
        seed: int = 0,
        frame_stack: int = 1,
        future: bool = False,
        burn_in: int = 0,
    ):
        for name, value in (("window", window), ("batch_size", batch_size), ("frame_stack", frame_stack)):
            whole_rule(least=1).check(name, value)
        whole_rule(least=0).check("burn_in", burn_in)
        if split not in SPLITS:
            raise UserError(f"split={split!r}: must be one of {', '.join(SPLITS)}")
        if not is_real(validation_fraction) or not 0 <= validation_fraction < 1:
            raise UserError(
                f"dataset.validation_fraction={validation_fraction!r}: must be at least 0 and below 1"
            )
        self.recording, self.seed, self.future = recording, seed, future
        self.window, self.batch_size, self.burn_in = window, batch_size, burn_in
        self.validation_fraction = validation_fraction
        self.device = recording.device
        mapping = recording.mapping
        self.observation_sizes = {key: size for key, (_, size) in mapping.vectors.items()}
        self.frame_stack = frame_stack
        self._stacked = [key for key in mapping.images if frame_stack > 1 and key.startswith("pixels")]
        self.image_sizes = {
            key: (*shape[:2], CHANNELS * frame_stack) if key in self._stacked else shape
            for key, (_, shape) in mapping.images.items()
        }
        self.action_dim = mapping.action[1]
        self.fps = recording.caches[0].fps
        self.notes = list(recording.notes)
        chosen = _split(recording.episodes[:, 0], split, validation_fraction, seed)
        if not len(chosen):
            raise NoWindows(
                f"no episode is left for {split}: {len(recording.episodes)} in all, "
                f"dataset.validation_fraction={validation_fraction}; record more episodes, or change it"
            )
        self._episodes = recording.episodes[chosen]
        dataset, start, length, known = self._episodes.T
        first = np.searchsorted(recording.episodes[:, 0], dataset)
        self.episodes = list(zip(dataset.tolist(), (chosen - first).tolist(), strict=True))
        self._all_lengths = recording.episodes[:, 2] + recording.episodes[:, 3] - 1
        self.episode_length = int(self._all_lengths.max())
        self._starts = start
        transitions = length + known - 1
        windows = np.maximum(transitions - window + 1, 0)
        self._count = int(windows.sum())
        if not self._count:
            raise NoWindows(
                f"no window of {window} transitions fits: the longest episode of {split} has {transitions.max()}; "
                "shorten the window, or record longer episodes"
            )
        self.transitions = int(transitions.sum())
        # Drawing and gathering happen where the arrays are.
        self._home = self.device if recording.in_memory else torch.device("cpu")
        useful = windows > 0
        self._ends = torch.from_numpy(np.cumsum(windows[useful])).to(self._home)
        shift = start[useful] - (np.cumsum(windows[useful]) - windows[useful])
        self._shift = torch.from_numpy(shift).to(self._home)
        self._first_rows = torch.from_numpy(start[useful]).to(self._home)
        self._last_rows = torch.from_numpy((start + transitions)[useful]).to(self._home)
        self._steps = torch.arange(-burn_in, window + 1, device=self._home)
        self._generator = torch.Generator(device=self._home).manual_seed(derive_seed("windows", seed, split))
        self._bounds = torch.tensor([0, *np.cumsum([c.arrays["action"].shape[0] for c in recording.caches])])
        if mapping.discrete:
            self.num_actions = int(max(int(a.max()) for a in recording.arrays["action"])) + 1
        else:
            self.num_actions = 0
        self._scale: tuple[Tensor, Tensor] | None = None
        if recording.action_low is not None and recording.action_high is not None:
            centre, half = _centre_and_half(recording.action_low, recording.action_high)
            self._scale = torch.from_numpy(centre).to(self.device), torch.from_numpy(half).to(self.device)

    def __len__(self) -> int:
        """Number of different windows."""
        return self._count

    @property
    def action_low(self) -> np.ndarray | None:
        """(A,) recorded value that became −1; ``None`` if actions are as recorded."""
        return self.recording.action_low

    @property
    def action_high(self) -> np.ndarray | None:
        """(A,) recorded value that became 1; ``None`` if actions are as recorded."""
        return self.recording.action_high

    def sample(self, batch_size: int | None = None) -> TensorDict:
        """A batch of uniformly drawn windows, [B, burn_in + H]; no wait for the device where the data lies on it.

        Several processes draw one batch together, by the same numbers, and each takes its part.
        """
        count = self.batch_size if batch_size is None else batch_size
        whole = (processes.count() * count,)
        draw = torch.randint(self._count, whole, device=self._home, generator=self._generator)
        mine, later = draw.chunk(processes.count())[processes.rank()], None
        if self.future:
            uniform = torch.rand(whole, device=self._home, generator=self._generator)
            later = uniform.chunk(processes.count())[processes.rank()]
        return self.windows(mine, later)

    def get_state(self) -> Tensor:
        """Where the generator of :meth:`sample` stands, on the CPU."""
        return self._generator.get_state()

    def set_state(self, state: Tensor) -> bool:
        """The next samples are those after :meth:`get_state`; ``False`` if that was on another kind of device."""
        return restore_generator(self._generator, state)

    def windows(self, indices: Tensor, later: Tensor | None = None) -> TensorDict:
        """The windows of these numbers.

        Args:
            indices: (B,) int64, from 0 to ``len(self)`` − 1: episode by episode, by first step.
            later: (B,) in [0, 1): how far from the windows' end to their episode's the frames under ``future`` are, of
                windows that have any; ``None``: half the way.

        Returns:
            [B, burn_in + H], on :attr:`device`.
        """
        indices = indices.to(self._home)
        episode = torch.searchsorted(self._ends, indices, right=True)
        first = indices + self._shift[episode]
        rows = torch.maximum(first.unsqueeze(1) + self._steps, self._first_rows[episode].unsqueeze(1))
        batch, h = indices.shape[0], self.burn_in + self.window
        before, after = {}, {}
        for key in (*self.observation_sizes, *self.image_sizes):
            values = self._frames(key, rows, episode)
            before[key], after[key] = values[:, :h], values[:, 1:]
        action = self._gather("action", rows[:, :h])
        if self._scale is not None:
            centre, half = self._scale
            action = torch.where(half > 0, (action - centre) / half.clamp_min(1e-30), 0.0).clamp(-1.0, 1.0)
        is_init = (rows[:, :h] == self._first_rows[episode].unsqueeze(1)).unsqueeze(-1)
        for name in self.recording.arrays:
            if name.startswith("next."):
                after[name.removeprefix("next.")] = self._gather(name, rows[:, :h])
        root: dict[str, Any] = {
            **before,
            "action": action,
            "is_init": is_init.to(self.device, non_blocking=True),
            "next": TensorDict(after, batch_size=[batch, h], device=self.device),
        }
        if self.future:
            end, left = rows[:, -1], self._last_rows[episode] - rows[:, -1]
            part = 0.5 if later is None else later.to(self._home)
            ahead = ((left + 1) * part).long()
            frames = {key: self._frames(key, (end + ahead).unsqueeze(1), episode) for key in before}
            root[FUTURE] = future_frames(frames, ahead.to(self.device, non_blocking=True), h)
        return TensorDict(root, batch_size=[batch, h], device=self.device)

    def batches(self, batch_size: int | None = None) -> Iterator[TensorDict]:
        """Every window once, in order; the last batch may be smaller."""
        count = self.batch_size if batch_size is None else batch_size
        for first in range(0, self._count, count):
            yield self.windows(torch.arange(first, min(first + count, self._count)))

    def split(self, name: str) -> RecordedWindows:
        """Another split (``"train"``, ``"validation"`` or ``"all"``) of the same data, without a copy."""
        return RecordedWindows(
            self.recording,
            window=self.window,
            batch_size=self.batch_size,
            split=name,
            validation_fraction=self.validation_fraction,
            seed=self.seed,
            frame_stack=self.frame_stack,
            future=self.future,
            burn_in=self.burn_in,
        )

    def validation(self) -> RecordedWindows | None:
        """The validation split of the same data; ``None`` where it has no window."""
        try:
            return self.split("validation")
        except NoWindows:
            return None

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """The least and the largest reward in all of the data; ``None`` where there are none, or not all are finite.

        The row behind an episode of this package holds 0, which counts: it widens no range of values, since that goes
        as far to both sides as the bound that is farther from 0.
        """
        rewards = self.recording.arrays.get("next.reward")
        if rewards is None:
            return None
        least, largest = min(float(r.min()) for r in rewards), max(float(r.max()) for r in rewards)
        return (least, largest) if math.isfinite(least) and math.isfinite(largest) else None

    @property
    def terminates(self) -> bool:
        """Whether any episode of the data terminated."""
        return any(bool(ends.any()) for ends in self.recording.arrays.get("next.terminated", ()))

    def statistics(self) -> dict[str, Moments]:
        """Mean, deviation, least and largest of each vector observation and of ``action``, over this split.

        Computed from the data, in float64, and put on :attr:`device`. Actions are as they are given out.
        """
        out = {}
        mask, action_mask = self._in_split()
        for key in self.observation_sizes:
            out[key] = _moments(self._whole(f"observation.{key}")[mask], self.device)
        if not self.num_actions:
            action = self._whole("action")[action_mask].astype(np.float64)
            if self.action_low is not None and self.action_high is not None:
                centre, half = _centre_and_half(self.action_low, self.action_high)
                action = np.where(half > 0, (action - centre) / np.maximum(half, 1e-30), 0.0)
            out["action"] = _moments(action, self.device)
        return out

    def image_moments(self, keys: Sequence[str], most: int = 2000) -> dict[str, tuple[Tensor, Tensor]]:
        """Mean and deviation (h, w, 3) of images as numbers in [0, 1], over at most so many frames of this split."""
        rows = np.flatnonzero(self._in_split()[0])
        chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]
        index = torch.from_numpy(chosen).to(self._home).unsqueeze(0)
        return {key: moments(self._gather(f"observation.{key}", index)[0]) for key in keys}

    def _in_split(self) -> tuple[np.ndarray, np.ndarray]:
        """Which rows are observations of this split, and which of them have an action."""
        mask = np.zeros(int(self._bounds[-1]), bool)
        action_mask = mask.copy()
        _, start, length, known = self._episodes.T
        for s, n, k in zip(start, length, known, strict=True):
            mask[s : s + n + k] = True
            action_mask[s : s + n] = True
        return mask, action_mask

    def recorded_action(self, action: Tensor) -> Tensor:
        """Actions (…, A) as given out → in the dataset's own units."""
        if self._scale is None:
            return action
        centre, half = (t.to(action.device) for t in self._scale)
        return action * half + centre

    def _whole(self, name: str) -> np.ndarray:
        return np.concatenate([part.cpu().numpy() for part in self.recording.arrays[name]])

    def _frames(self, key: str, rows: Tensor, episode: Tensor) -> Tensor:
        """Observations (B, T, …) at rows (B, T) of these episodes (B,)."""
        if key in self._stacked:
            return self._stacks(f"observation.{key}", rows, self._first_rows[episode])
        return self._gather(f"observation.{key}", rows)

    def _stacks(self, name: str, rows: Tensor, first: Tensor) -> Tensor:
        """(B, T) rows of episodes that begin at ``first`` (B,) → (B, T, h, w, 3 · frame_stack)."""
        earlier = rows[:, :1] + torch.arange(1 - self.frame_stack, 0, device=rows.device)
        earlier = torch.maximum(earlier, first.unsqueeze(1))  # the first one stands for those before it
        images, steps = self._gather(name, torch.cat((earlier, rows), 1)), rows.shape[1]
        return torch.cat([images[:, k : k + steps] for k in range(self.frame_stack)], -1)

    def _gather(self, name: str, rows: Tensor) -> Tensor:
        """(B, T) rows → (B, T, …) on the device."""
        parts = self.recording.arrays[name]
        flat = rows.reshape(-1).contiguous()
        if len(parts) == 1:
            values = parts[0].index_select(0, flat)
        else:
            values = torch.empty((flat.shape[0], *parts[0].shape[1:]), dtype=parts[0].dtype)
            dataset = torch.bucketize(flat, self._bounds[1:], right=True)
            for k, part in enumerate(parts):
                where = (dataset == k).nonzero().squeeze(1)
                values[where] = part.index_select(0, flat[where] - self._bounds[k])
        values = values.unflatten(0, rows.shape)
        if values.device != self.device:
            values = values.pin_memory().to(self.device, non_blocking=True)
        return values


def _split(dataset: np.ndarray, split: str, fraction: float, seed: int) -> np.ndarray:
    """Numbers of the episodes of a split: a fraction of each dataset, drawn by seed alone."""
    if split == "all":
        return np.arange(len(dataset))
    validation = np.zeros(len(dataset), bool)
    for k in np.unique(dataset):
        mine = np.flatnonzero(dataset == k)
        count = min(max(1, round(fraction * len(mine))), len(mine) - 1) if fraction > 0 else 0
        validation[np.random.default_rng(derive_seed("validation", seed)).permutation(mine)[:count]] = True
    return np.flatnonzero(validation if split == "validation" else ~validation)


def still(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which components never change, (A,) bool: see :data:`STILL`."""
    span = high.astype(np.float64) - low
    return span <= STILL * span.max(initial=0.0)


def _centre_and_half(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low64, high64 = low.astype(np.float64), high.astype(np.float64)
    half = np.where(still(low, high), 0.0, (high64 - low64) / 2)
    return ((high64 + low64) / 2).astype(np.float32), half.astype(np.float32)


def _moments(values: np.ndarray, device: torch.device) -> Moments:
    wide = values.astype(np.float64)
    out = (wide.mean(0), wide.std(0), wide.min(0), wide.max(0))
    return Moments(*(torch.from_numpy(v.astype(np.float32)).to(device) for v in out))
