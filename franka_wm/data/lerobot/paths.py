"""Paths of this machine, taken out of what is published: they name a user and help nobody else."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

_START = r"(?:^|(?<=[\s='\"\[({,:;`|<>@+]))"
_ROOT = r"(?:file://)?(?:~\w*[\\/]|[A-Za-z]:\\|/(?!/))"
_QUOTED = re.compile(rf"(['\"])((?:[\w./+-]+=)?)(\[?)({_ROOT}[^'\"\n]*)\1")
_PLAIN = re.compile(rf"{_START}{_ROOT}[^\s'\"=,;:\[\](){{}}|<>`]+")


def is_local(text: str) -> bool:
    """Whether all of ``text`` is an absolute path, or one in somebody's home."""
    return re.match(_ROOT, text) is not None and "\n" not in text


def last(path: str) -> str:
    """The last component of a path, of either kind of separator."""
    kind = PureWindowsPath if "\\" in path else PurePosixPath
    return kind(path.removeprefix("file://")).name


def shortened(text: str) -> str:
    """``text`` with every absolute path in it replaced by the path's last component.

    A path with spaces is found whole if it is quoted, alone, as ``'name=/a path'`` or in a list that begins with one,
    or if the spaces are in this user's home.
    """
    home = str(Path.home())
    if len(home) > 1 and " " in home:
        text = text.replace(home + "/", "~/")
    text = _QUOTED.sub(_quoted, text)
    return _PLAIN.sub(lambda found: last(found[0]), text)


def _quoted(found: re.Match[str]) -> str:
    quote, name, bracket, path = found.groups()
    parts = path.split(",") if bracket else [path]  # the last one of a list ends in its bracket
    return quote + name + bracket + ",".join(last(one) if is_local(one) else one for one in parts) + quote


def without_paths(value: Any, *, clear: bool = False) -> Any:
    """Plain values, however deep, without absolute paths.

    Args:
        value: Mappings, sequences, numbers, text.
        clear: A mapping's value that is such a path becomes ``None``, not the path's last component.

    Returns:
        A copy.
    """
    if isinstance(value, Mapping):
        return {
            key: None if clear and isinstance(one, str) and is_local(one) else without_paths(one, clear=clear)
            for key, one in value.items()
        }
    if isinstance(value, list | tuple):
        return [without_paths(one, clear=clear) for one in value]
    if isinstance(value, str):
        return last(value) if is_local(value) else shortened(value)
    return value
