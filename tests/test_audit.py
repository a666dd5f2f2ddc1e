"""`make audit`: findings fail, and advisories that cannot be had are one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

FINE = {"name": "torch", "version": "2", "vulns": []}
BAD = {"name": "pillow", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["1.1"]}]}
UNKNOWN = {"name": "absl-py", "skip_reason": "not found on PyPI"}


@pytest.mark.parametrize(
    ("packages", "status", "says"),
    [
        ([FINE], 0, ["no known vulnerability in 1 packages"]),
        ([FINE, BAD], 1, ["pillow 1: PYSEC-1, mended in 1.1"]),
        ([FINE, UNKNOWN], 0, ["1 of 2 packages: PyPI's advisories cannot be had", "not found on PyPI"]),
        ([UNKNOWN, BAD], 1, ["PYSEC-1", "1 of 2 packages"]),
        (None, 0, ["cannot be had", "no route to host"]),
    ],
)
def test_only_findings_fail(packages: Any, status: int, says: list[str], root: Path, tmp_path: Path) -> None:
    tool = tmp_path / "pip-audit"
    answer = "" if packages is None else json.dumps({"dependencies": packages})
    tool.write_text(
        f"#!{sys.executable}\nimport sys\n"
        f"if {answer!r}: open(sys.argv[-1], 'w').write({answer!r})\n"
        "print('a\\nno route to host', file=sys.stderr)\nsys.exit(1)\n"
    )
    tool.chmod(0o755)
    words = [sys.executable, str(root / "scripts" / "audit.py"), str(tool), "some.lock"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == status and not ended.stderr, ended
    assert all(words in ended.stdout for words in says), ended.stdout
    assert packages is not None or ended.stdout.count("\n") == 1


def test_no_tool_is_one_line(root: Path) -> None:
    words = [sys.executable, str(root / "scripts" / "audit.py"), "/no/such/tool", "some.lock"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and ended.stdout.count("\n") == 1 and not ended.stderr
