"""The cost model of several GPUs, by hand."""

from __future__ import annotations

import pytest

from benchmarks.cost_model import HOST, NETWORKS, Link, all_reduce, link, speed_up

INSIDE = Link(latency=1e-3, bandwidth=1e9)
BETWEEN = Link(latency=1e-2, bandwidth=1e8)


def test_one_gpu_waits_for_nobody() -> None:
    assert all_reduce(1e6, 1, INSIDE, BETWEEN) == 0.0
    assert speed_up(1, 0.1, 0.0) == 1.0


def test_gpus_of_a_host_send_in_a_ring() -> None:
    assert all_reduce(1e6, 2, INSIDE) == pytest.approx(1e-3 + 1e-3)
    assert all_reduce(1e6, 4, INSIDE) == pytest.approx(1e-3 + 1.5e-3)
    assert all_reduce(1e6, HOST, INSIDE, BETWEEN) == all_reduce(1e6, HOST, INSIDE)


def test_hosts_add_what_their_gpus_have_added() -> None:
    host = all_reduce(1e6, HOST, INSIDE)
    assert all_reduce(1e6, 2 * HOST, INSIDE, BETWEEN) == pytest.approx(host + 2e-2 + 1e-2)
    assert all_reduce(1e6, 8 * HOST, INSIDE, BETWEEN) == pytest.approx(host + 6e-2 + 1.75e-2)


def test_a_link_is_what_two_messages_took() -> None:
    for gpus in (2, 4):
        large, small = (all_reduce(size, gpus, INSIDE) for size in (1e6, 0.0))
        found = link(gpus, 1e6, large, small)
        assert found.latency == pytest.approx(INSIDE.latency)
        assert found.bandwidth == pytest.approx(INSIDE.bandwidth)


def test_waiting_as_long_as_learning_halves_what_gpus_bring() -> None:
    assert speed_up(4, 0.1, 0.1) == 2.0


def test_networks_are_slower_the_plainer_they_are() -> None:
    fast, slow = (all_reduce(2e7, 64, INSIDE, NETWORKS[name]) for name in ("InfiniBand", "Ethernet"))
    assert all_reduce(2e7, HOST, INSIDE) < fast < slow
