"""The cost model of `docs/scale.md`: how long GPUs wait for each other in an update, on one host and on many."""

from __future__ import annotations

import math
from dataclasses import dataclass

HOST = 8
"""GPUs of a host."""


@dataclass(frozen=True)
class Link:
    """What connects GPUs of a host, or hosts.

    Attributes:
        latency: of a message of next to no size [s]; between hosts for each doubling of their number.
        bandwidth: at which each GPU, or each host, sends [bytes/s].
    """

    latency: float
    bandwidth: float


NETWORKS = {"InfiniBand": Link(10e-6, HOST * 50e9), "Ethernet": Link(50e-6, 12.5e9)}
"""Between hosts: an adapter of 400 Gb/s for each GPU, and one of 100 Gb/s for the host. Assumed, not measured."""


def all_reduce(size: float, gpus: int, inside: Link, between: Link | None = None) -> float:
    """Seconds in which so many GPUs add up messages of so many bytes.

    First within each host, then between hosts: a ring sends each byte 2 (n − 1) / n times.

    Args:
        inside: Connects the GPUs of a host.
        between: Connects hosts of `HOST` GPUs; ``None``: all GPUs are of one host.
    """
    if gpus == 1:
        return 0.0
    local = gpus if between is None else min(gpus, HOST)
    took = inside.latency + 2 * (local - 1) / local * size / inside.bandwidth
    hosts, left = divmod(gpus, local)
    assert not left, f"{gpus} GPUs are no hosts of {HOST}"
    if between is not None and hosts > 1:
        took += 2 * math.log2(hosts) * between.latency
        took += 2 * (hosts - 1) / hosts * size / between.bandwidth
    return took


def link(gpus: int, size: float, large: float, small: float) -> Link:
    """What connects so many GPUs, from the seconds of a message of ``size`` bytes and of one of next to none."""
    return Link(small, 2 * (gpus - 1) / gpus * size / max(large - small, 1e-9))


def speed_up(gpus: int, update: float, waited: float) -> float:
    """How much more so many GPUs do than one, whose updates take so long, if each one waits so long [s]."""
    return gpus * update / (update + waited)
