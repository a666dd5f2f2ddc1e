"""A run's folder in miniature, and readers of what was drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from franka_wm.evaluation.results import END
from franka_wm.video import write_png, write_video


def interval(mean: float, spread: float = 0.1) -> dict[str, float]:
    return {"mean": mean, "low": mean - spread * abs(mean), "high": mean + spread * abs(mean)}


def policy(distance: float, success: float = 0.5) -> dict[str, Any]:
    return {
        "final_distance": interval(distance),
        "success": {d: interval(success) for d in ("0.05", "0.025", "0.01")},
        "return": interval(-2.0),
        "episodes": 100,
    }


def extras() -> dict[str, Any]:
    """One of everything that ``franka-wm evaluate`` may add."""
    return {
        "open_loop": {
            "steps": [1, 2, 3],
            "curves": {
                "model": {"mean": [0.1, 0.2, None], "low": [0.05, 0.1, None], "high": [0.2, 0.3, None]},
                "no_change": {"mean": [1.0, 1.0, 1.0]},
            },
            "unit": "error relative to no change",
            "rank_correlation": interval(0.8),
        },
        "probes": {"joints": {"ridge": 0.9, "neighbours": 0.7, "alpha": 0.1}, "goal": {"ridge": None}},
        "spectrum": {
            "singular_values": [2.0, 1.0, 0.5],
            "effective_rank": 2.1,
            "rankme": 2.4,
            "warning": "the latents have collapsed <to a point>",
        },
        "latents": {"points": [[0, 1], [1, 0]], "quantity": [0.1, 0.2], "label": "distance [m]"},
        "calibration": {"predicted": [-2, -1], "true": [-2.1, -0.9], "slope": 1.2},
        "robustness": {"camera": {"planner": {"final_distance": interval(0.2), "verdict": "breaks"}}},
        "health": {"planner gain": interval(0.3)},
        "protocol": {"episodes": 100, "seeds": "held out"},
    }


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes a run's folder: ``make_run(name, seed=…, distance=…, rows=…, more=…, pictures=…)``."""

    def make(
        name: str = "run",
        *,
        seed: int = 0,
        lr: float = 3e-4,
        distance: float = 0.02,
        rows: bool = True,
        more: dict[str, Any] | None = None,
        pictures: bool = False,
    ) -> Path:
        run = tmp_path / name
        (run / ".hydra").mkdir(parents=True)
        (run / "config.yaml").write_text(
            f"env: {{task: reach, goal_sampling: fixed, success_distance: 0.05}}\nmodel: {{name: tdmpc2}}\n"
            f"trainer: {{lr: {lr}}}\nseed: {seed}\ndevice: cpu\n"
        )
        (run / ".hydra" / "overrides.yaml").write_text(f"- env=reach_fixed\n- seed={seed}\n- 'note=a b'\n")
        policies = {"planner": policy(distance), "noop": policy(0.25, 0.0)}
        protocol = {
            "by": END,
            "updates": 300,
            "env_steps": 3000,
            "training_seconds": 30.0,
            "success_distance": 0.05,
        }
        (run / "evaluation.json").write_text(
            json.dumps({"protocol": protocol, "policies": policies, **(more or {})})
        )
        if rows:
            for key, values in {
                "loss_value": [1.0, 0.5, 0.25 + seed],
                "eval/planner/final_distance": [0.3, 0.2, distance],
                "grad_norm_model": [1.0, 2.0, 1.5],
            }.items():
                path = run / "csv" / "scalars" / f"{key}.csv"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text("".join(f"{100 * (k + 1)},{v}\n" for k, v in enumerate(values)))
        if pictures:
            frames = torch.zeros(4, 32, 32, 3, dtype=torch.uint8)
            frames[:, 8:24, 8:24] = 200
            write_video(frames, run / "video.mp4", fps=10)
            write_video(frames, run / "imagined.mp4", fps=10)
            write_png(frames[0], run / "imagined.png")
        return run

    return make
