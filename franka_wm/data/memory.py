"""How much memory is free: what does not fit is refused before it is gathered, or read from the disk."""

from __future__ import annotations

from pathlib import Path

import torch


def free_memory(device: torch.device | str) -> int | None:
    """Bytes that can still be allocated on ``device``; ``None`` where the system does not tell."""
    device = torch.device(device)
    if device.type == "cuda":
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:  # not Linux
        return None
    kilobytes = next((line.split()[1] for line in lines if line.startswith("MemAvailable:")), None)
    if kilobytes is None:
        return None
    left = left_of_container(Path("/sys/fs/cgroup"))
    return 1024 * int(kilobytes) if left is None else min(left, 1024 * int(kilobytes))


def left_of_container(place: Path) -> int | None:
    """Bytes below the limit of the container (Linux control groups, version 2); ``None`` without a limit."""
    try:
        most, used = ((place / name).read_text().strip() for name in ("memory.max", "memory.current"))
        if most == "max":
            return None
        lines = (place / "memory.stat").read_text().splitlines()
        sizes = {name: int(size) for name, size in map(str.split, lines)}
        cached = sum(sizes.get(name, 0) for name in ("inactive_file", "active_file", "slab_reclaimable"))
        return max(0, int(most) - int(used) + cached)
    except (OSError, ValueError):  # not Linux, or the older version
        return None
