"""Two processes divide the episodes of an evaluation: rows, table and curves are those of one."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from divided_evaluation import CASES, evaluated, together
from forks import ranks_in_forks
from franka_wm import processes

TOLD = ("policies", "protocol", "point")
pytestmark = [pytest.mark.slow]


@pytest.fixture(scope="module")
def divided(tmp_path_factory) -> tuple[Path, list[dict[str, Any]]]:
    """Folder, and what each of two processes has found."""
    folder = tmp_path_factory.mktemp("divided")
    done = ranks_in_forks([partial(together, folder)] * 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, [torch.load(folder / f"found{rank}.pt", weights_only=False) for rank in range(2)]


@pytest.mark.parametrize("name", CASES)
def test_the_table_is_that_of_one_process(divided, name, tmp_path) -> None:
    folder, found = divided
    alone = evaluated(name, tmp_path)
    assert {key: found[0][name][key] for key in TOLD} == {key: found[1][name][key] for key in TOLD}
    assert found[0][name]["protocol"] == alone["protocol"]
    for policy, rows in alone["rows"].items():
        # Products, and functions such as tanh, of other batch sizes are rounded otherwise; that nothing moves is exact.
        exact = policy == "noop"
        near: dict[str, Any] = {"rtol": 0, "atol": 0} if exact else {"rtol": 1e-3, "atol": 1e-5}
        torch.testing.assert_close(found[0][name]["rows"][policy], rows, equal_nan=True, **near)
        if exact:
            assert found[0][name]["policies"][policy] == alone["policies"][policy]
    assert found[0][name]["point"] == pytest.approx(alone["point"], rel=1e-3, abs=1e-5)
    written = json.loads((folder / name / "evaluation.json").read_text())
    assert written["policies"] == json.loads(json.dumps(found[0][name]["policies"]))


@pytest.mark.parametrize(("name", "shares"), [("reach", ([3, 2], [2, 1])), ("multitask", ([6, 1], [3, 0]))])
def test_each_process_plays_its_share(divided, name, shares) -> None:
    _, found = divided
    policies = len(found[0][name]["policies"])
    for rank in range(2):
        expected = [share[rank] for share in shares for _ in range(policies) if share[rank]]
        assert found[rank][name]["played"] == expected


@pytest.mark.parametrize(("whole", "block"), [(0, 1), (1, 1), (7, 1), (64, 1), (7, 3), (2, 3), (64, 5)])
def test_shares_are_all_of_it_and_nearly_equal(monkeypatch, whole, block) -> None:
    for size in (1, 2, 3, 8):
        monkeypatch.setattr(processes, "count", lambda size=size: size)
        shares = []
        for rank in range(size):
            monkeypatch.setattr(processes, "rank", lambda rank=rank: rank)
            shares.append(processes.own_part(whole, block))
        assert [k for first, count in shares for k in range(first, first + count)] == list(range(whole))
        assert all(first % block == 0 for first, count in shares if count)
        blocks = [-(-count // block) for _, count in shares]
        assert max(blocks) - min(blocks) <= 1
