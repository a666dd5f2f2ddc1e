"""Windows [B, H] of contiguous transitions, as `loss` takes them."""

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase


def check_windows(batch: TensorDictBase) -> tuple[int, int]:
    """B and H.

    Raises:
        ValueError: the batch size is not [B, H].
    """
    if len(batch.batch_size) != 2:
        raise ValueError(f"a batch of windows has batch size [B, H], got {list(batch.batch_size)}")
    return batch.batch_size[0], batch.batch_size[1]


def window_of(batch: TensorDictBase, keys: Iterable[str]) -> TensorDict:
    """Observations of windows [B, H], batch size [B, H+1]: those of the root, and the last of `next`."""
    after, (count, horizon) = batch.get("next"), batch.batch_size
    window = {key: torch.cat((batch.get(key), after.get(key)[:, -1:]), dim=1) for key in keys}
    return TensorDict(window, batch_size=[count, horizon + 1])


def with_future(window: TensorDict, batch: TensorDictBase) -> TensorDict:
    """Observations of windows, and behind them the frame that was reached later where the batch has one.

    Encoded with the window, it has the same batch statistics (and is part of them), or a head would tell it by these.

    Args:
        window: (B, H+1), from :func:`window_of`.
        batch: (B, H); ``future`` of it is that of `franka_wm.data.future`.

    Returns:
        (B, H+1), or (B, H+2).
    """
    if (future := batch.get("future", None)) is None:
        return window
    joined = {key: torch.cat((frames, future.get(key)[:, :1]), dim=1) for key, frames in window.items()}
    return TensorDict(joined, batch_size=[window.shape[0], window.shape[1] + 1])
