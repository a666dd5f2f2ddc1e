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
    return None if kilobytes is None else 1024 * int(kilobytes)
