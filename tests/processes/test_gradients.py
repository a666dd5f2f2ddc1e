"""Gradients are averaged over processes while the backward pass goes on."""

import json
from functools import partial

import pytest

from averaging import averaged
from forks import ranks_in_forks


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> list[dict]:
    """What each of two processes has seen."""
    folder = tmp_path_factory.mktemp("averaging")
    done = ranks_in_forks([partial(averaged, folder)] * 2, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((folder / "found.json").read_text())


def test_gradients_are_the_mean_of_all_processes(found) -> None:
    assert [[one["same"] for one in rank["passes"]] for rank in found] == [[True] * 4] * 2


def test_messages_leave_during_the_backward_pass(found) -> None:
    # Three messages of five layers. The first pass shows which layers learn; the third waits for one that does not.
    assert [[one["started"] for one in rank["passes"]] for rank in found] == [[0, 3, 1, 2]] * 2


def test_a_layer_that_does_not_learn_keeps_no_gradient(found) -> None:
    assert [[one["idle"] for one in rank["passes"]] for rank in found] == [[0, 0, 1, 0]] * 2


def test_other_backward_passes_send_nothing(found) -> None:
    assert [(rank["outside"], rank["alone"]) for rank in found] == [(0, True)] * 2
