"""Known vulnerabilities of the locked packages, by PyPI's advisories: `make audit`.

Status 1 if there are any. Where the advisories cannot be had, a line says so, and the status is 0.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main(tool: str, lock: str) -> int:
    """Ask about every package of a lock.

    Args:
        tool: Where pip-audit is.
        lock: A file of requirements with hashes.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        words = ["--disable-pip", "--require-hashes", "--progress-spinner", "off", "-r", lock]
        try:
            ended = subprocess.run(
                [tool, *words, "-f", "json", "-o", str(report)], capture_output=True, text=True, check=False
            )
        except OSError as error:
            return not_asked(lock, str(error))
        if not report.is_file():
            return not_asked(lock, ended.stderr)
        packages = json.loads(report.read_text(encoding="utf-8"))["dependencies"]
    skipped = [one for one in packages if "skip_reason" in one]
    found = [(one, known) for one in packages for known in one.get("vulns", ())]
    for one, known in found:
        mended = ", ".join(known["fix_versions"]) or "no version yet"
        print(f"{one['name']} {one['version']}: {known['id']}, mended in {mended}")
    if skipped:
        not_asked(f"{len(skipped)} of {len(packages)} packages", skipped[0]["skip_reason"])
    elif not found:
        print(f"{lock}: no known vulnerability in {len(packages)} packages")
    return int(bool(found))


def not_asked(what: str, why: str) -> int:
    """Say that nothing is known, in one line; status 0."""
    last = (why.strip().splitlines() or ["no reason given"])[-1]
    print(f"{what}: PyPI's advisories cannot be had, nothing is known of them ({last[:300]})")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
