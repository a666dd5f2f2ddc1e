"""What decides on the operations of a captured decision: with other settings it needs another graph."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import partial
from types import FunctionType, MethodType

import torch
from tensordict import TensorDictBase
from torch import nn

LOOKED_INTO = 6
"""How deep :func:`graph_key` looks for attributes of attributes."""


class _Same:
    """Equal to itself alone, and keeps what it is of alive, so that nothing else can take its address."""

    __slots__ = ("it",)

    def __init__(self, it: object) -> None:
        self.it = it

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.it is self.it

    def __hash__(self) -> int:
        return id(self.it)


def graph_key(value: object, depth: int = LOOKED_INTO) -> Hashable:
    """What a graph of work with `value` depends on, for a `key`: another key, another graph.

    Numbers and texts count by value, tensors by the memory they lie in, plain objects and modules by identity or the
    settings of their attributes, everything else (functions, arrays, what lies deeper than `depth`) by identity. So
    work with an object that counts its calls in an attribute is another work each time, and never captured.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)  # a nan equals itself
    if isinstance(value, torch.Tensor):
        return _memory(value)
    if isinstance(value, MethodType):
        return graph_key(value.__self__, 0), value.__func__
    if isinstance(value, nn.Module):  # its weights are read anew; its own numbers are not
        plain = {name: one for name, one in vars(value).items() if isinstance(one, bool | int | float | str)}
        return _Same(value), tuple((name, repr(one)) for name, one in sorted(plain.items()))
    if not depth or isinstance(value, FunctionType | type):
        return _Same(value)
    if isinstance(value, partial):
        return tuple(graph_key(one, depth - 1) for one in (value.func, value.args, value.keywords))
    if isinstance(value, Mapping | TensorDictBase):
        entries = sorted(((str(key), key) for key in value.keys()), key=lambda entry: entry[0])  # noqa: SIM118
        return tuple((name, graph_key(value[key], depth - 1)) for name, key in entries)
    if isinstance(
        value, list | tuple
    ):  # what they hold is no deeper for it: a sum of sums has two lists on the way
        return tuple(graph_key(one, depth) for one in value)
    slots = [name for kind in type(value).__mro__ for name in _names(kind) if hasattr(value, name)]
    if slots or hasattr(value, "__dict__"):
        held = {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})
        return type(value), tuple((name, graph_key(one, depth - 1)) for name, one in sorted(held.items()))
    return _Same(value)


def _memory(tensor: torch.Tensor) -> Hashable:
    if tensor.layout != torch.strided:
        return _Same(tensor)
    if tensor.dim() == 0 and tensor.device.type == "cpu":  # such a number becomes part of the operations
        return repr(tensor.item())
    return tensor.data_ptr(), tuple(tensor.shape), tensor.stride(), tensor.dtype, tensor.device


def _names(kind: type) -> list[str]:
    slots = kind.__dict__.get("__slots__", ())
    return [slots] if isinstance(slots, str) else list(slots)
