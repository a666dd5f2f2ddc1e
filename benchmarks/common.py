"""What every benchmark shares: the machine it ran on, timing, a table, a JSON file."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch


def machine() -> dict[str, Any]:
    """Processor, cores, GPU and versions."""
    import newton
    import tensordict
    import torchrl
    import warp

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cpu": platform.processor() or platform.machine(),
        "cores": cores,
        "python": platform.python_version(),
        "versions": {m.__name__: m.__version__ for m in (torch, torchrl, tensordict, warp, newton)},
    }


def synchronize() -> None:
    """Waits for the device, if there is one to wait for."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def rate(work: Callable[[], Any], *, seconds: float = 2.0, warmup: int = 3, repeats: int = 3) -> float:
    """Calls of ``work`` per second: the median of ``repeats`` measurements of about ``seconds`` each."""
    for _ in range(warmup):
        work()
    synchronize()
    started = time.perf_counter()
    work()
    synchronize()
    count = max(1, round(seconds / max(time.perf_counter() - started, 1e-6)))
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        for _ in range(count):
            work()
        synchronize()
        rates.append(count / (time.perf_counter() - started))
    return sorted(rates)[repeats // 2]


def tdmpc2(latent: int, encoder: int, hidden: int) -> Any:
    """An untrained TD-MPC2 of these widths that reads the arm's vectors."""
    from franka_wm import models

    return models.make(
        "tdmpc2",
        observation_sizes={"state": 20, "joint_target": 7},
        action_dim=7,
        episode_length=50,
        latent_dim=latent,
        encoder_dim=encoder,
        hidden_dim=hidden,
    )


def table(rows: list[dict[str, Any]]) -> str:
    """Rows of equal keys as Markdown."""
    names = list(rows[0])

    def cell(value: Any) -> str:
        if isinstance(value, float) and value != value:
            return "–"  # not measured here
        if isinstance(value, float):
            return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
        return str(value)

    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(cell(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def publish(name: str, rows: list[dict[str, Any]], out: str | None) -> None:
    """Prints the machine and the table; writes ``out`` as JSON if given."""
    facts = machine()
    print(f"\n{name}: {facts['gpu'] or facts['cpu']}, {facts['cores']} cores, torch {facts['versions']['torch']}, "
          f"newton {facts['versions']['newton']}\n")  # fmt: skip
    print(table(rows), flush=True)
    if out:
        path = Path(out)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".writing")
        temporary.write_text(json.dumps({"benchmark": name, "machine": facts, "rows": rows}, indent=2) + "\n")
        temporary.replace(path)
