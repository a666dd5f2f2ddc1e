"""Keys of captured decisions: equal only where the same graph does."""

import math
from functools import partial

import numpy as np
import torch
from tensordict import TensorDict

from franka_wm.planning.objectives import ActionPenalty, Sum
from franka_wm.policies.graph_key import graph_key


def numbers(value):
    return TensorDict({"x": torch.full((3,), float(value))}, batch_size=[3])


class Other:
    def __init__(self, **values):
        self.__dict__ |= values


class Slotted:
    __slots__ = ("weight",)

    def __init__(self, weight):
        self.weight = weight


class Module(torch.nn.Module):
    def __init__(self, weight):
        super().__init__()
        self.weight = weight


def test_settings_tell_what_a_graph_depends_on():
    tensor, module, square = torch.ones(2), torch.nn.Linear(1, 1), torch.rand(2, 2)
    values = {
        "a": 1,
        "b": [math.nan, "x"],
        "c": tensor,
        "d": module,
        "e": {"f": Other(g=module.forward)},
        "h": partial(max, 1, key=len),
        "i": square,
        "j": torch.tensor(1.0),  # a number that would become part of the graph
        "k": Slotted(1.0),
        "m": numbers(1.0),
    }
    same = graph_key(Other(**values))
    assert graph_key(Other(**values)) == same and hash(graph_key(Other(**values))) == hash(same)
    for change in (
        {"a": 2},
        {"b": [math.nan, "y"]},
        {"c": tensor.clone()},
        {"d": torch.nn.Linear(1, 1)},
        {"e": {"f": Other(g=module.extra_repr)}},
        {"h": partial(max, 2, key=len)},
        {"h": partial(max, 1, key=repr)},
        {"i": square.T},
        {"j": torch.tensor(2.0)},
        {"k": Slotted(2.0)},
        {"m": numbers(1.0)},
        {"n": 0},
    ):
        assert graph_key(Other(**values | change)) != same, change
    tensor += 1  # read anew by every replay
    assert graph_key(Other(**values)) == same
    ring = Other()
    ring.ring = ring
    hash(graph_key(ring))
    hash(graph_key(Other(x=torch.eye(2).to_sparse())))
    objective = Module(1.0)
    before = graph_key(objective)
    objective.weight = 2.0
    assert graph_key(objective) != before


def test_what_has_no_settings_keeps_its_address():
    """Arrays made one after the other lie where the one before lay, unless a key keeps that alive."""
    keys = [graph_key(Other(goal=np.full(3, float(n)))) for n in range(5)]
    assert len(set(keys)) == 5


def test_a_sum_of_sums_is_looked_into():
    """A weight that changes in it is another graph: terms of one's own stand beside those that a run has made."""
    innermost = ActionPenalty(1.0)
    score = Sum([(1.0, Sum([(1.0, innermost)]))])
    before = graph_key(score)
    innermost.weight = 5.0
    assert graph_key(score) != before
