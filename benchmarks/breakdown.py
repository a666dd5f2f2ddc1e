"""Where a run's time goes: gathering, drawing a batch, updating; how many kernels each launches, and the longest ones.

    python benchmarks/breakdown.py scale=gpu env=reach                arguments of train.py
    python benchmarks/breakdown.py scale=gpu env=reach_fixed model=muzero planner=gumbel trainer.compile=true

*one call* is timed by itself. *busy* is how long at least one kernel ran: what is missing to one call is waiting for
launches, and where it is far below the kernels' sum they ran side by side. On a CPU torch's operators take the place of
kernels; those of the simulator are not among them.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from common import compose, publish, rate, synchronize
from torch.autograd import DeviceType  # pyright: ignore[reportPrivateImportUsage]
from torch.profiler import ProfilerActivity, profile

from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.device import prefer_speed, resolve_device
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.learner import Learner
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings
from franka_wm.training.trainer import Trainer

ASIDE = ("evaluation.episodes=8", "evaluation.during=[]", "evaluation.video_episodes=0", "logger=none")
WARMUP = 12
"""Calls before anything is timed: eager ones, compiling, the capture."""
PROFILED = {"gather": 2, "draw": 10, "update": 10}
"""Calls under the profiler."""


def make_trainer(arguments: Sequence[str], folder: Path) -> Trainer:
    """A run as train.py builds it, its replay filled for the first updates."""
    settings = RunSettings.of(compose(*ASIDE, *arguments))
    check(settings)
    run = Run(settings, folder)
    torch.manual_seed(0)
    prefer_speed(run.device, onednn=settings.trainer.onednn)
    env, _ = run.build_environments()
    replay, spaces = run.build_experience(env)
    model = build.make_model(settings, spaces, run.device)
    trainer = Trainer(
        env=env,
        learner=Learner(model, **settings.learner_options),
        replay=replay,
        policies=build.make_agent_policies(settings, model, env, spaces, purpose="training"),
        actor=settings.actor,
        settings=settings,
        folder=folder,
        loggers=[],
        evaluate=dict,
        spaces=spaces,
    )
    if isinstance(replay, RecordedWindows):
        trainer.standardize(replay.statistics())
    else:
        trainer.seed()
        assert trainer.acting is not None
        trainer.acting.use(trainer.actor)
    return trainer


def parts(trainer: Trainer) -> dict[str, Callable[[], object]]:
    """What the loop of training calls in turns."""

    def update() -> None:
        batch = trainer._batch
        assert batch is not None
        trainer.learner.update(batch, static=trainer._static(batch))

    def draw() -> None:
        trainer._batch = trainer._draw()

    gather = {} if trainer.env is None else {"gather": trainer.gather}
    return {**gather, "draw": draw, "update": update}


def busy(spans: Sequence[tuple[float, float]]) -> float:
    """How much of the time at least one of these (start, end) covers."""
    total, last = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, last))
        last = max(last, end)
    return total


def shortened(name: str) -> str:
    """A kernel's name without its types."""
    name = re.sub(r"^void |\(anonymous namespace\)::|<.*|\(.*", "", name)
    return name.removeprefix("at::native::")[:60]


def launched(
    work: Callable[[], object], calls: int, device: torch.device
) -> tuple[list[tuple[str, float]], list[tuple[float, float]]]:
    """Names and times of the kernels of some calls (or operators, without what they call), and when any ran [µs]."""
    cuda = device.type == "cuda"
    synchronize()
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]) as seen:
        for _ in range(calls):
            work()
        synchronize()
    kind = DeviceType.CUDA if cuda else DeviceType.CPU
    events: Any = [one for one in seen.events() or [] if one.device_type == kind]
    spans = [(one.time_range.start, one.time_range.end) for one in events]
    if cuda:
        return [(one.name, end - start) for one, (start, end) in zip(events, spans, strict=True)], spans
    return [(one.name, one.self_cpu_time_total) for one in events], spans


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=1.0, help="of each of three measurements")
    parser.add_argument("--longest", type=int, default=8, help="kernels to show of each part")
    parser.add_argument("--out")
    parser.add_argument("arguments", nargs="*", help="of train.py")
    asked = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(asked.arguments, Path(folder))
        device = resolve_device(trainer.settings.device)
        work = parts(trainer)
        for _ in range(WARMUP):
            for one in work.values():
                one()
        for part, one in work.items():
            rows.append(
                {
                    "part": part,
                    "what": "one call",
                    "count": 1.0,
                    "time [ms]": 1e3 / rate(one, seconds=asked.seconds),
                }
            )
            calls = PROFILED[part]
            kernels, spans = launched(one, calls, device)
            count: Counter[str] = Counter()
            time: dict[str, float] = defaultdict(float)
            for name, took in kernels:
                count[shortened(name)] += 1
                time[shortened(name)] += took
            longest = sorted(time.items(), key=lambda item: -item[1])
            for what, number, total in (
                ("kernels, sum", len(kernels), sum(time.values())),
                ("kernels, busy", len(kernels), busy(spans)),
                *((name, count[name], total) for name, total in longest[: asked.longest]),
            ):
                rows.append(
                    {"part": part, "what": what, "count": number / calls, "time [ms]": total / calls / 1e3}
                )
    publish(f"breakdown of {' '.join(asked.arguments)}", rows, asked.out, device=device)


if __name__ == "__main__":
    main()
