"""How long do processes take to add up their gradients? By size of the message: what `docs/scale.md` reckons with.

    torchrun --standalone --nproc-per-node=2 benchmarks/all_reduce.py                    NCCL, the GPUs of this host
    torchrun --standalone --nproc-per-node=2 benchmarks/all_reduce.py --device cpu       gloo
    torchrun --nnodes=2 --nproc-per-node=4 --rdzv-backend=c10d --rdzv-endpoint=HOST:29400 benchmarks/all_reduce.py

One message is what `franka_wm.processes.average_gradients` sends: all gradients of an update. The last line is the fit
time = latency + bytes / bandwidth.
"""

from __future__ import annotations

import argparse
import time

import torch
from common import publish
from torch import distributed

from franka_wm import processes

SIZES = (0.01, 0.1, 1.0, 4.0, 16.0, 64.0, 256.0)
"""Of the messages [MB]."""


def seconds(megabytes: float, device: torch.device, *, least: float = 0.5, repeats: int = 5) -> float:
    """Median time of an all-reduce of float32 gradients; the slowest process's."""
    x = torch.ones(max(1, int(megabytes * 1e6 / 4)), device=device)

    def timed(times: int) -> float:
        processes.wait()
        started = time.perf_counter()
        for _ in range(times):
            distributed.all_reduce(x)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return max(processes.objects((time.perf_counter() - started) / times))

    timed(3)
    times = max(1, int(least / repeats / max(timed(3), 1e-6)))
    return sorted(timed(times) for _ in range(repeats))[repeats // 2]


def fit(found: list[tuple[float, float]]) -> tuple[float, float]:
    """Latency [s] and bandwidth [bytes/s] by least squares of relative errors, of (bytes, s)."""
    size, took = torch.tensor(found, dtype=torch.float64).unbind(1)
    wanted = torch.stack([torch.ones_like(size), size], 1) / took.unsqueeze(1)
    latency, per_byte = torch.linalg.lstsq(wanted, torch.ones(len(found), 1, dtype=torch.float64)).solution[
        :, 0
    ]
    return float(latency), 1 / float(per_byte)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--megabytes", nargs="+", type=float, default=SIZES)
    parser.add_argument("--out", help="JSON file")
    args = parser.parse_args()
    processes.join(cuda=args.device == "cuda")
    device = processes.own_gpu() if args.device == "cuda" else torch.device("cpu")
    rows = []
    for size in args.megabytes:
        took = seconds(size, device)
        # A ring sends each byte 2 (N − 1) / N times over the slowest link.
        sent = 2 * (processes.count() - 1) / processes.count() * size * 1e6
        rows.append({"processes": processes.count(), "MB": size, "ms": 1e3 * took, "GB/s": sent / took / 1e9})
    if processes.is_first():
        publish("all-reduce", rows, args.out, device=device)
        if len(rows) > 1:
            latency, bandwidth = fit([(1e6 * row["MB"], row["ms"] / 1e3) for row in rows])
            print(f"\ntime = {1e3 * latency:.3g} ms + size / ({bandwidth / 1e9:.3g} GB/s)")
    processes.wait()
    processes.leave()


if __name__ == "__main__":
    main()
