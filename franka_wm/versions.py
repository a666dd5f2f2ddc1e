"""What a result was made with: packages, machine, commit, code."""

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from franka_wm import source
from franka_wm.files import atomic_write
from franka_wm.version import __version__

FINISHED = "finished.json"
"""What a run's folder holds once the run has ended, and not while it goes on."""

PACKAGES = ("torch", "torchrl", "tensordict", "newton", "warp-lang", "mujoco-warp", "lerobot", "numpy")


def usable_cores() -> int:
    """Cores that this process may use: fewer than the machine has, in a container or under ``taskset``."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(device: Any = None) -> dict[str, Any]:
    """Versions of what decides numbers, and the machine they ran on.

    Args:
        device: torch device of the run; its name is taken along.

    Returns:
        Texts and numbers that JSON can hold. A package that is not installed is left out. Outside of a repository the
        commit is that of the environment variable ``FRANKA_WM_COMMIT``, and left out without one.
    """
    found: dict[str, Any] = {"franka_wm": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    found["system"] = platform.platform(terse=True)
    found["processors"] = os.cpu_count() or 0
    found["processor"] = processor()
    found["cores"] = usable_cores()
    if device is not None:
        import torch

        found["threads"] = torch.get_num_threads()
        device = torch.device(device)
        found["device"] = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    commit = _commit()
    if commit:
        found["commit"] = commit
    return found


def write_versions(folder: str | Path, device: Any = None) -> Path:
    """Write ``versions.json`` into a run's folder as the run starts, with the time of day.

    Raises:
        UserError: it cannot be written.
    """
    source.snapshot()
    started = _now().isoformat(timespec="seconds")
    return _write(Path(folder) / "versions.json", versions(device) | {"started": started})


def write_finished(folder: str | Path) -> Path:
    """Write ``finished.json`` as the run ends: what it took since `write_versions` [s], and the hashes of its code.

    Raises:
        UserError: it cannot be written.
    """
    started = json.loads((Path(folder) / "versions.json").read_text())["started"]
    taken = (_now() - datetime.fromisoformat(started)).total_seconds()
    return _write(Path(folder) / FINISHED, {"seconds": round(taken), "source": source.source()})


def hardware(device: Any) -> str:
    """What computes on a torch device: the GPU's name, or the processor's and the threads that torch uses."""
    import torch

    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"{processor()}, {threads} thread{'s' * (threads > 1)}"


def processor() -> str:
    """The processor's name, as its maker writes it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


def _now() -> datetime:
    return datetime.now(UTC)


def _write(path: Path, found: dict[str, Any]) -> Path:
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    return path


def _commit() -> str | None:
    """The checkout's commit, with a ``+`` where files differ from it; None if there is no telling."""
    top = source.ROOT
    if not (top / ".git").exists():  # a copy, or installed elsewhere: a repository further up is not ours
        return os.environ.get("FRANKA_WM_COMMIT")

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(top), *arguments], capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):  # no git, or not a repository that it will read
        return None
