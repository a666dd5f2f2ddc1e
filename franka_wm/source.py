"""Which code made a result: a hash of every file that the process uses."""

import hashlib
import io
import os
import sys
import tokenize
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("franka_wm", "benchmarks", "train.py")
SHOWS = (
    "franka_wm/conf/",  # compared by value
    "franka_wm/report/",
    "franka_wm/live/",
    "franka_wm/source.py",
    "franka_wm/video.py",
    "benchmarks/results/",
)
"""What shows results and does not make them."""


@cache
def snapshot() -> dict[str, bytes]:
    """Every file of `PARTS`, by its path from the top, as it is when this is first called.

    A run calls it at its start: files that are edited while it trains are not those that it imported.
    """
    found = {}
    for part in PARTS:
        top = ROOT / part
        for path in [top] if top.is_file() else sorted(top.rglob("*")):
            name = path.relative_to(ROOT).as_posix()
            if path.is_file() and "__pycache__" not in name and not name.startswith(SHOWS):
                found[name] = path.read_bytes()
    return found


def imported() -> list[str]:
    """Files of `snapshot` that this process has imported, and the data files beside them."""
    files = [file for m in list(sys.modules.values()) if (file := getattr(m, "__file__", None))]
    real = cache(os.path.realpath)  # of folders: there are thousands of files
    places = [os.path.join(real(os.path.dirname(file)), os.path.basename(file)) for file in files]
    modules = {Path(place).resolve() if os.path.islink(place) else Path(place) for place in places}
    folders = {path.parent for path in modules if path.name == "__init__.py"}
    names = []
    for name in snapshot():
        path = ROOT / name
        if path in modules or (path.suffix != ".py" and path.parent in folders):
            names.append(name)
    return names


def source() -> dict[str, str]:
    """Path → hash of the code that this process runs; to be called at its end, after `snapshot` at its start."""
    return {name: code_hash(name, snapshot()[name]) for name in imported()}


def differing(measured: Mapping[str, str], now: Mapping[str, bytes] | None = None) -> list[str]:
    """The files that are not what they were, or are gone.

    Args:
        measured: Path → hash, as `source` gave it.
        now: Path → content; as the files are now, if not given.
    """
    now = read(measured) if now is None else now
    return [name for name, then in measured.items() if name not in now or code_hash(name, now[name]) != then]


def read(names: Iterable[str]) -> dict[str, bytes]:
    """The content of those that exist."""
    return {name: (ROOT / name).read_bytes() for name in names if (ROOT / name).is_file()}


@cache
def code_hash(name: str, content: bytes) -> str:
    """Hash of what a file does: of Python, comments, docstrings and layout do not count."""
    if name.endswith(".py"):
        content = "\x1f".join(_tokens(content.decode())).encode()
    return hashlib.sha256(content).hexdigest()[:12]


def _tokens(text: str) -> list[str]:
    """Tokens of a Python file, without comments and without statements that are nothing but a text."""
    kept: list[str] = []
    statement: list[tokenize.TokenInfo] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.NL):
            continue
        if token.type == tokenize.NEWLINE:
            if any(one.type != tokenize.STRING for one in statement):
                kept += [*(one.string for one in statement), "\n"]
            statement = []
        elif token.type in (tokenize.INDENT, tokenize.DEDENT):
            kept.append(tokenize.tok_name[token.type])
        else:
            statement.append(token)
    return kept
