"""A short history as one flat latent: the last frames' embeddings, the actions between them, who is real.

Families whose prediction needs more than the present frame keep their history inside z, so that planners
see a plain `next(z, action)`. Layout of z, oldest first, for a history of K frames of F numbers:

    frames (K · F) | actions between them ((K - 1) · A) | validity (K), 1 where the frame is real

At the start of an episode only the newest frame is real; the others are zeros.
"""

import torch
from torch import Tensor


class Memory:
    """Packs and unpacks z; holds no tensors. Leading dimensions are free.

    Args:
        history: K, at least 1.
        frame_dim: F.
        action_dim: A.

    Raises:
        ValueError: a size below 1.
    """

    def __init__(self, *, history: int, frame_dim: int, action_dim: int) -> None:
        for name, value in (("history", history), ("frame_dim", frame_dim), ("action_dim", action_dim)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.history, self.frame_dim, self.action_dim = history, frame_dim, action_dim
        self.sizes = (history * frame_dim, (history - 1) * action_dim, history)
        self.size = sum(self.sizes)

    def start(self, frame: Tensor) -> Tensor:
        """The z (..., size) of an episode's first frame (..., F)."""
        leading = frame.shape[:-1]
        before = frame.new_zeros(*leading, self.sizes[0] - self.frame_dim)
        between = frame.new_zeros(*leading, self.sizes[1] + self.history - 1)
        return torch.cat((before, frame, between, frame.new_ones(*leading, 1)), dim=-1)

    def push(self, z: Tensor, action: Tensor, frame: Tensor) -> Tensor:
        """The z after `action` (..., A) led to `frame` (..., F); the oldest frame is dropped."""
        frames, actions, valid = z.split(self.sizes, dim=-1)
        if self.history > 1:
            actions = torch.cat((actions[..., self.action_dim :], action.to(z.dtype)), dim=-1)
        new = torch.ones_like(valid[..., :1])
        return torch.cat(
            (frames[..., self.frame_dim :], frame.to(z.dtype), actions, valid[..., 1:], new), dim=-1
        )

    def last(self, z: Tensor) -> Tensor:
        """The newest frame (..., F) of z."""
        return z[..., self.sizes[0] - self.frame_dim : self.sizes[0]]

    def split(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames (..., K, F), actions (..., K - 1, A) and validity (..., K) of z."""
        frames, actions, valid = z.split(self.sizes, dim=-1)
        return (
            frames.unflatten(-1, (self.history, self.frame_dim)),
            actions.reshape(*actions.shape[:-1], self.history - 1, self.action_dim),
            valid,
        )

    def gather(self, frames: Tensor, actions: Tensor) -> Tensor:
        """The z at every step of a window.

        Args:
            frames: (B, T, F), of one episode, contiguous.
            actions: (B, T - 1, A) between them, or more of them, the rest unused.

        Returns:
            (B, T, size); the first has a history of one frame, the second of two, and so on up to K.
        """
        steps = [self.start(frames[:, 0])]
        for t in range(1, frames.shape[1]):
            steps.append(self.push(steps[-1], actions[:, t - 1], frames[:, t]))
        return torch.stack(steps, dim=1)

    def windows(self, x: Tensor) -> Tensor:
        """Cut (B, T, ...) into all runs of K steps, (B · (T - K + 1), K, ...); as it is where T <= K."""
        if x.shape[1] <= self.history:
            return x
        return x.unfold(1, self.history, 1).movedim(-1, 2).flatten(0, 1)
