"""Values that nobody means, and mutations of nested ones."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

from rooms.forked import NotApplicable

NUMBERS: list[Any] = [
    0, -1, 1, 2, 3, 7, 10**6, 10**9, 10**12, 2**31, 2**63, 2**64, 10**20, -(10**20), 10**400,
    0.5, -0.5, 1.0, 1e-300, 1e30, 1e300, float("nan"), float("inf"), float("-inf"),
]  # fmt: skip
TEXTS = [
    "",
    " ",
    "abc",
    "nan",
    "1",
    "None",
    "../../x",
    "/dev/zero",
    "/",
    "\u0000",
    "é∑\n",
    "a" * 5000,
    "${oc.env:HOME}",
]
OTHERS: list[Any] = [
    None,
    True,
    False,
    [],
    [1],
    [None],
    ["a", "b"],
    [[]],
    {},
    {"a": 1},
    [-1, -1],
    [10**9, 10**9],
]

values = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.sampled_from(OTHERS),
    st.integers(-5, 300),
    st.integers(),
    st.floats(),
    st.text(max_size=12),
)
"""Any of them."""

REMOVE = "<remove>"


def leaves(value: Any, inner: bool = True, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of a nested value: of all that is no mapping or list, and (`inner`) of those."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    if path and (inner or not isinstance(value, dict | list)):
        yield path
    for key, part in parts:
        yield from leaves(part, inner, (*path, key))


def changed(tree: Any, path: list[Any], value: Any) -> Any:
    """A copy of a nested value with one place changed or removed."""
    tree = copy.deepcopy(tree)
    place = tree
    try:
        for key in path[:-1]:
            place = place[key]
        if value == REMOVE:
            del place[path[-1]]
        else:
            place[path[-1]] = value
    except (KeyError, IndexError, TypeError) as error:
        raise NotApplicable(str(error)) from error
    return tree


def mutation(paths: list[tuple[Any, ...]]) -> st.SearchStrategy[list[Any]]:
    """`[path, value]`."""
    return st.tuples(
        st.sampled_from(sorted(paths, key=str)).map(list),
        st.one_of(values, values, values, st.just(REMOVE)),
    ).map(list)
