"""What every benchmark shares: the machine it ran on, timing, a table, a JSON file."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from franka_wm import conf, source
from franka_wm.device import resolve_device
from franka_wm.files import atomic_write
from franka_wm.versions import versions

source.snapshot()
COMMAND = list(sys.argv)
BEGUN = versions() | {"started": datetime.now(UTC).isoformat(timespec="seconds")}
"""Before anything is measured: by its end another commit may be checked out."""


COMPOSED: dict[str, Any] = {}
"""Arguments of train.py whose configuration this benchmark takes numbers from -> that configuration."""


def compose(*arguments: str) -> DictConfig:
    """The configuration of ``train.py ARGUMENT …``; the file of ``--out`` holds it, too."""
    config = conf.compose(*arguments)
    COMPOSED[shlex.join(arguments)] = OmegaConf.to_container(config, resolve=True)
    return config


def grown(gpus: int, *arguments: str) -> list[str]:
    """Further arguments, by which each of so many GPUs has the worlds, batch and replay that one has with these."""
    alone = compose(*arguments)
    numbers = {
        "collector.num_envs": alone.collector.num_envs,
        "collector.planner_worlds": alone.collector.planner_worlds,
        "replay.batch_size": alone.replay.batch_size,
        "replay.capacity": alone.replay.capacity,
    }
    return [f"gpus={gpus}", *(f"{name}={value * gpus}" for name, value in numbers.items())]


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


@dataclass
class Power:
    """Mean power of a GPU [W]; nan before it is known, and where it cannot be."""

    watts: float = float("nan")


@contextmanager
def power(device: torch.device) -> Iterator[Power]:
    """Measures the power of the whole GPU meanwhile, by NVML's energy counter; on a CPU nothing."""
    drawn = Power()
    if device.type != "cuda":
        yield drawn
        return
    try:
        import pynvml  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        print("power is not measured; pip install nvidia-ml-py")
        yield drawn
        return
    pynvml.nvmlInit()
    # NVML counts GPUs as they are built in, CUDA as they are visible.
    gpu = pynvml.nvmlDeviceGetHandleByUUID(f"GPU-{torch.cuda.get_device_properties(device).uuid}")
    started, before = time.perf_counter(), pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu)  # mJ
    yield drawn
    joule = (pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu) - before) / 1e3
    drawn.watts = joule / (time.perf_counter() - started)
    pynvml.nvmlShutdown()


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


def publish(
    name: str,
    rows: list[dict[str, Any]],
    out: str | None,
    *,
    device: torch.device | str = "auto",
    ran: tuple[str, ...] = (),
) -> None:
    """Prints the machine and the table; writes ``out`` as JSON if given, with the machine, versions, command and code.

    Args:
        device: What computed.
        ran: How the paths of code begin that other processes ran. All of it counts: which of it, they did not tell.
    """
    made = versions(resolve_device(device)) | BEGUN
    where = made["processor"] if made["device"] == "cpu" else made["device"]
    print(f"\n{name}: {where}, {made['cores']} cores, torch {made['torch']}, newton {made['newton']}\n")
    print(table(rows), flush=True)
    if out:
        files = source.snapshot().items()
        others = {file: source.code_hash(file, content) for file, content in files if file.startswith(ran)}
        made |= {"command": COMMAND, "source": others | source.source()}
        with atomic_write(out) as path:
            written = {"benchmark": name, "machine": made, "rows": rows, "composed": COMPOSED}
            path.write_text(json.dumps(written, indent=2) + "\n")
