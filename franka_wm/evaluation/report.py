"""The end of a run: table, ``evaluation.json``, curves, video."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from franka_wm.envs import FrankaEnv
from franka_wm.envs.camera import project
from franka_wm.evaluation.closed_loop import EVALUATION_SEED, evaluate_policies, play_episodes
from franka_wm.report import written_whole
from franka_wm.report.curves import plot_learning_curves
from franka_wm.report.table import markdown_table, terminal_table
from franka_wm.report.video import draw_marker, tile_frames, write_png, write_video


def evaluate_and_report(
    cfg: DictConfig,
    folder: Path,
    env: FrankaEnv,
    policies: Mapping[str, Any],
    *,
    rows: Sequence[Mapping[str, float]],
    say: Any = print,
) -> dict[str, dict[str, Any]]:
    """Evaluates every policy on the same unseen episodes and writes what a run leaves behind.

    Writes ``evaluation.json``, ``evaluation.md``, ``curves.png``, ``video.mp4`` and ``last_frame.png`` into
    ``folder``, and prints the table.
    """
    from rich.console import Console

    say(f"evaluating over {env.num_envs} episodes that training never saw …")
    results = evaluate_policies(
        env,
        policies,
        seed=cfg.seed,
        report=lambda name, r: say(f"  {name}: final distance {r['final_distance']['mean']:.4f} m"),
    )
    with written_whole(folder / "evaluation.json") as path:
        path.write_text(json.dumps(results, indent=2) + "\n")
    with written_whole(folder / "evaluation.md") as path:
        path.write_text(markdown_table(results))
    if rows:
        plot_learning_curves(rows, folder / "curves.png", success_distance=env.config.success_distance)
    if cfg.evaluation.video_episodes:
        film(cfg, folder, policies["planner"])
    Console(width=120).print(terminal_table(results))
    return results


def film(cfg: DictConfig, folder: Path, policy: Any) -> None:
    """``video.mp4`` and ``last_frame.png``: episodes of one policy, the goal drawn as a ring."""
    from franka_wm.training.build import make_evaluation_env

    env = make_evaluation_env(cfg, num_envs=cfg.evaluation.video_episodes)
    size = cfg.evaluation.video_size
    frames: list[torch.Tensor] = []

    def picture() -> None:
        view = env.render(size, samples=2)
        marks = project(env.goal, env.config, size)
        frames.append(draw_marker(view.cpu(), marks.cpu(), radius=size / 32))

    play_episodes(env, policy, seed=cfg.seed + EVALUATION_SEED, video=picture)
    film = tile_frames(torch.stack(frames))
    write_video(film, folder / "video.mp4", fps=round(env.config.fps))
    write_png(film[-1], folder / "last_frame.png")
