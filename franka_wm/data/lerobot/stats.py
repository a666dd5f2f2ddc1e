"""Statistics of one episode, as LeRobot keeps them, from arrays in memory.

The same numbers as LeRobot's ``compute_episode_stats``: minimum, maximum, mean, standard deviation and quantiles of
every dimension. Its quantiles come from histograms of 5,000 bins, filled dimension by dimension; here they are the
exact order statistics, for all dimensions at once, which is where most of the time of writing went.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def vector_stats(array: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of (T,) or (T, D): each (1,) or (D,)."""
    values = array.reshape(len(array), -1)
    values = values.astype(np.result_type(values.dtype, np.float32), copy=False)
    ordered = np.sort(values, axis=0)
    # The smallest value that at least a share q of all values does not exceed.
    ranks = {name: max(0, int(np.ceil(q * len(values) - 1e-9)) - 1) for name, q in QUANTILES.items()}
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
    } | {name: ordered[rank] for name, rank in ranks.items()}


def image_stats(images: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of (T, H, W, 3) uint8: each (3, 1, 1), in [0, 1]. Frames are sampled as LeRobot samples them."""
    from PIL import Image

    count = max(min(len(images), 100), min(int(len(images) ** 0.75), 10_000))
    chosen = images[np.round(np.linspace(0, len(images) - 1, count)).astype(int)]
    histogram = Image.fromarray(chosen.reshape(-1, chosen.shape[2], 3)).histogram()
    counts = np.array(histogram, np.float64).reshape(3, 256)
    total = counts.sum(1)
    values = np.arange(256) / 255.0
    cumulative = counts.cumsum(1)
    mean = counts @ values / total
    stats = {
        "min": values[(counts > 0).argmax(1)],
        "max": values[255 - (counts[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, counts @ values**2 / total - mean**2)),
    }
    for name, q in QUANTILES.items():
        stats[name] = values[(cumulative >= q * total[:, None] - 1e-6).argmax(1)]
    out = {name: value.reshape(3, 1, 1) for name, value in stats.items()}
    return out | {"count": np.array([count])}


def episode_stats(columns: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """For each column (T, …); uint8 of four dimensions are images."""
    return {
        name: image_stats(array) if array.dtype == np.uint8 and array.ndim == 4 else vector_stats(array)
        for name, array in columns.items()
    }


def aggregate(stats: Sequence[Mapping[str, Mapping[str, np.ndarray]]]) -> dict[str, dict[str, np.ndarray]]:
    """Statistics of several episodes or datasets, from those of each: as LeRobot's ``aggregate_stats``.

    Mean and deviation are those of all values together; quantiles are means of quantiles, weighted by count.
    """
    out = {}
    for name in stats[0]:
        each = {stat: np.stack([np.asarray(one[name][stat]) for one in stats]) for stat in stats[0][name]}
        count = each["count"].reshape(len(stats), *[1] * (each["mean"].ndim - 1))
        total = count.sum(0)
        mean = (each["mean"] * count).sum(0) / total
        variance = ((each["std"] ** 2 + (each["mean"] - mean) ** 2) * count).sum(0) / total
        out[name] = {
            "min": each["min"].min(0),
            "max": each["max"].max(0),
            "mean": mean,
            "std": np.sqrt(variance),
            "count": each["count"].sum(0),
        } | {q: (each[q] * count).sum(0) / total for q in QUANTILES}
    return out
