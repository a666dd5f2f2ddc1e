"""What a result was made with: packages, machine, commit."""

import json
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import franka_wm
from franka_wm.report import written_whole

PACKAGES = ("torch", "torchrl", "tensordict", "newton", "warp-lang", "mujoco-warp", "lerobot", "numpy")


def versions(device: Any = None) -> dict[str, Any]:
    """Versions of what decides numbers, and the machine they ran on.

    Args:
        device: torch device of the run; its name is taken along.

    Returns:
        Texts and numbers that JSON can hold. A package that is not installed, and the commit outside of a
        repository, are left out.
    """
    found: dict[str, Any] = {"franka_wm": franka_wm.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    found["system"] = platform.platform(terse=True)
    found["processors"] = os.cpu_count() or 0
    if device is not None:
        import torch

        device = torch.device(device)
        found["device"] = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    commit = _commit()
    if commit:
        found["commit"] = commit
    return found


def write_versions(folder: str | Path, device: Any = None) -> Path:
    """Write ``versions.json`` into a run's folder.

    Raises:
        UserError: it cannot be written.
    """
    path = Path(folder) / "versions.json"
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(versions(device), indent=2) + "\n")
    return path


def _commit() -> str | None:
    """The checkout's commit, with a ``+`` where files differ from it; None outside of a repository."""
    top = Path(franka_wm.__file__).resolve().parents[1]
    if not (top / ".git").exists():  # installed elsewhere: a repository further up is not ours
        return None

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(top), *arguments], capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):  # no git, or not a repository that it will read
        return None
